"""Capture: lines of sight against a slow twin, scenes with a known answer, and confidence that keeps its word."""

import numpy as np
import pytest
import torch

from data_synth import capture, occluders
from data_synth.body import capsule_body
from data_synth.sight import gap_to
from motionlab import rotation
from motionlab.body import lbs
from motionlab.errors import NotConverged, ShapeError
from motionlab.motion import Motion
from motionlab.observation import BODY_25, look_at
from motionlab.skeleton import STANDARD, UPRIGHT
from tests.draws import seeded

K = {name: k for k, name in enumerate(BODY_25)}
FEET = [K[n] for n in BODY_25 if any(part in n for part in ("knee", "ankle", "toe", "heel"))]


@pytest.fixture(scope="module")
def body():
    return capsule_body(0.05)


def standing(frames=4, turn=0.0, speed=0.0):
    """Arms down, facing +y turned by ``turn`` radians, sliding along x at ``speed`` m/s."""
    rot = torch.eye(3).repeat(frames, 22, 1, 1)
    down = rotation.rotation_about("z", torch.tensor(-1.2))
    rot[:, 16], rot[:, 17] = down, down.mT
    rot[:, 0] = rotation.rotation_about("z", torch.as_tensor(turn).expand(frames)) @ UPRIGHT
    root = torch.zeros(frames, 3)
    root[:, 0], root[:, 2] = speed * (torch.arange(frames) - frames / 2) / 30, STANDARD.standing_height()
    return Motion(STANDARD, root, rot, 30.0)


def from_south(distance=4.0, height=1.2):
    """On the -y side: sees the back of somebody who faces +y, with +x to the right."""
    return look_at(
        torch.tensor([0.0, -distance, height]), torch.tensor([0.0, 0.0, 1.0]), focal=800.0, width=1280, height=960
    )


def slow_gap(vertices, faces, eye, target):
    """Moeller-Trumbore over every triangle for one line: the naive twin."""
    way = target - eye
    a, b, c = vertices[faces].transpose(1, 0, 2)
    cross = np.cross(way, c - a)
    det = ((b - a) * cross).sum(-1)
    u = ((eye - a) * cross).sum(-1) / det
    q = np.cross(eye - a, b - a)
    v, t = (q @ way) / det, ((c - a) * q).sum(-1) / det
    hits = t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)]
    return (1 - hits.min()) * np.linalg.norm(way) if len(hits) else -np.inf


def test_gap_of_many_frames_in_one_scene_is_that_of_each_alone(body):
    motion, eye = standing(5, torch.linspace(0, 5, 5), 9.0), torch.tensor([0.5, -4.0, 1.7])
    vertices = lbs(body, STANDARD, motion.root, motion.rot)
    targets = capture.keypoints(motion, body)
    gap, _ = gap_to(vertices, body.faces, eye, targets)
    slow = [
        [slow_gap(v.double().numpy(), body.faces.numpy(), eye.double().numpy(), p.double().numpy()) for p in row]
        for v, row in zip(vertices, targets, strict=True)
    ]
    assert np.abs(gap.clamp(min=0).numpy() - np.maximum(slow, 0)).max() < 2e-3


def test_keypoints_are_joints_and_vertices(body):
    motion = standing(3, 0.7)
    points = capture.keypoints(motion, body)
    assert torch.equal(points[:, K["mid_hip"]], motion.positions[:, 0])
    assert torch.equal(points[:, K["left_knee"]], motion.positions[:, STANDARD.index("left_knee")])
    vertices = lbs(body, STANDARD, motion.root, motion.rot)
    assert (points[:, K["nose"]] - vertices[:, body.keypoint_vertices["nose"]]).abs().max() < 1e-5


@pytest.mark.parametrize("turn, near, far", [(np.pi / 2, "left", "right"), (-np.pi / 2, "right", "left")])
def test_the_far_side_is_behind_the_near_side(body, turn, near, far):
    visible = capture.observe(standing(1, turn), body, from_south(), seeded())[1].visible[0]
    assert not visible[[K[f"{far}_{part}"] for part in ("shoulder", "elbow", "hip", "knee")]].any()
    # the near hip lies behind the near hand of somebody whose arms hang down
    assert visible[[K[f"{near}_{part}"] for part in ("shoulder", "elbow", "wrist", "knee")]].all()


def test_a_wall_hides_what_is_behind_it_and_nothing_in_front(body):
    for y, hides in ((-1.0, True), (1.0, False)):
        seen, truth = capture.observe(standing(), body, from_south(), seeded(), [occluders.wall((-2, y), (2, y))])
        assert (not seen.visible.any() and not truth.visible.any()) == hides
        assert (truth.clear == (0.0 if hides else 1.0)).all()


def test_scenes_hide_what_they_say(body):
    walk, camera = standing(40, -np.pi / 2, 3.0), from_south(6.0)
    desk = capture.observe(walk, body, camera, seeded(), [occluders.desk_before(walk, camera)])[1]
    assert not desk.visible[:, FEET].any() and (desk.clear[:, K["nose"]] == 1).all()
    assert (capture.observe(walk, body, camera, seeded(), [table(-2.0)])[1].clear[:, FEET] > 0.5).any()


def table(y):
    """Open below: no desk."""
    legs = [((sx * 0.75, sy * 0.35, 0.355), (0.06, 0.06, 0.71)) for sx in (-1, 1) for sy in (-1, 1)]
    return occluders._boxes([((0, 0, 0.73), (1.6, 0.8, 0.04)), *legs], 0.0, y, 0.0)


def test_outside_the_image_is_undetected(body):
    camera = look_at(torch.tensor([0.0, -2.0, 1.6]), torch.tensor([0.0, 0.0, 1.6]), focal=900.0, width=800, height=600)
    seen, _ = capture.observe(standing(), body, camera, seeded())
    assert not seen.visible[:, FEET].any() and seen.visible[:, K["neck"]].all()
    assert (seen.keypoints[~seen.visible] == 0).all()
    away = look_at(torch.tensor([0.0, -2.0, 1.0]), torch.tensor([0.0, -9.0, 1.0]), focal=900.0, width=800, height=600)
    assert not capture.observe(standing(), body, away, seeded())[0].visible.any()


@pytest.fixture(scope="module")
def long_shot(body):
    somebody = standing(300, torch.linspace(0, 40, 300))
    return capture.observe(somebody, body, from_south(4.0), seeded(1), [table(-1.0)], correlation=0.0)


def calibration(confidence, hit):
    """Largest distance in standard errors between confidence and the share of hits over ten bins; the shares."""
    worst, shares = 0.0, []
    for rows in confidence.argsort().chunk(10):
        c, share = confidence[rows].mean(), hit[rows].float().mean()
        worst = max(worst, abs(share - c) / (c * (1 - c) / len(rows)).sqrt())
        shares.append(float(share))
    return worst, shares


def test_confidence_is_the_probability_of_a_hit(long_shot):
    observation, truth = long_shot
    error = (observation.keypoints - truth.pixels).norm(dim=-1)
    confidence, hit = (x[observation.visible] for x in (observation.confidence, error < truth.near[:, None]))
    worst, shares = calibration(confidence, hit)
    assert worst < 4 and shares == sorted(shares) and shares[0] < 0.4 < 0.9 < shares[-1]
    shuffled = confidence[torch.randperm(len(confidence), generator=seeded())]
    assert calibration(shuffled, hit)[0] > 10, "negative control"


def test_errors_have_their_sigma(long_shot):
    observation, truth = long_shot
    unit = ((observation.keypoints - truth.pixels) / truth.sigma[..., None])[observation.visible]
    assert abs(unit.std() - 1) < 0.03 and abs(unit.mean()) < 0.03


def test_what_makes_noise_larger(body):
    def sigma(camera, *things, **motion):
        return capture.observe(standing(8, np.pi, **motion), body, camera, seeded(), things)[1].sigma

    near, far = sigma(from_south(3.0)), sigma(from_south(9.0))
    assert (near > 1.8 * far).float().mean() > 0.9, "a larger image has larger errors in pixels"
    assert (sigma(from_south(), speed=12.0) > 1.3 * sigma(from_south())).all(), "motion blur"
    assert near[:, K["mid_hip"]].mean() > 2 * near[:, K["nose"]].mean(), "a hip is harder than a nose"
    edge = occluders.wall((-2, -1), (0.0, -1))
    assert (sigma(from_south(), edge) > 1.5 * sigma(from_south()))[:, K["neck"]].all(), "covered in part"


@pytest.mark.parametrize("seed", range(8))
def test_a_drawn_camera_keeps_everybody_in_view(body, seed):
    motion = standing(30, torch.linspace(0, 3, 30), 2.0)
    camera = capture.frame_motion(motion, seeded(seed))
    pixels = capture.observe(motion, body, camera, seeded())[1].pixels
    inside = (pixels > 0) & (pixels < torch.tensor([camera.width, camera.height]))
    assert inside.all() and 0.8 - 1e-4 <= camera.centre[2] <= 2.2 + 1e-4
    assert torch.equal(capture.frame_motion(motion, seeded(seed)).centre, camera.centre)
    assert not torch.equal(capture.frame_motion(motion, seeded(seed + 100)).centre, camera.centre)


def test_wrong_use_is_named():
    with pytest.raises(NotConverged, match="200 m"):
        capture.frame_motion(standing(speed=1e5), seeded())
    above = look_at(torch.tensor([0.0, 0.0, 5.0]), torch.tensor([0.0, 1.0, 0.0]), focal=800.0, width=640, height=480)
    for camera in (from_south(0.8), above):
        with pytest.raises(ShapeError, match="no room"):
            occluders.desk_before(standing(), camera)
