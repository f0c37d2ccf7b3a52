"""Measures of the cases against motions whose answer is known."""

import math
from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from data_synth.actions import ACTIONS
from motionlab import findings, rotation
from motionlab.metrics import gait
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Observation2D
from motionlab.skeleton import STANDARD, UPRIGHT
from studies.nb05_testops import measures


def gen(seed=0):
    return torch.Generator().manual_seed(seed)


def standing(frames=40, clips=2):
    rot = torch.eye(3).repeat(clips, frames, 22, 1, 1)
    rot[:, :, 0] = UPRIGHT
    root = torch.zeros(clips, frames, 3)
    root[..., 2] = float(STANDARD.standing_height())
    return Motion(STANDARD, root, rot, 30.0)


def bent(hip, knee, frames=40):
    """Standing, but with both thighs raised by ``hip`` degrees and both knees flexed by ``knee``."""
    motion = standing(frames)
    rot = motion.rot.clone()
    turn = [rotation.exp(torch.tensor([math.radians(a), 0.0, 0.0])) for a in (-hip, knee)]
    for side in ("left", "right"):
        rot[:, :, STANDARD.index(f"{side}_hip")] = turn[0]
        rot[:, :, STANDARD.index(f"{side}_knee")] = turn[1]
    return replace(motion, rot=rot)


def walking(seconds=4.0, speed=1.2):
    take = ACTIONS["walk"](scenes.person(0, gen()), gen(1), seconds=seconds, speed=speed).motion.cut(30, 90)
    return scenes.together([take, take])


def test_angles_of_a_seat():
    tilt, bend = gait.tilt_and_bend(bent(90, 80))
    rest_tilt, rest_bend = gait.tilt_and_bend(standing())
    assert ((tilt - rest_tilt) - 90).abs().max() < 3 and ((bend - rest_bend) - 80).abs().max() < 3


@pytest.mark.parametrize(("hip", "knee", "seated"), [(90, 90, 1), (90, 20, 0), (20, 90, 0), (0, 0, 0)])
def test_who_sits(hip, knee, seated):
    assert gait.sits(bent(hip, knee)).tolist() == [seated] * 2


def test_flexion_error_is_the_angle_between():
    assert measures.flexion_error(standing(), standing()).abs().max() < 1e-3
    assert (measures.flexion_error(bent(60, 30), bent(20, 10)) - 30).abs().max() < 3


def test_walking_swings_steps_and_travels():
    motion, still = walking(), standing(60)
    where = torch.ones(2, 60, dtype=torch.bool)
    assert (measures.swing(motion, where) > 0.15).all() and (measures.swing(still, where) < 1e-5).all()
    assert ((gait.cadence(motion, where) > 80) & (gait.cadence(motion, where) < 150)).all()
    assert (gait.cadence(still, where) == 0).all()
    way = (motion.root[:, -1, :2] - motion.root[:, 0, :2]).norm(dim=-1)
    assert ((measures.foot_travel(motion, where) / way - 1).abs() < 0.15).all()
    half = where & (torch.arange(60) >= 30)
    assert (measures.foot_travel(motion, half) < 0.6 * measures.foot_travel(motion, where)).all()
    assert measures.swing(motion, where & False).isnan().all()


def test_a_turned_world_changes_no_step():
    motion = walking()
    turn = rotation.rotation_about("z", torch.tensor(2.0))
    rot = motion.rot.clone()
    rot[..., 0, :, :] = turn @ rot[..., 0, :, :]
    turned = replace(motion, root=motion.root @ turn.mT, rot=rot)
    torch.testing.assert_close(gait.ahead(turned), gait.ahead(motion), atol=1e-4, rtol=0)


def test_quarters_see_growth():
    first, last = measures.quarters(torch.arange(60.0)[None])
    assert first.item() == 7.0 and last.item() == 52.0


def test_smoothing_lowers_power_and_acceleration():
    truth = scenes.film("dance", 2).truth
    assert torch.allclose(measures.acceleration_ratio(truth, truth), torch.ones(2))
    torch.testing.assert_close(measures.band_power(truth, truth), torch.ones(2, 1))
    kernel = torch.ones(9) / 9
    flat = truth.root.movedim(1, -1).reshape(-1, 1, 60)
    root = torch.nn.functional.conv1d(torch.nn.functional.pad(flat, (4, 4), mode="replicate"), kernel[None, None])
    still = truth.rot[:, :1].expand_as(truth.rot)
    calm = replace(truth, root=root.reshape(2, 3, 60).movedim(1, -1), rot=still)
    assert (measures.acceleration_ratio(calm, truth) < 0.1).all() and (measures.band_power(calm, truth) < 0.1).all()


def test_pixel_distance_weighs_by_confidence_and_ignores_neck_and_hips():
    keypoints, confidence = torch.zeros(1, 2, 25, 2), torch.zeros(1, 2, 25)
    confidence[..., 0], confidence[..., 4], confidence[..., BODY_25.index("neck")] = 1.0, 0.5, 1.0
    seen = Observation2D(keypoints, confidence, BODY_25, 30.0)
    pixels = torch.zeros(1, 2, 25, 2)
    pixels[..., 0, 0], pixels[..., 4, 1], pixels[..., BODY_25.index("neck"), 0] = 3.0, 6.0, 1000.0
    assert measures.pixel_distance(pixels, seen).item() == pytest.approx((3 + 0.5 * 6) / 1.5)


def test_paired_differences():
    x = torch.randn(200, generator=gen())
    found = findings.paired(x + 1 + 0.1 * torch.randn(200, generator=gen(1)), x, gen(2))
    assert found.low < 1 < found.high < 1.1 and found.n == 200
    assert findings.paired(torch.tensor([1.0, torch.nan, 3.0]), torch.zeros(3), gen()).n == 2
    assert str(found).startswith("+1.0")
