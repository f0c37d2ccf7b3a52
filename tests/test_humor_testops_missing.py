"""What a fit makes of what was not seen: joints, frames, ends, people who leave the image, whole clips.

Bounds are set between what a fit finds and what a broken one (the controls) does. The walk's root moves up to 2.9 cm
from frame to frame.
"""

from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.humor import start as starts
from motionlab.humor import testops
from motionlab.humor.energies import JOINTS, RGB_LIGHT
from motionlab.humor.evidence import Observation3D, evidence
from motionlab.humor.stages import Problem
from motionlab.humor.testops import Schedule
from motionlab.skeleton import STANDARD, UPRIGHT
from tests.fit_inputs import QUICK, error, errors, finite, joints, keypoints

FEET = STANDARD.indices(["left_ankle", "right_ankle", "left_foot", "right_foot"])


@pytest.fixture(scope="module")
def filmed(walk, camera):
    return keypoints(walk, camera)


@pytest.fixture(scope="module")
def whole(kit, walk):
    """The fit of all joints."""
    return testops.fit(joints(walk), kit, schedule=QUICK)


@pytest.fixture(scope="module")
def whole_film(kit, filmed):
    """The fit of all keypoints."""
    return testops.fit(filmed, kit, schedule=QUICK)


def without(walk, frames):
    """Joints (B, T, 22) hidden in some frames."""
    hidden = torch.zeros(walk.positions.shape[:-1], dtype=torch.bool)
    hidden[:, frames] = True
    return hidden


def speed(motion):
    """The root's greatest step (B,) from frame to frame, metres."""
    return motion.root.diff(dim=1).norm(dim=-1).amax(1)


# -------------------------------------------------------------------------------------------------------------- starts
def test_unknown_frames_are_interpolated_and_ends_hold():
    gen = torch.Generator().manual_seed(0)
    known = torch.zeros(1, 9, dtype=torch.bool)
    known[0, [2, 6]] = True
    trans, turn = torch.randn(1, 9, 3, generator=gen), rotation.random((1, 9), gen)
    found, turned = starts.interpolate_unseen(trans, turn, known, 30.0)
    share = torch.tensor([0, 0, 0, 0.25, 0.5, 0.75, 1, 1, 1])
    torch.testing.assert_close(found[0], torch.lerp(trans[0, 2], trans[0, 6], share[:, None]))
    whole = rotation.geodesic(turn[0, 2], turn[0, 6])
    torch.testing.assert_close(rotation.geodesic(turn[0, 2], turned[0]), share * whole, atol=1e-3, rtol=0)


# --------------------------------------------------------------------------------------------------------------- joints
@pytest.mark.parametrize(("frames", "broken"), [(range(5), False), (range(5, 13), False), (range(5, 13), True)])
def test_missing_frames_continue_what_is_around_them(kit, walk, whole, frames, broken, monkeypatch):
    """Nothing jumps; and the rest is found as well as without the gap. A start that fills no gap misses this."""
    if broken:
        monkeypatch.setattr(starts, "interpolate_unseen", lambda trans, turn, known, fps: (trans, turn))
    frames = list(frames)
    fitted = testops.fit(joints(walk, without(walk, frames)), kit, schedule=QUICK)
    seen = [t for t in range(24) if t not in frames]
    moved = torch.stack([speed(fitted.stages[stage]) for stage in (1, 2, 3)])
    lost = torch.stack([errors(fitted.stages[stage], walk)[:, frames].mean(1) for stage in (2, 3)])
    assert finite(fitted)
    if broken:
        assert (moved > 0.3).any() and (lost > 0.3).any()
        return
    assert (moved[:2] < 0.04).all() and (moved[2] < 0.08).all()
    assert fitted.motion.positions.diff(dim=1).norm(dim=-1).max() < 0.16  # of a joint; 0.095 in the walk
    assert (lost < 0.25).all()
    for stage, more in ((2, 0.015), (3, 0.05)):
        here, there = (errors(f.stages[stage], walk)[:, seen].mean(1) for f in (fitted, whole))
        assert (here < there + more).all()


@pytest.mark.parametrize("control", [False, True])
def test_legs_never_seen_stand_on_the_floor(kit, walk, control):
    """Which the priors know, given time; without them (the control) feet are drawn up."""
    walk = walk.cut(0, 12)
    hidden = walk.positions[..., 2] < 0.9
    weights = replace(JOINTS, **dict.fromkeys(("pose_prior", "motion_prior", "init_motion_prior"), (0.0, 0.0, 0.0)))
    time = Schedule(steps=(2, 4, 5), inner=20, refine=(2, 3))
    fitted = testops.fit(joints(walk, hidden), kit, schedule=time, weights=weights if control else None)
    lower = fitted.motion.positions[..., FEET, 2].amin(-1)  # of the lower foot, in every frame
    wrong = (fitted.motion.positions - walk.positions).norm(dim=-1)
    assert wrong[~hidden].mean() < 0.05
    if control:
        assert lower.max() > 0.1 and wrong[hidden].mean() > 0.13
    else:
        assert -0.04 < lower.min() and lower.max() < 0.08 and wrong[hidden].mean() < 0.12


def test_a_single_joint_is_followed_by_an_upright_body(kit, walk):
    """The pelvis alone, 6 m away from where a fit without orientation begins."""
    points = walk.positions + torch.tensor([5.0, -3.0, 0.0])
    visible = torch.zeros(points.shape[:-1], dtype=torch.bool)
    visible[..., 0] = True
    fitted = testops.fit(Observation3D(points, visible), kit, schedule=QUICK)
    assert finite(fitted)
    assert ((fitted.motion.root - points[:, :, 0]).norm(dim=-1).mean(1) < 0.2).all()
    assert (fitted.motion.rot[:, :, 0, 2, 1] > 0.85).all()  # the body's own up is within 30 degrees of it


@pytest.mark.parametrize("frames", [1, 2])
def test_short_clips(kit, walk, frames):
    clip = walk.cut(0, frames)
    fitted = testops.fit(joints(clip), kit, schedule=QUICK)
    assert finite(fitted)
    assert fitted.motion.frames == frames
    assert (3 in fitted.stages) == (frames > 1)
    assert any("one frame" in note for note in fitted.notes) == (frames == 1)
    assert (error(fitted.motion, clip) < 0.04).all()


# ------------------------------------------------------------------------------------------------------- nobody is seen
@pytest.mark.parametrize("kind", ["joints", "keypoints"])
def test_somebody_never_seen_stands_at_the_origin_and_leaves_neighbours_alone(
    kit, walk, filmed, whole, whole_film, kind
):
    """The second of two clips. Stages 1 and 2 leave it standing; stage 3 goes on as the motion prior would."""
    hidden = torch.zeros(walk.positions.shape[:-1], dtype=torch.bool)
    hidden[1] = True
    confidence = filmed.confidence.clone()
    confidence[1] = 0
    seen, full = {
        "joints": (joints(walk, hidden), whole),
        "keypoints": (replace(filmed, confidence=confidence), whole_film),
    }[kind]
    fitted = testops.fit(seen, kit, schedule=QUICK)
    assert finite(fitted)
    for stage in (1, 2, 3):
        torch.testing.assert_close(fitted.stages[stage].positions[0], full.stages[stage].positions[0])
    start = torch.tensor([0.0, 0.0, STANDARD.standing_height()])
    for stage in (1, 2):
        found = fitted.stages[stage].clip(1)
        torch.testing.assert_close(found.root, start.expand(24, 3))
        torch.testing.assert_close(found.rot[:, 0], UPRIGHT.expand(24, 3, 3))
        assert -0.01 < found.positions[..., 2].min() < 0.05
    found = fitted.motion.clip(slice(1, 2))
    assert (found.root[0, 0] - start).norm() < 0.02
    assert speed(found) < 0.06 and found.positions[..., 2].min() > -0.1


# ------------------------------------------------------------------------------------------------------------ keypoints


def test_numbers_that_are_none_count_as_not_seen(kit, walk, filmed):
    points, confidence = filmed.keypoints.clone(), filmed.confidence.clone()
    points[:, 3] = torch.nan
    confidence[:, 4, :5] = torch.inf
    confidence[:, 5, :5] = -1.0
    clean = filmed.confidence.clone()
    clean[:, 3] = clean[:, 4:6, :5] = 0.0
    seen = replace(filmed, keypoints=points, confidence=confidence)
    found, same = evidence(seen), evidence(replace(filmed, confidence=clean))
    assert torch.equal(found.weight, same.weight)
    assert torch.equal(found.values * (found.weight > 0)[..., None], same.values * (same.weight > 0)[..., None])
    fitted = testops.fit(seen, kit, schedule=QUICK)
    assert finite(fitted) and (speed(fitted.motion) < 0.1).all()


def test_somebody_who_walks_out_of_the_image(kit, walk, filmed):
    """Over its edge, keypoint by keypoint: few are left after frame 11, none after frame 18. The start jumps by
    more than a metre where a foot is all there is; stages 1 and 2 must undo that."""
    clip = walk.clip(slice(1, 2))
    inside = filmed.keypoints[1:, ..., 0] < 430
    seen = replace(filmed, keypoints=filmed.keypoints[1:], confidence=torch.where(inside, filmed.confidence[1:], 0.0))
    assert seen.confidence[0, :12].gt(0).sum(-1).min() >= 5 and not seen.confidence[0, 19:].any()
    start = testops.start_stage_1(Problem(evidence(seen), kit, RGB_LIGHT)).trans[0]
    assert start.diff(dim=0).norm(dim=-1).max() > 1
    fitted = testops.fit(seen, kit, schedule=Schedule(steps=(5, 10, 0)))
    assert (speed(fitted.stages[1]) < 0.1).all() and (speed(fitted.stages[2]) < 0.04).all()
    wrong = errors(fitted.motion, clip)[0]
    assert wrong[:12].mean() < 0.35 and wrong[19:].max() < 0.45
