"""The official form: structure, faults, and body. That its numbers are right, ``test_humor_parity`` shows."""

import math
from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.humor.body_shape import landmarks, offsets
from motionlab.humor.priors import Cvae
from motionlab.skeleton import STANDARD, fk
from studies.official import body as official_body
from studies.official import rollout as official_rollout
from studies.official import rotation as official_rotation
from studies.official.rotation import matrix_to_axis_angle
from tests.rolled_inputs import F64, first_states


def model(width: int = 64, dtype: torch.dtype = F64) -> Cvae:
    torch.manual_seed(0)
    made = Cvae(width).to(dtype)
    with torch.no_grad():
        made.decoder.net[-1].weight *= 0.3
    return made.frozen()


def test_clips_do_not_see_each_other(generator):
    """Three clips are the batch that the official cross product breaks."""
    net, first = model(), first_states(generator, 3)
    z = torch.randn(3, 4, 48, generator=generator, dtype=F64)
    together = official_rollout.rollout(net, first, z).states
    alone = torch.cat([official_rollout.rollout(net, first[i : i + 1], z[i : i + 1]).states for i in range(3)])
    torch.testing.assert_close(together, alone, atol=1e-12, rtol=0)


@pytest.mark.parametrize(("offset", "low", "high"), [(1e-4, 1e-3, 1.5e-3), (1e-3, 5e-4, 9e-4), (1e-2, 5e-5, 2e-4)])
def test_official_heading_is_wrong_near_zero(offset, low, high):
    turn = rotation.rotation_about("z", torch.tensor([offset], dtype=F64))
    upright = torch.tensor([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]], dtype=F64)
    left = rotation.geodesic(official_rotation.alignment(turn @ upright), turn.mT)
    assert low < left.item() < high


def test_official_heading_does_not_turn_a_body_that_faces_backwards():
    about = rotation.rotation_about("z", torch.tensor([math.pi], dtype=F64))
    upright = torch.tensor([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]], dtype=F64)
    backwards = torch.where((about @ upright).abs() < 1e-9, 0.0, about @ upright)  # exactly
    found = official_rotation.alignment(backwards)
    assert rotation.geodesic(found, torch.eye(3, dtype=F64)).item() < 1e-3
    exact = rotation.rotation_about("z", -rotation.yaw(backwards))
    assert rotation.geodesic(exact, torch.eye(3, dtype=F64)).item() == pytest.approx(math.pi, abs=1e-6)


def test_official_rotation_vector_folds_and_breaks_at_the_identity():
    aa = torch.tensor([[3.15, 0.0, 0.0], [0.5, 0.1, 0.0]], dtype=F64)
    back = official_rotation.matrix_to_axis_angle(official_rotation.pose_from_axis_angle(aa))
    assert back[0, 0].item() == pytest.approx(3.15 - 2 * math.pi, abs=1e-6)
    torch.testing.assert_close(back[1], aa[1], atol=1e-7, rtol=0)
    for at, finite in ((torch.eye(3, dtype=F64), False), (rotation.exp(aa[1]), True)):
        matrix = at.clone().requires_grad_()
        vector = official_rotation.matrix_to_axis_angle(matrix)
        assert vector.isfinite().all()
        (gradient,) = torch.autograd.grad(vector.sum(), matrix)
        assert bool(gradient.isfinite().all()) == finite
        (ours,) = torch.autograd.grad(rotation.log(matrix).sum(), matrix)
        assert ours.isfinite().all()


def test_joints_and_landmarks_are_those_of_forward_kinematics(generator):
    rot = rotation.random((2, 5, 22), generator)
    root, betas = torch.randn(2, 5, 3, generator=generator), torch.randn(2, 8, generator=generator)
    joints, turns = fk(replace(STANDARD, offsets=offsets(betas)[:, None]), root, rot)
    found = official_body.body_joints_by_lbs(root, matrix_to_axis_angle(rot), betas)
    for ours, theirs in zip(found, (joints, landmarks(joints, turns, betas)), strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)
    other, _ = official_body.body_joints_by_lbs(root, matrix_to_axis_angle(rot), betas + 0.1)
    assert (other - found[0]).abs().max() > 1e-3
