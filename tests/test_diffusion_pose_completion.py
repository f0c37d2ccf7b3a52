"""Pose completion: handles met, free joints free, and the completions that need no network."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.diffusion import denoiser, pose_completion, training
from motionlab.diffusion.losses import LossWeights
from motionlab.diffusion.model import DenoiserRecipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError, ShapeError
from motionlab.heading import stuck_root
from motionlab.skeleton import STANDARD
from studies.nb14_completion import known_poses, measures, trials
from tests.draws import seeded

POSES = DenoiserRecipe(
    size="tiny", frames=1, contacts=False, linear=True, dropout=0.0, noising=100, steps=60, batch=32, lr=5e-3,
    warm_up=20, average=0.97, weights=LossWeights(fk=0.05, velocity=0.0, late=0.1), seed=5,
)  # fmt: skip
FIVE = trials.SETS["five effectors"]


@pytest.fixture(scope="module")
def windows():
    clips = scenes.held_out(8)
    return gather([on_standard(replace(clips.clip(i), contacts=None)) for i in range(8)], 1)


@pytest.fixture(scope="module")
def models(windows):
    """A model of poses, and one that hears of handles."""
    with pytest.MonkeyPatch.context() as m:
        m.setitem(denoiser.SIZES, "tiny", {"size": 32, "layers": 1, "heads": 2, "hidden": 32})
        heard = replace(POSES, handles=16, weights=replace(POSES.weights, handles=20.0))
        return [training.DenoiserTraining(recipe, windows).run().shipped for recipe in (POSES, heard)]


@pytest.fixture(scope="module")
def truth(windows):
    """Poses (24, 1), stuck, on the standard body."""
    return stuck_root(replace(windows.evenly(24), skeleton=STANDARD))[0]


# ------------------------------------------------------------------------------------------------- with a network
@pytest.mark.parametrize(("which_model", "name"), [(0, "five effectors"), *((1, name) for name in trials.SETS)])
def test_handles_are_met_to_the_millimetre(models, truth, name, which_model):
    joints = truth.positions[:, 0]
    which = trials.chosen_handles(trials.SETS[name], len(joints), seeded())
    made = pose_completion.complete(models[which_model], joints, which, seeded(), steps=20)
    assert made.root.shape == (24, 1, 3) and made.rot.isfinite().all()
    assert (made.rot @ made.rot.mT - torch.eye(3)).abs().max() < 1e-4
    assert measures.missed(made, joints, which).nan_to_num().max() < 1e-3
    rough = pose_completion.complete(models[which_model], joints, which, seeded(), steps=20, finish=False)
    assert measures.missed(rough, joints, which).nanmean() > 2e-3  # it is the finish that does it


def test_completions_follow_the_generator_and_the_handles_alone(models, truth):
    joints = truth.positions[:, 0]
    which = trials.chosen_handles(FIVE, len(joints), seeded())
    hidden = torch.where(which[..., None], joints, torch.nan)
    one, same, other = (
        pose_completion.complete(models[1], targets, which, seeded(s), steps=10)
        for targets, s in ((joints, 0), (hidden, 0), (joints, 1))
    )
    assert torch.equal(one.rot, same.rot)
    assert not torch.allclose(one.rot, other.rot, atol=1e-2)


def test_the_pull_is_the_slope_of_the_missing_way(models, truth):
    """Against differences, in float64: d/dx_t of the handles' squared distances after the network."""
    model = models[0]
    joints = truth.positions[:1, 0].double()
    which = trials.chosen_handles(("left_wrist",), 1, seeded())
    inner = replace(model, denoiser=model.denoiser.double())
    try:
        x, stamps, weight = model.encode(truth.clip(slice(0, 1))).double() + 0.3, torch.tensor([40]), 7.0
        pulled = pose_completion._pulled(inner.denoiser, inner, joints, which, weight)(x, stamps)
        plain = inner.denoiser(x, stamps)

        def far(at):
            return (inner.decode(inner.denoiser(at, stamps)).positions[:, 0] - joints)[which].square().sum()

        for column in (1, 5, 20, 100):
            step = torch.zeros_like(x)
            step[..., column] = 1e-5
            slope = (far(x + step) - far(x - step)) / 2e-5
            expected = weight * inner.schedule.alpha_bar[40].sqrt() / 2 * slope
            assert (plain - pulled)[0, 0, column] == pytest.approx(expected.item(), rel=1e-4, abs=1e-9)
    finally:
        model.denoiser.float()


# --------------------------------------------------------------------------------------------- rotations that stay
def test_kept_chains_keep_the_handles_but_for_the_height(models, truth):
    which = trials.chosen_handles(("left_wrist", "head"), len(truth.root), seeded())
    which[:12, 0] = True  # the pelvis of half of them
    at = which.clone()
    made = pose_completion.keep(models[0], truth, which, seeded())
    off = (made.positions - truth.positions)[:, 0]
    assert off[:12][at[:12]].abs().max() < 1e-4
    assert (off - off[:, :1])[at].abs().max() < 1e-4 and off[..., :2][at].abs().max() < 1e-3
    assert off[12:, 0, 2].abs().max() > 1e-3 and measures.unobserved(made, truth, which).min() > 0.02
    loose = pose_completion.keep(models[0], truth, which, seeded(), chains=False)
    assert rotation.geodesic(loose.rot, truth.rot)[:, 0][which].max() < 1e-2
    assert measures.missed(loose, truth.positions[:, 0], which)[:, 1:].nanmean() > 0.02


def test_what_cannot_be(models, truth, windows):
    joints, which = truth.positions[:, 0], trials.chosen_handles(3, 24, seeded())
    with pytest.raises(ShapeError, match="targets"):
        pose_completion.complete(models[0], joints[:, :5], which, seeded())
    with pytest.raises(ShapeError, match="bool"):
        pose_completion.complete(models[0], joints, which.float(), seeded())
    with pytest.raises(DataError, match="not finite"):
        pose_completion.complete(models[0], torch.full_like(joints, torch.inf), which, seeded())
    with pytest.raises(DataError, match="60 frames"):
        pose_completion.complete(
            replace(models[0], recipe=replace(models[0].recipe, frames=60)), joints, which, seeded()
        )


# ---------------------------------------------------------------------------------------------- without a network
@pytest.fixture(scope="module")
def library(windows):
    return known_poses.known(replace(windows.evenly(150), skeleton=STANDARD))


def test_ridge_regression_against_its_normal_equations(library, truth):
    """For one subset: the weights that least squares with a penalty finds, on centred numbers."""
    which = trials.chosen_handles(("head", "left_foot"), 24, seeded())
    joints = truth.positions[:, 0]
    sixd = rotation.matrix_to_sixd(library.poses.rot[:, 0]).flatten(1)
    made = torch.cat((library.poses.root[:, 0], sixd), -1).double()
    seen = library.joints[:, which[0]].flatten(1).double()
    x, y = seen - seen.mean(0), made - made.mean(0)
    weights = torch.linalg.solve(x.mT @ x + len(x) * 1e-3 * torch.eye(6).double(), x.mT @ y)
    said = made.mean(0) + (joints[:, which[0]].flatten(1).double() - seen.mean(0)) @ weights
    found = library.regressed(torch.where(which[..., None], joints, torch.nan), which, ridge=1e-3)
    assert (found.root[:, 0] - said[:, :3]).abs().max() < 1e-5
    assert (found.rot[:, 0] - rotation.sixd_to_matrix(said[:, 3:].unflatten(-1, (-1, 6)))).abs().max() < 1e-4
