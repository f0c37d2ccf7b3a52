"""Faults of recordings: each is planted into a clean walk and found where it was planted, and only there."""

from dataclasses import replace

import pytest
import torch

from data_synth.actions import ACTIONS
from data_synth.faults import knees_reflected, lowered
from data_synth.subjects import SUBJECTS
from motionlab import rotation
from motionlab.cleaning import SHORTEST, clean, faults
from motionlab.skeleton import STANDARD, UPRIGHT


def perform(action, seed=0, **options):
    return ACTIONS[action](SUBJECTS[seed], torch.Generator().manual_seed(seed), **options).motion


@pytest.fixture(scope="module")
def walk():
    return perform("walk", seconds=6.5)


@pytest.fixture(scope="module")
def idle():
    return perform("idle", seconds=10.0)


def where(motion):
    """Frames of each fault that is there."""
    return {name: found.nonzero()[:, 0].tolist() for name, found in faults(motion).items() if found.any()}


def only(motion, name, start, stop, margin):
    """The fault covers start:stop, and at most ``margin`` frames on either side; there is no other."""
    found = where(motion)
    assert list(found) == [name], found
    frames = found[name]
    assert set(range(start, stop)) <= set(frames) and start - margin <= frames[0] and frames[-1] < stop + margin
    return True


def fading(motion, start, stop, frames):
    """(T,): 1 in start:stop, and from there to 0 within so many frames."""
    at = torch.arange(motion.frames)
    return (1 - torch.maximum(start - at, at - (stop - 1)).clamp(min=0) / (frames + 1)).clamp(min=0)


def moved(motion, start, stop, by, fade=0):
    return replace(motion, root=motion.root + fading(motion, start, stop, fade)[:, None] * torch.tensor(by))


def bent(motion, frames, joint, angle):
    """One joint bent by an angle about its x axis, from its rest."""
    rot = motion.rot.clone()
    rot[frames, STANDARD.index(joint)] = rotation.rotation_about("x", torch.tensor(angle))
    return replace(motion, rot=rot)


def spread(motion, start, stop, lowered=0.0):
    """A T-pose in start:stop, its arms lowered by an angle."""
    pose = torch.eye(3).repeat(22, 1, 1)
    pose[0] = UPRIGHT
    for side, sign in (("left", -1), ("right", 1)):
        pose[STANDARD.index(f"{side}_shoulder")] = rotation.rotation_about("z", torch.tensor(sign * lowered))
    much = fading(motion, start, stop, 10)[:, None]
    return replace(motion, rot=rotation.slerp(motion.rot, pose.expand_as(motion.rot), much))


# ------------------------------------------------------------------------------------------------- clean ones
@pytest.mark.parametrize("action", sorted(ACTIONS))
def test_people_who_do_what_people_do_have_no_fault(action):
    assert where(perform(action, 1)) == {}


@pytest.mark.parametrize(("height", "afloat"), [(0.1, False), (0.6, False), (0.9, True), (1.2, True)])
def test_a_jump_is_not_afloat_unless_nobody_jumps_so_high(height, afloat):
    """Flights of 0.29, 0.70, 0.86 and 0.99 s, as gravity has it; 0.7 are allowed."""
    jump = perform("jump", height=height)
    above = (jump.positions[..., 2].amin(-1) > 0.14).nonzero()[:, 0].tolist()
    assert only(jump, "afloat", above[1], above[-1], 4) if afloat else where(jump) == {}


# --------------------------------------------------------------------------------------------------- planted
def test_a_teleport(walk):
    assert only(moved(walk, 90, walk.frames, (0.6, 0.0, 0.0)), "teleport", 89, 91, 3)  # 18 m/s
    assert where(moved(walk, 90, walk.frames, (0.0, 0.3, 0.0))) == {}  # 9 m/s, beside the walk's own
    for angle, found in ((1.6, True), (1.0, False)):  # 48 and 30 rad/s
        nod = bent(bent(walk, slice(0, 90), "head", 0.0), slice(90, None), "head", angle)
        assert only(nod, "teleport", 89, 91, 3) if found else where(nod) == {}


def test_a_t_pose_at_the_start_or_the_end(idle):
    last = idle.frames
    assert only(spread(idle, 0, 20), "t-pose", 0, 20, 12)
    assert only(spread(idle, last - 20, last), "t-pose", last - 20, last, 12)
    middle = spread(idle, last // 2, last // 2 + 20)  # somebody spreads the arms
    assert where(middle) == {} and only(spread(middle, 0, 20), "t-pose", 0, 20, 12)
    assert where(spread(idle, 0, 20, lowered=0.6)) == {}


@pytest.mark.parametrize("who", ["walk", "idle"])
def test_afloat_on_what_is_not_there(who, request):
    motion = request.getfixturevalue(who)
    assert only(moved(motion, 60, 120, (0.0, 0.0, 0.3), fade=12), "afloat", 60, 120, 22)
    assert only(moved(motion, 0, motion.frames, (0.0, 0.0, 0.3)), "afloat", 0, motion.frames, 0)
    assert where(moved(motion, 60, 120, (0.0, 0.0, 0.08), fade=12)) == {}


def test_sunk(walk):
    assert only(moved(walk, 60, 100, (0.0, 0.0, -0.25), fade=8), "sunk", 60, 100, 8)
    assert only(lowered(walk, 0.25), "sunk", 0, walk.frames, 0)
    assert where(lowered(walk, 0.1)) == {}


def frozen(motion, count):
    """Frame 80, held for so many frames more."""
    at = torch.cat((torch.arange(80), torch.full((count,), 80), torch.arange(80, motion.frames)))
    return replace(motion, root=motion.root[at], rot=motion.rot[at], contacts=None)


def test_frozen(walk):
    assert only(frozen(walk, 45), "frozen", 81, 124, 2)
    assert where(frozen(walk, 25)) == {}  # under a second


@pytest.mark.parametrize("side", ["left", "right"])
def test_knees_that_bend_the_wrong_way(walk, idle, side):
    assert only(bent(idle, slice(100, 140), f"{side}_knee", -0.5), "flipped", 100, 140, 3)
    for angle in (-0.25, 0.5):
        assert where(bent(idle, slice(100, 140), f"{side}_knee", angle)) == {}
    assert set(where(knees_reflected(walk))) == {"flipped"}


# ------------------------------------------------------------------------------------------------------ cut out
def test_what_is_left_is_the_recording_and_seconds_add_up(walk):
    spoilt = moved(frozen(walk, 45), 150, 400, (0.0, 9.0, 0.0))
    found = clean(spoilt)
    assert set(found.seconds) == {"frozen", "teleport", "short"}
    total = sum(m.seconds for m in found.stretches) + sum(found.seconds.values())
    assert total == pytest.approx(spoilt.seconds)
    bad = torch.stack(list(faults(spoilt).values())).any(0)
    good, stretches = "".join(" x"[not b] for b in bad), []
    for run in good.split():
        start = good.index(run)
        stretches += [(start, start + len(run))] if len(run) >= SHORTEST * 30 else []
        good = good.replace(run, "." * len(run), 1)
    assert len(stretches) == len(found.stretches) == 2
    for (start, stop), stretch in zip(stretches, found.stretches, strict=True):
        assert torch.equal(stretch.root, spoilt.root[start:stop]) and torch.equal(stretch.rot, spoilt.rot[start:stop])
        assert stretch.name == f"walk from {start / 30:.1f} s"


def test_a_frame_with_two_faults_counts_once_and_shorter_stretches_may_stay(walk):
    sunk = lowered(frozen(walk, 45), 0.25)
    assert clean(sunk).seconds == {"sunk": pytest.approx(sunk.seconds)} and clean(sunk).stretches == ()
    short = walk.cut(0, 30)
    assert clean(short).seconds == {"short": pytest.approx(1.0)} and not clean(short).stretches
    assert clean(short, shortest=0.9).stretches[0].frames == 30
    assert clean(walk).seconds == {} and torch.equal(clean(walk).stretches[0].rot, walk.rot)
    assert clean(walk.cut(0, 1)).seconds == {"short": pytest.approx(1 / 30)}
