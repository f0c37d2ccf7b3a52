"""Long recordings: windows that cover them, agree where they meet, and become one motion again."""

import pytest
import torch

from motionlab import rotation
from motionlab.errors import ShapeError
from motionlab.humor import stages, state, testops, unknowns
from motionlab.humor.energies import JOINTS
from motionlab.humor.evidence import Observation3D
from motionlab.humor.rollout import rollout
from motionlab.humor.testops import Schedule
from motionlab.humor.unknowns import skeleton_of
from motionlab.skeleton import fk
from tests.fit_inputs import error, finite

LONG = Schedule(steps=(2, 3, 6), inner=8, refine=(1, 2), window=16, overlap=4)


def test_windows_cover_everything_once_planned():
    for frames in (61, 70, 110, 111, 333):
        plan = unknowns.window_starts(frames, 60, 10)
        assert plan[0] == 0 and plan[-1] == frames - 60
        steps = torch.tensor(plan).diff()
        assert (steps > 0).all() and (steps <= 50).all()
    assert unknowns.window_starts(60, 60, 10) == (0,)
    with pytest.raises(ShapeError, match="overlap"):
        unknowns.window_starts(100, 60, 60)


def test_stitching_undoes_cutting():
    x = torch.randn(2, 37, 5, generator=torch.Generator().manual_seed(0))
    starts = unknowns.window_starts(37, 16, 4)
    torch.testing.assert_close(unknowns.stitch_windows(unknowns.cut_windows(x, starts, 16), starts), x)
    turns = rotation.random((2, 37, 4), torch.Generator().manual_seed(1))
    again = unknowns.stitch_windows(unknowns.cut_windows(turns, starts, 16), starts)
    torch.testing.assert_close(again, turns, atol=1e-5, rtol=0)


def test_windows_that_disagree_are_blended_evenly():
    """Two windows of 6 frames share 4: 0 and 1 meet in fifths, and turns of 0 and 100 degrees in steps of 20."""
    between = torch.tensor([0, 0, 0.2, 0.4, 0.6, 0.8, 1, 1])
    x = torch.stack((torch.zeros(1, 6, 1), torch.ones(1, 6, 1)), 1)
    torch.testing.assert_close(unknowns.stitch_windows(x, (0, 2))[0, :, 0], between)
    turns = rotation.rotation_about("z", torch.deg2rad(100 * x))  # (1, 2, 6, 1, 3, 3)
    found = unknowns.stitch_windows(turns, (0, 2))
    torch.testing.assert_close(found[0, :, 0], rotation.rotation_about("z", torch.deg2rad(100 * between)))


# --------------------------------------------------------------------------------- what it costs windows to disagree
def test_every_pair_of_neighbours_counts_with_the_frames_it_shares():
    """Windows at 0, 8 and 17 of 16 frames: the middle one, 0.1 m off along each axis, shares 8 frames with the one
    before and 7 with the one after. A recording costs what it costs, whoever is next to it."""
    whole = torch.randn(2, 33, 22, 3, generator=torch.Generator().manual_seed(0))
    cut = unknowns.cut_windows(whole, (0, 8, 17), 16)
    cut[1, 1] += 0.1
    found = stages._overlap(cut.flatten(0, 1), (0, 8, 17))
    torch.testing.assert_close(found, torch.tensor([0.0, 0.5 * 15 * 22 * 3 * 0.01]), atol=1e-4, rtol=0)


# ------------------------------------------------------------------------------------------------------------ in a fit
@pytest.fixture(scope="module")
def seen(walk):
    """Joints with noise of 3 cm, the legs never seen: what two windows make of them, nothing but their overlap ties."""
    noise = 0.03 * torch.randn(walk.positions.shape, generator=torch.Generator().manual_seed(0))
    return Observation3D(walk.positions + noise, walk.positions[..., 2] > 0.9, walk.fps)


@pytest.fixture(scope="module")
def fitted(kit, seen):
    return testops.fit(seen, kit, schedule=LONG)


def bodies(kit, fitted):
    """The windows' own joints (G W, L, 22, 3), rolled out again from what the fit returns."""
    first, z = fitted.first.flatten(0, 1), fitted.z.flatten(0, 1)
    states = state.unpack(torch.cat((first[:, None], rollout(kit.motion, first, z).states), 1))
    rot = torch.cat((states["root_orient"][..., None, :, :], states["pose_body"]), -3)
    betas = fitted.betas.repeat_interleave(len(fitted.starts), 0)
    return fk(skeleton_of(betas), states["trans"], rot)[0]


def gap(kit, fitted):
    """Mean distance (G,) between the joints of two windows in the frames they share, metres."""
    before, after = bodies(kit, fitted).unflatten(0, (-1, 2)).unbind(1)
    return (before[:, 8:] - after[:, :8]).norm(dim=-1).mean((1, 2))


def test_long_recordings_are_cut_and_stitched(fitted, walk):
    assert fitted.starts == (0, 8)
    assert fitted.motion.frames == 24 and fitted.z.shape == (2, 2, 15, 48)
    assert finite(fitted)
    assert (fitted.motion.rot @ fitted.motion.rot.mT - torch.eye(3)).abs().max() < 1e-4
    assert (error(fitted.motion, walk) < 0.1).all()
    assert fitted.motion.root.diff(dim=1).norm(dim=-1).max() < 0.06  # twice the walk's: no jump where windows meet


def test_the_energy_says_what_disagreement_costs(kit, fitted):
    """Twice the weight of joint_consistency: 2 for joints."""
    cost = 2.0 * JOINTS.joint_consistency[2] * stages._overlap(bodies(kit, fitted), fitted.starts)
    assert (cost > 1e-3).all()
    torch.testing.assert_close(fitted.energies[3]["overlap"], cost, rtol=1e-2, atol=1e-4)


def test_windows_agree_where_they_meet(kit, seen, fitted, monkeypatch):
    """They would be more than twice as far apart if nothing asked them to agree."""
    monkeypatch.setattr(stages, "_OVERLAP", 0.0)
    free = testops.fit(seen, kit, schedule=LONG)
    assert (free.energies[3]["overlap"] == 0).all()
    assert (gap(kit, fitted) < 0.03).all()
    assert (gap(kit, fitted) < 0.5 * gap(kit, free)).all(), (gap(kit, fitted), gap(kit, free))
