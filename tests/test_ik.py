"""Handles: reached to the millimetre, by as little as can be, and no harm where they cannot be."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.errors import DataError, ShapeError
from motionlab.ik import reach_targets

HANDLES = ["left_wrist", "right_ankle", "head"]


@pytest.fixture(scope="module")
def motion():
    return scenes.held_out(2).cut(0, 6)


def targets(motion, generator, size=0.1):
    """Where the handles are in another pose, so that they can be reached with the pelvis where it is."""
    turn = rotation.exp(size * torch.randn(*motion.rot.shape[:-2], 3, generator=generator))
    other = replace(motion, rot=motion.rot @ turn)
    return other.positions[..., motion.skeleton.indices(HANDLES), :]


def test_handles_arrive(motion, generator):
    goal = targets(motion, generator)
    found = reach_targets(motion, HANDLES, goal)
    gap = (found.positions[..., motion.skeleton.indices(HANDLES), :] - goal).norm(dim=-1)
    assert gap.max() < 1e-3
    eye = found.rot @ found.rot.mT - torch.eye(3)
    assert eye.abs().max() < 1e-5


def test_free_handles_and_far_targets(motion, generator):
    goal = targets(motion, generator)
    goal[..., 1, :] = torch.nan
    only = reach_targets(motion, HANDLES, goal)
    near = (only.positions[..., motion.skeleton.indices(HANDLES), :] - goal).norm(dim=-1)
    assert near[..., [0, 2]].max() < 1e-3
    far = torch.full_like(goal, 50.0)
    gone = reach_targets(motion, HANDLES, far, steps=30)
    before, after = (m.positions[..., motion.skeleton.indices(HANDLES), :] for m in (motion, gone))
    assert ((after - far).norm(dim=-1).sum(-1) < (before - far).norm(dim=-1).sum(-1)).all()
    nothing = reach_targets(motion, HANDLES, torch.full_like(goal, torch.nan))
    assert (nothing.positions - motion.positions).abs().max() < 1e-5


def test_what_cannot_be(motion):
    with pytest.raises(ShapeError):
        reach_targets(motion, HANDLES, torch.zeros(2, 6, 2, 3))
    with pytest.raises(KeyError):
        reach_targets(motion, ["tail"], torch.zeros(2, 6, 1, 3))
    with pytest.raises(DataError):
        broken = replace(motion, root=torch.full_like(motion.root, torch.nan))
        reach_targets(broken, HANDLES, torch.zeros(2, 6, 3, 3))
