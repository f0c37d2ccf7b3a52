"""Corruptions: the mask says exactly what changed, the original stays, and each failure is the one it names."""

import pytest
import torch

from data_synth import corrupt
from motionlab.observation import BODY_25, Observation2D, look_at
from tests.draws import seeded

CAMERA = look_at(torch.tensor([0.0, -4.0, 1.5]), torch.tensor([0.0, 0.0, 1.0]), focal=900.0, width=1280, height=720)
LEGS = [BODY_25.index(f"{side}_{part}") for side in ("left", "right") for part in corrupt.LEG]


def observed(frames=60, batch=(3,), missing=0.1):
    g = seeded(7)
    keypoints = 100 + 500 * torch.rand(*batch, frames, 25, 2, generator=g)
    confidence = 0.2 + 0.8 * torch.rand(*batch, frames, 25, generator=g)
    confidence[torch.rand(confidence.shape, generator=g) < missing] = 0
    return Observation2D(keypoints * (confidence > 0)[..., None], confidence, BODY_25, 30.0, CAMERA)


def walker(frames=40):
    """One clip, everything seen; the left leg vanishes at frame 20, the right one at 30."""
    return hidden(hidden(observed(frames, (), missing=0.0), LEGS[:5], 20), LEGS[5:], 30)


def hidden(observation, keypoints, start, stop=None):
    mask = torch.zeros_like(observation.visible)
    mask[..., start:stop, keypoints] = True
    return corrupt._hide(observation, mask)[0]


POINTS = torch.rand(3, 60, 25, 3, generator=seeded(1)) * 1.8
DRAWN = {
    "flips": lambda o, g: corrupt.flip_limbs(o, g, 0.3, 5),
    "two legs": lambda o, g: corrupt.two_legs_from_one(o, g),
    "background": lambda o, g: corrupt.false_detections(o, g, 0.2, 5),
}
FIXED = {
    "below": lambda o, g: corrupt.occlude_below(o, POINTS),
    "frames": lambda o, g: corrupt.drop_frames(o, [0, 7, -1]),
}


@pytest.mark.parametrize("name", DRAWN | FIXED)
@pytest.mark.parametrize("seed", range(3))
def test_the_mask_is_what_changed_and_the_original_stays(name, seed):
    before, twin = observed(), observed()
    after, mask = (DRAWN | FIXED)[name](before, seeded(seed))
    differs = (after.keypoints != before.keypoints).any(-1) | (after.confidence != before.confidence)
    assert torch.equal(mask, differs) and mask.any() and not mask.all()
    assert torch.equal(before.keypoints, twin.keypoints) and torch.equal(before.confidence, twin.confidence)
    assert after.keypoints.isfinite().all() and ((0 <= after.confidence) & (after.confidence <= 1)).all()


@pytest.mark.parametrize("name", DRAWN)
def test_same_seed_same_failure_other_seed_another(name):
    one, two, other = (DRAWN[name](observed(), seeded(seed)) for seed in (4, 4, 5))
    assert torch.equal(one[0].keypoints, two[0].keypoints) and torch.equal(one[0].confidence, two[0].confidence)
    assert torch.equal(one[1], two[1])
    assert not torch.equal(one[0].keypoints, other[0].keypoints)


def test_flipping_the_same_frames_twice_is_nothing():
    before = observed()
    after, mask = corrupt.flip_limbs(before, seeded(), 0.3, 5)
    back, again = corrupt.flip_limbs(after, seeded(), 0.3, 5)
    assert torch.equal(back.keypoints, before.keypoints) and torch.equal(mask, again)
    left, right = BODY_25.index("left_knee"), BODY_25.index("right_knee")
    frames = mask[..., left]
    assert torch.equal(after.keypoints[frames][:, left], before.keypoints[frames][:, right])
    others = [k for k in range(25) if k not in LEGS]
    assert not mask[..., others].any()


def test_two_legs_from_one_before_and_during_the_occlusion():
    before = walker()
    after, mask = corrupt.two_legs_from_one(before, seeded(), lead=6)
    left, right = ([BODY_25.index(f"{side}_{part}") for part in corrupt.LEG] for side in ("left", "right"))
    # the left leg vanishes at 20: copied in the six frames before and while the right one is seen
    assert mask[:, left].all(1).nonzero()[:, 0].tolist() == list(range(14, 30))
    assert not mask[:, right].any(), "the leg that is copied from stays"
    assert after.visible[14:30][:, left].all() and not after.visible[30:][:, left + right].any()
    shank = (before.keypoints[:, right[0]] - before.keypoints[:, right[1]]).norm(dim=-1)
    off = (after.keypoints[:, left] - before.keypoints[:, right]).norm(dim=-1) / shank[:, None]
    assert off[14:30].max() < 0.6 and off[:14].median() > off[14:30].median()
    ratio = after.confidence[14:30][:, left] / before.confidence[14:30][:, right]
    assert (ratio >= 0.8).all() and (ratio <= 1).all()


@pytest.mark.parametrize("seed", range(6))
def test_two_legs_when_both_vanish_together_copies_one_of_them(seed):
    both = hidden(observed(40, (), 0.0), LEGS, 20, 30)
    _, mask = corrupt.two_legs_from_one(both, seeded(seed), lead=5)
    frames = [mask[:, half].any(1).nonzero()[:, 0].tolist() for half in (LEGS[:5], LEGS[5:])]
    assert sorted(frames) == [[], list(range(15, 20))]


def test_false_detections_are_confident_wrong_and_sticky():
    before = observed(2000, (), 0.0)
    after, mask = corrupt.false_detections(before, seeded(), share=0.1, length=8)
    assert abs(mask.float().mean() - 0.1) < 0.01 and (after.confidence[mask] >= 0.6).all()
    assert (after.keypoints - before.keypoints).norm(dim=-1)[mask].median() > 100
    knee = after.keypoints[mask[:, 10], 10]
    assert knee.std(0).max() < 2, "it sits in one place"


@pytest.mark.parametrize("share, length", [(0.0, 3), (0.25, 1), (0.5, 6), (1.0, 2)])
def test_runs_cover_their_share_from_the_first_frame_to_the_last(share, length):
    mask = corrupt._runs((4000, 20), share, length, seeded())
    assert ((mask.float().mean(0) - share).abs() <= 4.5 * (share * (1 - share) / 4000) ** 0.5 + 1e-9).all()
