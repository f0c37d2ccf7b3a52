"""Feet that stand stay, out of reach on their balls; feet that glide step."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab.animate.foot_locking import _stands, lift, lock_feet, steps
from motionlab.contact import with_contacts
from motionlab.errors import DataError, ShapeError
from motionlab.ik import two_bone_ik
from motionlab.skeleton import ANKLES, BALLS, STANDARD
from tests.figures import standing

FRAMES, GAP = 70, slice(20, 50)
KNOWN = torch.ones(1, FRAMES, dtype=torch.bool)
KNOWN[:, GAP] = False
LEG = float(STANDARD.offsets[STANDARD.indices(("left_knee", "left_ankle"))].norm(dim=-1).sum())


@pytest.fixture(scope="module")
def walk():
    clips = scenes.held_out(6)
    clips = [with_contacts(clips.clip(i).cut(0, 60)) for i in range(6)]
    return replace(scenes.together(clips), skeleton=clips[0].skeleton)


def test_feet_that_no_label_names_stand_if_they_are_low_and_slow_and_only_then(walk):
    unlabelled = replace(walk, contacts=torch.zeros_like(walk.contacts))
    second = torch.arange(60)[:, None] / 30 * torch.tensor([0.0, 1.0, 0.0])
    creeping, running = (replace(unlabelled, root=walk.root + speed * second) for speed in (0.1, 2.0))
    stands = _stands(walk, BALLS)
    both = stands[:, 1:] & stands[:, :-1]

    def slide(motion):
        return motion.positions[..., STANDARD.indices(BALLS), :].diff(dim=1).norm(dim=-1)

    assert slide(creeping)[both].mean() > 3e-3 and slide(lock_feet(creeping))[both].mean() < 5e-4
    assert (lock_feet(creeping, slow=False).positions - creeping.positions).abs().max() < 1e-3  # nothing says so
    said = replace(creeping, contacts=walk.contacts)
    assert (lock_feet(said, slow=False).positions - creeping.positions).abs().max() > 0.01
    assert (lock_feet(running).positions - running.positions).norm(dim=-1).mean() < 2e-3  # low, but at 2 m/s
    assert (lock_feet(walk).positions - walk.positions).norm(dim=-1)[..., STANDARD.indices(BALLS)].mean() < 0.01


def test_out_of_reach_the_heel_lifts_and_the_ball_stays():
    """Who stands with straight legs and rises by 3 cm without leaving the floor is on the balls of the feet."""
    rises = STANDARD.standing_height() + 0.03 * torch.linspace(0, 1, 60)
    up = standing(60)
    up.root[:, 2] = rises
    said = torch.zeros(1, 60, len(STANDARD.contact_names))
    said[..., [STANDARD.contact_names.index(n) for n in BALLS]] = 1.0
    made = lock_feet(replace(up, root=up.root[None], rot=up.rot[None], contacts=said))
    heels, balls = (made.positions[..., STANDARD.indices(names), 2] for names in (ANKLES, BALLS))
    assert (balls.amax(1) - balls.amin(1)).max() < 1e-4
    assert (heels[:, -1] - heels[:, 0]).min() > 0.01  # the ball rests half-way up
    hips, ankles = (made.positions[..., STANDARD.indices(n), :] for n in (("left_hip", "right_hip"), ANKLES))
    assert ((ankles - hips).norm(dim=-1).diff(dim=1) < 1e-3).all()  # no leg grows


def test_who_never_stands_is_left_alone_and_who_says_nothing_is_refused(walk):
    up = torch.tensor([0.0, 0.0, 1.0])
    flying = replace(walk, root=walk.root + up, contacts=torch.zeros_like(walk.contacts))
    assert (lock_feet(flying).positions - flying.positions).abs().max() < 1e-3
    with pytest.raises(DataError, match="with_contacts"):
        lock_feet(replace(walk, contacts=None))
    bodies = replace(walk.skeleton, offsets=torch.zeros(6, 1, 22, 3))
    for wrong in (walk.clip(0), replace(walk, skeleton=bodies)):
        with pytest.raises(ShapeError, match="on one body"):
            lock_feet(wrong)


# --------------------------------------------------------------------------- feet that glide through a gap step
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
    pushed, stepping = (lock_feet(glides, known=KNOWN, step=step) for step in (False, True))
    assert dragged(pushed).min() > 0.4  # the control: in a line from place to place
    assert dragged(stepping).max() < 0.08
    ankle = stepping.positions[0][:, STANDARD.indices(ANKLES)]
    high = ankle[..., 2] - ankle[0, :, 2]
    assert high.amax(0).min() > 0.03 and high.min() > -0.005
    assert (stepping.positions - glides.positions)[KNOWN].abs().max() < 1e-4


def test_feet_that_glide_together_step_one_after_the_other(glides):
    balls = lock_feet(glides, known=KNOWN, step=True).positions[0][:, STANDARD.indices(BALLS), :2]
    speed = balls.diff(dim=0).norm(dim=-1) * 30
    middle = [float((speed[:, f] * torch.arange(FRAMES - 1)).sum() / speed[:, f].sum()) for f in range(2)]
    assert abs(middle[0] - middle[1]) > 8  # frames; a hop: 0
    assert (speed > 1.0).sum(0).min() > 3


def test_feet_that_stay_or_are_not_said_to_stand_do_not_step():
    way = torch.zeros(1, 40, 2, 3)
    way[..., 0] = 0.6 * torch.arange(40)[:, None] / 40
    stands, known = torch.ones(1, 40, 2, dtype=torch.bool), torch.zeros(1, 40, 2, dtype=torch.bool)
    known[:, :5], known[:, 35:] = True, True
    stepping = steps(way, stands, known, LEG, 30.0)
    assert not stepping[known].any() and (stepping.sum(1) > 10).all() and (stepping.sum(1) < 20).all()
    for path, said in ((0.05 * way, stands), (way, ~stands)):
        assert not steps(path, said, known, LEG, 30.0).any()


def feet_of(along, high=0.08):
    """Ankles and balls (2, 1, T, 2, 3) of feet that are so far along (T,) and whose ankles are so high."""
    ways = torch.zeros(2, 1, len(along), 2, 3)
    ways[..., 0] = along[:, None]
    ways[0, ..., 2] = high
    ways[1, ..., 0] += 0.12
    return ways


def flown(ways, stands, known):
    both = (mask[None, :, None].expand(1, -1, 2) for mask in (stands, known))
    return lift(ways, *both, torch.tensor([[0.08, 0.08]]), LEG, 30.0)


@pytest.mark.parametrize(("length", "high"), [(0.06, 0.03), (0.2, 0.05), (0.9, 0.08 * LEG)])
def test_a_step_is_eased_and_lifted_by_its_length_and_one_that_is_high_already_is_not(length, high):
    u = ((torch.arange(40) - 9) / 16).clamp(0, 1)
    stands, known = (u == 0) | (u == 1), torch.zeros(40, dtype=torch.bool)
    made = flown(feet_of(length * u), stands, known)[0, 0, :, 0]
    torch.testing.assert_close(made[:, 0], length * (3 * u**2 - 2 * u**3))
    assert high < float(made[:, 2].max()) - 0.08 < high + 0.012
    assert (made[stands, 2] == 0.08).all()
    low = made[:, 2] < 0.11
    drags = (made[:, 0].diff() * (low[1:] & low[:-1])).sum()
    assert drags < 0.1 * length or length < 0.1  # the control: all of it
    above = flown(feet_of(length * u, 0.3), stands, known)[0, 0, :, 0]
    assert (above[:, 2] - 0.3).abs().max() < 0.003


def test_a_foot_that_swings_at_a_key_goes_on_from_it_and_does_not_glide_into_its_stand():
    time = torch.arange(50.0)
    along = torch.where(time < 10, 0.08 * time, 0.8 + 0.4 * (1 - torch.exp(-(time - 10) / 5)).clamp(max=0.95))
    swing = 0.08 + 0.04 * (1 - (time - 9) / 8).clamp(0, 1)  # it comes down at once, and glides
    known, stands = time < 11, along >= 0.8 + 0.4 * 0.949
    before = feet_of(along, swing[:, None])
    made = flown(before, stands, known)

    def drags(ways):
        ankle = ways[0, 0, :, 0]
        low = ankle[:, 2] < 0.11
        return float((ankle[:, 0].diff() * (low[1:] & low[:-1])).sum())

    assert drags(before) > 0.15 and drags(made) < 0.4 * drags(before)
    assert torch.equal(made[:, :, known], before[:, :, known]) and torch.equal(made[:, :, 40:], before[:, :, 40:])
    speed = made[0, 0, :, 0, 0].diff()
    assert abs(float(speed[10] - speed[9])) < 0.02 and speed.min() > -1e-6


def test_a_step_for_which_there_is_no_time_begins_earlier_and_ends_later_but_not_in_known_frames():
    time, far = torch.arange(60), 0.4
    u = ((time - 29) / 4).clamp(0, 1)
    before, stands = feet_of(far * (3 * u**2 - 2 * u**3)), (u == 0) | (u == 1)
    long = (0.25 + 0.3 * far / LEG) * 30
    for known in (time < 10, time < 30):
        speed = flown(before, stands, known)[0, 0, :, 0, 0].diff()
        assert abs(int((speed > 0).sum()) - long) < 2 and speed.max() < 0.75 * before[0, 0, :, 0, 0].diff().max()
        assert speed[:9].max() == 0 and (known[29] <= (speed[:29].max() == 0))
