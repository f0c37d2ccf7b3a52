"""The full body of the official form: joints where forward kinematics has them, at the price of a mesh."""

from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.humor.body_shape import landmarks, offsets
from motionlab.skeleton import STANDARD, fk
from studies.official import body as official_body
from studies.official.rotation import matrix_to_axis_angle


@pytest.fixture
def posed(generator):
    rot = rotation.random((2, 5, 22), generator)
    return torch.randn(2, 5, 3, generator=generator), rot, torch.randn(2, 8, generator=generator)


def by_kinematics(root, rot, betas):
    joints, turns = fk(replace(STANDARD, offsets=offsets(betas)[:, None]), root, rot)
    return joints, landmarks(joints, turns, betas)


def test_joints_and_landmarks_are_those_of_forward_kinematics(posed):
    root, rot, betas = posed
    found = official_body.body_joints_by_lbs(root, matrix_to_axis_angle(rot), betas)
    for ours, theirs in zip(found, by_kinematics(root, rot, betas), strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)
    other, _ = official_body.body_joints_by_lbs(root, matrix_to_axis_angle(rot), betas + 0.1)
    assert (other - found[0]).abs().max() > 1e-3
