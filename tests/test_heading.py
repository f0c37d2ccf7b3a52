from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.heading import (
    Frame,
    heading_frame,
    local_to_world,
    local_to_world_positions,
    stuck_root,
    world_to_local,
    world_to_local_orientations,
    world_to_local_positions,
)
from motionlab.motion import fix_root_horizontally, velocity
from motionlab.skeleton import UPRIGHT
from tests.test_motion import random_motion

F64 = torch.float64


def test_heading_frame_puts_the_body_above_the_origin_facing_y(generator):
    motion = random_motion(generator, (3,))
    local = world_to_local(heading_frame(motion.root, motion.rot[..., 0, :, :]), motion)
    torch.testing.assert_close(local.root[..., :2], torch.zeros(3, 10, 2, dtype=F64))
    assert torch.equal(local.root[..., 2], motion.root[..., 2])
    right = -local.rot[..., 0, :, 0]
    assert (right[..., 1].abs() < 1e-12).all() and (right[..., 0] > 0).all()
    upright = heading_frame(torch.zeros(3), UPRIGHT)
    assert torch.equal(upright.turn, torch.eye(3))


@pytest.mark.parametrize("every", [False, True])
def test_round_trip_is_exact(generator, every):
    motion = random_motion(generator, (2, 3))
    if every:
        frame = heading_frame(motion.root, motion.rot[..., 0, :, :])
        local = world_to_local(frame, motion)
    else:
        local, frame = stuck_root(motion)
    back = local_to_world(frame, local)
    torch.testing.assert_close(back.root, motion.root, atol=1e-13, rtol=0)
    torch.testing.assert_close(back.rot, motion.rot, atol=1e-13, rtol=0)
    points = torch.randn(2, 3, 10, 5, 3, generator=generator, dtype=F64)
    there = world_to_local_positions(frame, points)
    torch.testing.assert_close(local_to_world_positions(frame, there), points, atol=1e-13, rtol=0)


def test_stuck_root_does_not_see_where_the_motion_happens(generator):
    motion = random_motion(generator)
    turn = rotation.rotation_about("z", torch.tensor(2.0, dtype=F64))
    rot = torch.cat((turn @ motion.rot[:, :1], motion.rot[:, 1:]), 1)
    moved = replace(motion, root=motion.root @ turn.mT + torch.tensor([3.0, -4.0, 0.0]), rot=rot)
    here, there = stuck_root(motion)[0], stuck_root(moved)[0]
    torch.testing.assert_close(here.positions, there.positions)
    assert (moved.positions - motion.positions).abs().max() > 1  # the control: the world frame does see it
    torch.testing.assert_close(here.root[0, :2], torch.zeros(2, dtype=F64))


def test_local_positions_commute_with_forward_kinematics_and_velocities(generator):
    motion = random_motion(generator)
    local, frame = stuck_root(motion)
    torch.testing.assert_close(world_to_local_positions(frame, motion.positions), local.positions)
    fast = velocity(motion.positions, 30.0, dim=-3)
    turned = Frame(frame.turn, torch.zeros_like(frame.shift))
    torch.testing.assert_close(world_to_local_positions(turned, fast), velocity(local.positions, 30.0, dim=-3))
    turned = world_to_local_orientations(frame, motion.world[1])
    torch.testing.assert_close(turned, local.world[1])


def test_fixed_root_keeps_height_and_pose_and_drops_contacts(generator):
    motion = random_motion(generator)
    fixed = fix_root_horizontally(motion)
    assert (fixed.root[:, :2] == 0).all() and torch.equal(fixed.root[:, 2], motion.root[:, 2])
    assert torch.equal(fixed.rot, motion.rot) and fixed.contacts is None


def test_gradients_pass(generator):
    motion = random_motion(generator)
    root = motion.root.requires_grad_()
    stuck_root(replace(motion, root=root))[0].positions.square().sum().backward()
    assert root.grad.isfinite().all() and root.grad.abs().max() > 0
