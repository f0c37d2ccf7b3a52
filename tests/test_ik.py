"""Handles: reached to the millimetre, by as little as can be, and no harm where they cannot be."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.errors import DataError, ShapeError
from motionlab.ik import _jacobian, reach_targets

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


def test_the_jacobian_is_autograd_s(motion):
    one = replace(motion, root=motion.root[0, :1].double(), rot=motion.rot[0, :1].double(), contacts=None,
                  skeleton=motion.clip(0).skeleton.to(torch.float64))  # fmt: skip
    handles = one.skeleton.indices(HANDLES)
    positions, turns = one.world

    def moved(turn):
        eye = torch.eye(3).double().expand_as(turns[..., :1, :, :])
        parent = torch.cat((eye, turns), -3)[..., [p + 1 for p in one.skeleton.parents], :, :]
        rot = parent.mT @ rotation.exp(turn) @ parent @ one.rot
        return replace(one, rot=rot).positions[0, handles]

    slope = torch.autograd.functional.jacobian(moved, torch.zeros(1, 22, 3).double())[:, :, 0]  # (K, 3, J, 3)
    ours = _jacobian(positions, handles, one.skeleton.ancestors()[handles].double())[0]
    assert (ours.permute(0, 2, 1, 3) - slope).abs().max() < 1e-6


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
