"""The actions keep their promises: planted feet, a solid floor, possible joints, continuous acceleration, gait."""

from dataclasses import replace

import pytest
import torch

from data_synth import clips, faults
from data_synth.actions import ACTIONS
from data_synth.actions.locomotion import MANNERS
from data_synth.anatomy import height_at_rest
from data_synth.audit import acceleration, audit
from data_synth.subjects import SUBJECTS
from motionlab.rotation import rotation_about

MILLIMETRE = 1e-3


def take(name, subject=0, seed=0, **options):
    return ACTIONS[name](SUBJECTS[subject], torch.Generator().manual_seed(seed), **options)


@pytest.mark.parametrize("name", ACTIONS)
@pytest.mark.parametrize("subject", range(len(SUBJECTS)))
def test_every_action_stands_the_audit(name, subject):
    for seed in range(2):
        found = audit(take(name, subject, seed).motion)
        assert max(found.contact_speed, found.contact_height, found.penetration) < MILLIMETRE
        assert found.limit_excess == 0, found.at
        assert found.arm_depth < 0.02 and 0.05 < found.mean_acceleration < 15


WAYS = [(name, {}, 0, 3) for name in ACTIONS] + [("walk", {}, subject, 2) for subject in (0, 1)]
WAYS += [("floor", {"way": way}, subject, subject) for way in ("kneel", "seat") for subject in range(len(SUBJECTS))]


@pytest.mark.parametrize(("name", "options", "subject", "seed"), WAYS)
def test_acceleration_is_continuous(name, options, subject, seed):
    """Twice the frame rate: the same greatest acceleration, and half the greatest jump of it."""
    worst, jump = [], []
    for fps in (120, 240):
        motion = take(name, subject, seed, fps=fps, **options).motion.to(torch.float64)
        worst.append(acceleration(motion).max())
        p = motion.positions
        a = (p[2:] - 2 * p[1:-1] + p[:-2]) * fps**2
        jump.append(a.diff(dim=0).norm(dim=-1).max())
    assert worst[1] / worst[0] == pytest.approx(1, abs=0.12)
    assert jump[1] < 0.75 * jump[0]


@pytest.mark.parametrize("name", ["walk", "dance", "floor"])
def test_the_generator_decides_all(name):
    a, b, c = (take(name, seed=seed).motion for seed in (5, 5, 6))
    assert torch.equal(a.root, b.root) and torch.equal(a.rot, b.rot) and torch.equal(a.contacts, b.contacts)
    frames = min(a.frames, c.frames)
    assert not torch.allclose(a.rot[:frames], c.rot[:frames], atol=1e-2)


@pytest.mark.parametrize("speed", [0.8, 1.2, 1.5])
@pytest.mark.parametrize("subject", range(len(SUBJECTS)))
def test_gait_facts(speed, subject):
    """Speed as asked; stance some 60 %; swing knee about 60 degrees; pelvis lowest near double support."""
    took = take("walk", subject, 1, speed=speed, seconds=9.0, fps=60.0)
    motion = took.motion
    middle = slice(round(0.35 * motion.frames), round(0.75 * motion.frames))
    strikes = (took.phase.diff() < -0.5).nonzero()[:, 0] + 1  # left heel strikes
    first, last = int(strikes[1]), int(strikes[-2])
    way = (motion.root[last, :2] - motion.root[first, :2]).norm()
    assert float(way) / ((last - first) / 60) == pytest.approx(speed, rel=0.05)

    ball = motion.positions[first:last, motion.skeleton.index("left_foot"), 2]
    heel = motion.positions[first:last, motion.skeleton.index("left_ankle"), 2]
    down = (ball < motion.skeleton.sole + 0.003) | (heel < heel.min() + 0.003)
    assert 0.50 < float(down.float().mean()) < 0.70
    R = motion.rot[middle, motion.skeleton.index("left_knee")]
    knee = torch.rad2deg(torch.atan2(R[:, 2, 1], R[:, 1, 1]))
    assert 60 < float(knee.max()) < 76  # recorded walks: 66 to 76
    assert float(knee.min()) < 12
    bob = motion.root[first:last, 2]
    assert 0.015 < float(bob.max() - bob.min()) < 0.07


@pytest.mark.parametrize(("name", "speed", "recorded"), [("walk", 1.2, 5.4), ("run", 2.6, 13.0), ("punch", None, 6.7)])
def test_as_lively_as_recorded(name, speed, recorded):
    """Mean joint acceleration in m/s^2 within a quarter of recorded ones at like speeds.

    Ordinary walks 4.9 to 5.7 at 1.1 to 1.5 m/s, runs mostly 11 to 14 at 1.7 to 2.7, punches 6.5 and 6.9.
    """
    options = {} if speed is None else {"speed": speed, "seconds": 6.0}
    found = []
    for subject in range(len(SUBJECTS)):
        motion = take(name, subject, 1, **options).motion
        found.append(audit(motion.cut(round(0.3 * motion.frames), round(0.7 * motion.frames))).mean_acceleration)
    assert sum(found) / len(found) == pytest.approx(recorded, rel=0.25)


@pytest.mark.parametrize("manner", MANNERS)
def test_every_manner_of_walking_stands_the_audit(manner):
    for subject in range(len(SUBJECTS)):
        motion = take("walk", subject, 1, manner=manner, turn=-1.5).motion
        found = audit(motion)
        assert max(found.contact_speed, found.contact_height, found.penetration) < MILLIMETRE
        assert found.limit_excess == 0, found.at
    x, y = motion.root[-1, 0], motion.root[-1, 1]
    if manner == "backwards":
        assert float(y) < -0.5
    elif manner == "sideways":
        assert abs(float(x)) > 0.5 > abs(float(y))


@pytest.mark.parametrize("name", ["jump", "run"])
def test_flight_is_ballistic(name):
    """While no foot touches the floor the pelvis falls freely (up to the natural noise)."""
    motion = take(name, 0, 1, fps=240.0).motion.to(torch.float64)
    height = motion.root[:, 2]
    a = (height[2:] - 2 * height[1:-1] + height[:-2]) * 240**2
    free = motion.positions[1:-1, motion.skeleton.indices(["left_foot", "right_foot"]), 2].amin(-1)
    flying = free > motion.skeleton.sole + 0.01
    assert flying.sum() > 5
    assert float(a[flying].median()) == pytest.approx(-9.81, rel=0.05)


@pytest.mark.parametrize("subject", range(len(SUBJECTS)))
@pytest.mark.parametrize("seed", range(3))
def test_over_knees_and_hands_to_the_belly_and_up(subject, seed):
    """Each knee and each wrist bears twice, planted; the body lies flat in between and stands at the end."""
    motion = take("floor", subject, seed, way="kneel").motion
    column = motion.skeleton.contact_names.index
    for joint in ("left_knee", "right_knee", "left_wrist", "right_wrist"):
        on = motion.contacts[:, column(joint)] * (motion.root[:, 2] > 0.35)  # lower, they may rest as well
        assert int((on.diff() > 0).sum()) == 2
        assert float(on.mean()) > 0.05
    assert motion.contacts[:, column("pelvis")].any()
    assert float(motion.positions[..., motion.skeleton.index("head"), 2].min()) < 0.2
    assert float(motion.root[-1, 2]) == pytest.approx(SUBJECTS[subject].standing, abs=0.02)


def test_what_keeps_still_on_the_floor_is_labelled():
    """Of someone who lies: joints that keep still within 4 mm of their height at rest bear, all of them."""
    found = 0
    for way in ("kneel", "seat"):
        motion = take("floor", 1, 1, way=way).motion
        rest = torch.tensor([height_at_rest(motion.skeleton, name) for name in motion.skeleton.contact_names])
        p = motion.positions[:, motion.skeleton.contact_indices]
        step = p.diff(dim=0).norm(dim=-1)
        still = (step[1:] < 0.8 * MILLIMETRE) & (step[:-1] < 0.8 * MILLIMETRE)
        bears = still & ((p[1:-1, :, 2] - rest).abs() < 4 * MILLIMETRE) & (motion.root[1:-1, 2:] < 0.3)
        found += int(bears[:, 1:].sum())
        assert motion.contacts[1:-1, 1:][bears[:, 1:]].bool().all()
    assert found > 50


def test_control_a_lifted_knee_and_an_arm_through_the_trunk_are_noticed():
    kneels, idles = take("floor", way="kneel").motion, take("idle").motion
    raised = replace(kneels, root=kneels.root + torch.tensor([0, 0, 0.01]))  # knees said to bear above the floor
    assert audit(raised).contact_height > 5 * MILLIMETRE
    rot = idles.rot.clone()
    rot[:, idles.skeleton.index("left_shoulder")] = rotation_about("z", torch.tensor(-2.0))  # down past the side
    assert audit(replace(idles, rot=rot)).arm_depth > 0.05


@pytest.fixture(scope="module")
def walk():
    return clips.draw(1, torch.Generator().manual_seed(0), actions=("walk",))[0].motion


def test_the_audit_notices_every_fault_and_nothing_else(walk):
    clean, drift, low, knees = (
        audit(m) for m in (walk, faults.drifting(walk), faults.lowered(walk), faults.knees_reflected(walk))
    )
    assert clean.contact_speed < 1e-4
    assert drift.contact_speed == pytest.approx(0.01 / 30, rel=0.05)
    assert low.penetration == pytest.approx(0.01 + clean.penetration, abs=2e-3)
    assert knees.limit_excess > 20 > clean.limit_excess
    assert low.limit_excess == pytest.approx(clean.limit_excess, abs=1e-3)


def test_takes_cover_actions_and_people_repeat_by_seed_and_a_longer_draw_begins_with_the_shorter_one():
    draw = lambda count, seed: clips.draw(count, torch.Generator().manual_seed(seed), actions=("walk", "idle"))  # noqa: E731
    takes, again, other = draw(6, 0), draw(3, 0), draw(1, 1)
    assert len({(t.subject.name, t.labels[len(t.labels) // 2]) for t in takes}) >= 4
    assert all(torch.equal(a.motion.root, b.motion.root) for a, b in zip(takes, again, strict=False))
    assert not torch.equal(takes[0].motion.rot[:60], other[0].motion.rot[:60])
    with pytest.raises(KeyError, match="levitate"):
        clips.draw(1, torch.Generator(), actions=("levitate",))
