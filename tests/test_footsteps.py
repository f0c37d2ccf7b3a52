"""Feet that glide through a gap step: one after the other, lifted on the way, at rest before and behind."""

from dataclasses import replace

import pytest
import torch

from motionlab.animate import foot_locking
from motionlab.animate.foot_locking import lock_feet
from motionlab.ik import two_bone_ik
from motionlab.skeleton import ANKLES, BALLS, STANDARD
from tests.figures import standing

FRAMES, GAP = 70, slice(20, 50)
KNOWN = torch.ones(1, FRAMES, dtype=torch.bool)
KNOWN[:, GAP] = False
LEG = float(STANDARD.offsets[STANDARD.indices(("left_knee", "left_ankle"))].norm(dim=-1).sum())


@pytest.fixture(scope="module")
def glides():
    """Somebody with bent knees stands, stands half a metre on behind a gap, and in between is pushed there."""
    start = standing(FRAMES)
    start.root[:, 1] = 0.5 * ((torch.arange(FRAMES) - 19.0) / 31).clamp(0, 1)
    heels = start.positions[:, STANDARD.indices(ANKLES)]
    low = replace(start, root=start.root - torch.tensor([0.0, 0.0, 0.04]))
    contacts = torch.ones(1, FRAMES, len(STANDARD.contact_names))
    return replace(low, root=low.root[None], rot=two_bone_ik(low, heels).rot[None], contacts=contacts)


def dragged(motion):
    """Metres that ankles which are low go over the floor in the gap, (F,)."""
    ankle = motion.positions[0][:, STANDARD.indices(ANKLES)]
    low = ankle[..., 2] < ankle[0, :, 2] + 0.03
    return (ankle.diff(dim=0)[..., :2].norm(dim=-1) * (low[1:] & low[:-1])).sum(0)


def test_who_stands_elsewhere_behind_a_gap_steps_there_and_does_not_slide(glides):
    pushed, steps = (lock_feet(glides, known=KNOWN, ease=6, step=step) for step in (False, True))
    assert dragged(pushed).min() > 0.4  # the control: in a line from place to place
    assert dragged(steps).max() < 0.08
    ankle = steps.positions[0][:, STANDARD.indices(ANKLES)]
    high = ankle[..., 2] - ankle[0, :, 2]
    assert high.amax(0).min() > 0.03 and high.min() > -0.005
    assert (steps.positions - glides.positions)[KNOWN].abs().max() < 1e-4


def test_feet_that_glide_together_step_one_after_the_other(glides):
    steps = lock_feet(glides, known=KNOWN, ease=6, step=True)
    speed = steps.positions[0][:, STANDARD.indices(BALLS), :2].diff(dim=0).norm(dim=-1) * 30
    middle = [float((speed[:, f] * torch.arange(FRAMES - 1)).sum() / speed[:, f].sum()) for f in range(2)]
    assert abs(middle[0] - middle[1]) > 8  # frames; a hop: 0
    assert (speed > 1.0).sum(0).min() > 3


def test_feet_that_stay_or_are_not_said_to_stand_keep_their_time():
    time = torch.arange(40, dtype=torch.float64)[None, :, None].expand(1, 40, 2)
    way = torch.stack((0.6 * time / 40, 0 * time, 0 * time), -1).float()
    stands, known = torch.ones(1, 40, 2, dtype=torch.bool), torch.zeros(1, 40, 1, dtype=torch.bool)
    known[:, :5], known[:, 35:] = True, True
    when, anew, moving = foot_locking.retime(way, stands, known, LEG, 30.0)
    assert anew[:, 5:35].all() and not anew[known.expand_as(anew)].any() and 0 < moving.sum() < anew.sum()
    assert (when.diff(dim=1) >= 0).all() and (when[:, 5] < 5).all() and (when[:, 34] > 34).all()
    for path, said in ((0.05 * way, stands), (way, ~stands)):
        when, anew, _ = foot_locking.retime(path, said, known, LEG, 30.0)
        assert torch.equal(when, time.expand_as(when)) and not anew.any()


def legs_of(along, high=0.08):
    """Hip, ankle and ball (3, 1, T, 1, 3) of a foot that is so far along (T,) and whose ankle is so high."""
    ways = torch.zeros(3, 1, len(along), 1, 3)
    ways[..., 0, 0] = along
    ways[1, ..., 2], ways[0, ..., 2] = high, 0.08 + 0.9 * LEG
    ways[2, ..., 0] += 0.12
    return ways


def flown(ways, stands, known):
    return foot_locking.lift(ways, stands[None, :, None], known[None, :, None], torch.tensor([[0.08]]), LEG, 30.0)


@pytest.mark.parametrize(("length", "high"), [(0.06, 0.03), (0.2, 0.05), (0.9, 0.08 * LEG)])
def test_a_step_is_eased_and_lifted_by_its_length_and_one_that_is_high_already_is_not(length, high):
    u = ((torch.arange(40) - 9) / 16).clamp(0, 1)
    stands, known = (u == 0) | (u == 1), torch.zeros(40, dtype=torch.bool)
    made = flown(legs_of(length * u), stands, known)[1, 0, :, 0]
    torch.testing.assert_close(made[:, 0], length * (3 * u**2 - 2 * u**3))
    assert high < float(made[:, 2].max()) - 0.08 < high + 0.01
    standing = made[(u == 0) | (u == 1), 2]
    assert standing.min() == 0.08 and (standing > 0.08 + 1e-6).sum() <= 2  # the heel peels before its step
    low = made[:, 2] < 0.11
    drags = (made[:, 0].diff() * (low[1:] & low[:-1])).sum()
    assert drags < 0.1 * length or length < 0.1  # the control: all of it
    above = flown(legs_of(length * u, 0.3), stands, known)[1, 0, :, 0]
    assert (above[:, 2] - 0.3).abs().max() < 0.003


def test_a_foot_that_swings_at_a_key_goes_on_from_it_and_does_not_glide_into_its_stand():
    time = torch.arange(50.0)
    along = torch.where(time < 10, 0.08 * time, 0.8 + 0.4 * (1 - torch.exp(-(time - 10) / 5)).clamp(max=0.95))
    swing = 0.08 + 0.04 * (1 - (time - 9) / 8).clamp(0, 1)  # it comes down at once, and glides
    known, stands = time < 11, along >= 0.8 + 0.4 * 0.949
    before = legs_of(along, swing[:, None])
    made = flown(before, stands, known)

    def drags(ways):
        ankle = ways[1, 0, :, 0]
        low = ankle[:, 2] < 0.11
        return float((ankle[:, 0].diff() * (low[1:] & low[:-1])).sum())

    assert drags(before) > 0.15 and drags(made) < 0.4 * drags(before)
    assert torch.equal(made[:, :, known], before[:, :, known]) and torch.equal(made[:, :, 40:], before[:, :, 40:])
    speed = made[1, 0, :, 0, 0].diff()
    assert abs(float(speed[10] - speed[9])) < 0.02 and speed.min() > -1e-6


def test_a_step_for_which_there_is_no_time_begins_earlier_and_ends_later_but_not_in_known_frames():
    time, far = torch.arange(60), 0.4
    u = ((time - 29) / 4).clamp(0, 1)
    before, stands = legs_of(far * (3 * u**2 - 2 * u**3)), (u == 0) | (u == 1)
    long = (0.25 + 0.3 * far / LEG) * 30
    for known in (time < 10, time < 30):
        speed = flown(before, stands, known)[1, 0, :, 0, 0].diff()
        assert abs(int((speed > 0).sum()) - long) < 2 and speed.max() < 0.75 * before[1, 0, :, 0, 0].diff().max()
        assert speed[:9].max() == 0 and (known[29] <= (speed[:29].max() == 0))


def test_two_frames_leave_no_room_for_a_step():
    two = legs_of(torch.tensor([0.0, 0.3]))
    on = torch.tensor([True, False])
    assert torch.equal(flown(two, ~on, on), two)


def test_a_heel_that_rolls_up_before_a_flight_without_time_does_not_jump():
    """It leaves earlier, and rises no faster than it did: as the ball goes, not as the whole foot did later."""
    time = torch.arange(60)
    u = ((time - 29) / 4).clamp(0, 1)
    roll = (((time - 19) / 10).clamp(0, 1) - ((time - 33) / 10).clamp(0, 1)) * 0.1
    before = legs_of(0.4 * u, (0.08 + roll)[:, None])
    stands = (u == 0) | (u == 1)
    made = flown(before, stands, torch.zeros(60, dtype=torch.bool))[:, 0, :, 0]
    at = made[2, :, 0] - 0.12
    assert at[28] > 0.01 and at[34] < 0.39  # it does leave earlier, and arrives later
    assert made[1, :, 2].diff().abs().max() < 0.02  # by itself 0.01 a frame; with all of the foot retimed 0.04
