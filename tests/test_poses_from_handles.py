"""Poses from handles: what is read, kept and reached; rivals by hand."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab.diffusion import poses
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError, ShapeError
from studies.nb14_handles import people, training, trials
from studies.nb14_handles.rivals import Known
from tests.draws import seeded

SMALL = poses.PoseRecipe(size=32, layers=1, steps=60, batch=32, lr=5e-3)


@pytest.fixture(scope="module")
def model():
    return poses.load()


@pytest.fixture(scope="module")
def windows():
    clips = scenes.held_out(8)
    return gather([on_standard(replace(clips.clip(i), contacts=None)) for i in range(8)], 1)


@pytest.fixture(scope="module")
def truth(windows):
    return training.stuck(windows.evenly(24))


def off(made, truth):
    return (made.positions - truth.positions)[:, 0].norm(dim=-1)


@pytest.mark.parametrize("name", people.SETS)
def test_handles_are_met_to_the_millimetre_and_nothing_else_is_read(model, truth, name):
    which = people.handles(people.SETS[name], 24, seeded())
    hidden = torch.where(which[..., None], truth.positions[:, 0], torch.nan)
    made = model.complete(hidden, which)
    assert off(poses.finished(made, hidden, which), truth)[which].max() < 1e-3
    assert off(made, truth)[which].mean() > 2e-3  # it is kinematics that does it
    assert torch.equal(made.rot, model.complete(truth.positions[:, 0], which).rot)


def test_the_network_hears_of_handles_if_it_is_told(model, truth):
    places, which = truth.positions[:, 0], people.handles(("left_wrist", "head"), 24, seeded())
    assert (model.complete(places, which).rot - model.complete(places, which & False).rot).abs().max() > 0.1
    deaf = poses.Poser(replace(SMALL, conditioned=False)).eval()
    assert torch.equal(deaf.complete(places, which).rot, deaf.complete(places, which & False).rot)


def test_numbers_are_the_pose(model, truth):
    assert off(model.decode(model.encode(truth)), truth).max() < 1e-5


def test_what_cannot_be(model, truth):
    places, which = truth.positions[:, 0], people.handles(3, 24, seeded())
    with pytest.raises(ShapeError, match="targets"):
        model.complete(places[:, :5], which)
    with pytest.raises(ShapeError, match="bool"):
        model.complete(places, which.float())
    with pytest.raises(DataError, match="not finite"):
        model.complete(torch.full_like(places, torch.inf), which)


def test_the_gaussian_against_normal_equations_and_its_draws(model, windows, truth):
    known = Known(training.stuck(windows.evenly(150)), model)
    which, places = people.handles(("head", "left_foot"), 24, seeded()), truth.positions[:, 0]
    seen, made = known._rows[0].unflatten(1, (-1, 3))[:, which[0]].flatten(1).double(), known._rows[1].double()
    x, y = seen - seen.mean(0), made - made.mean(0)
    weights = torch.linalg.solve(x.mT @ x + (len(x) - 1) * 1e-3 * torch.eye(6), x.mT @ y)
    said = made.mean(0) + (places[:, which[0]].flatten(1).double() - seen.mean(0)) @ weights
    assert off(known.gaussian(places, which, 1e-3), model.decode(said.float())).max() < 1e-4
    few, all_ = (
        torch.stack([known.gaussian(places, w, generator=seeded(k)).positions for k in range(4)]).std(0).mean()
        for w in (which, which | True)
    )
    assert few > 0.03 and all_ < 0.5 * few


def test_poses_that_are_alike_are_not_told_apart():
    one, other = (torch.randn(400, 3, generator=seeded(k)) for k in range(2))
    assert trials.told_apart(one, other).mean() == pytest.approx(0.5, abs=0.06)
    assert trials.told_apart(one.mean(0).expand(400, -1), other).mean() > 0.9
    assert trials.told_apart(other + 0.01, other).mean() == pytest.approx(0.5, abs=0.06)  # a pair is not compared
