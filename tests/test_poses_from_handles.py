"""Poses from handles: what is read, kept and reached; rivals by hand."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab.diffusion import poses
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError, ShapeError
from studies.nb14_handles import people, training
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
    with pytest.raises(DataError, match="not finite"):
        model.complete(torch.full_like(places, torch.inf), which)
