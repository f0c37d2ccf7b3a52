"""Joint angles measure what they say, and limits catch what no body does."""

import math

import pytest
import torch

from data_synth.anatomy import angles, excess
from motionlab.rotation import rotation_about
from motionlab.skeleton import STANDARD


def pose(**rotations):
    rot = torch.eye(3).expand(len(STANDARD), 3, 3).clone()
    for joint, R in rotations.items():
        rot[STANDARD.index(joint)] = R
    return rot


def about(axis, degrees):
    return rotation_about(axis, torch.tensor(math.radians(degrees)))


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    "joint, angle, factor",
    [("knee", "flexion", 1), ("hip", "flexion", -1), ("ankle", "dorsiflexion", -1), ("foot", "extension", -1)],
)
def test_sagittal_angles(side, joint, angle, factor):
    rot = pose(**{f"{side}_{joint}": about("x", 30 * factor)})
    assert float(angles(STANDARD, rot)[f"{side}_{joint}", angle]) == pytest.approx(30, abs=1e-3)


@pytest.mark.parametrize("side, sign", [("left", 1), ("right", -1)])
def test_sided_angles_mirror(side, sign):
    found = angles(STANDARD, pose(**{f"{side}_elbow": about("y", -sign * 70), f"{side}_hip": about("z", sign * 20)}))
    assert float(found[f"{side}_elbow", "flexion"]) == pytest.approx(70, abs=1e-3)
    assert float(found[f"{side}_hip", "abduction"]) == pytest.approx(20, abs=1e-3)
    assert float(found[f"{side}_hip", "rotation"]) == pytest.approx(0, abs=1e-2)
    assert float(found[f"{side}_shoulder", "rotation"]) == pytest.approx(0, abs=1e-2)


@pytest.mark.parametrize("side", ["left", "right"])
def test_turning_the_thigh_is_rotation(side):
    rot = pose(**{f"{side}_hip": about("x", -50) @ about("y", 25)})
    found = angles(STANDARD, rot)
    assert abs(float(found[f"{side}_hip", "rotation"])) == pytest.approx(25, abs=1e-2)
    assert float(found[f"{side}_hip", "flexion"]) == pytest.approx(50, abs=1e-2)


def test_a_knee_bent_backwards_or_sideways_is_caught_and_the_rest_pose_is_possible():
    beyond = excess(STANDARD, pose(left_knee=about("x", -20)))
    assert float(beyond["left_knee", "flexion"]) == pytest.approx(18, abs=1e-3)
    assert float(excess(STANDARD, pose(right_knee=about("z", 20)))["right_knee", "off hinge"]) > 15
    assert all(float(value) == 0 for value in excess(STANDARD, pose()).values())
