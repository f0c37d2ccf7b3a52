"""Handles: reached to the millimetre, by as little as can be, and no harm where they cannot be."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.diffusion.reach import _above, _jacobian, reach
from motionlab.errors import DataError, ShapeError

HANDLES = ["left_wrist", "right_ankle", "head"]


@pytest.fixture(scope="module")
def motion():
    return scenes.held_out(2).cut(0, 6)


def targets(motion, generator, size=0.1):
    """Where the handles are in another pose, so that they can be reached with the pelvis where it is."""
    turn = rotation.exp(size * torch.randn(*motion.rot.shape[:-2], 3, generator=generator))
    other = replace(motion, rot=motion.rot @ turn)
    return other.positions[..., motion.skeleton.indices(HANDLES), :]


@pytest.mark.parametrize("moves_root", [True, False])
def test_handles_arrive(motion, generator, moves_root):
    goal = targets(motion, generator)
    found = reach(motion, HANDLES, goal, moves_root=moves_root)
    gap = (found.positions[..., motion.skeleton.indices(HANDLES), :] - goal).norm(dim=-1)
    assert gap.max() < 1e-3
    assert moves_root != torch.equal(found.root, motion.root)
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
    ours = _jacobian(positions, handles, _above(one.skeleton, handles).double())[0]
    assert (ours.permute(0, 2, 1, 3) - slope).abs().max() < 1e-6


def test_one_small_step_is_the_smallest(motion, generator):
    """Of all small changes that close the gap, the pseudo-inverse's is the shortest: a detour is longer."""
    goal = targets(motion, generator, 0.01)
    found = reach(motion, HANDLES, goal, steps=1, damping=1e-9, moves_root=False)
    size = rotation.geodesic(found.rot, motion.rot).square().sum()
    detour = replace(
        motion, rot=motion.rot @ rotation.exp(0.02 * torch.randn(*motion.rot.shape[:-2], 3, generator=generator))
    )
    other = reach(detour, HANDLES, goal, steps=5, damping=1e-9, moves_root=False)
    assert size < 0.5 * rotation.geodesic(other.rot, motion.rot).square().sum()


def test_free_handles_and_far_targets(motion, generator):
    goal = targets(motion, generator)
    goal[..., 1, :] = torch.nan
    only = reach(motion, HANDLES, goal, moves_root=False)
    near = (only.positions[..., motion.skeleton.indices(HANDLES), :] - goal).norm(dim=-1)
    assert near[..., [0, 2]].max() < 1e-3
    far = torch.full_like(goal, 50.0)
    gone = reach(motion, HANDLES, far, moves_root=False, steps=30)
    before, after = (m.positions[..., motion.skeleton.indices(HANDLES), :] for m in (motion, gone))
    assert ((after - far).norm(dim=-1).sum(-1) < (before - far).norm(dim=-1).sum(-1)).all()
    nothing = reach(motion, HANDLES, torch.full_like(goal, torch.nan))
    assert (nothing.positions - motion.positions).abs().max() < 1e-5


def test_what_cannot_be(motion):
    with pytest.raises(ShapeError):
        reach(motion, HANDLES, torch.zeros(2, 6, 2, 3))
    with pytest.raises(KeyError):
        reach(motion, ["tail"], torch.zeros(2, 6, 1, 3))
    with pytest.raises(DataError):
        broken = replace(motion, root=torch.full_like(motion.root, torch.nan))
        reach(broken, HANDLES, torch.zeros(2, 6, 3, 3))
