"""The actions keep their promises: planted feet, a solid floor, possible joints, continuous acceleration, gait."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from scipy.interpolate import BPoly

from data_synth.actions import ACTIONS
from data_synth.actions.locomotion import MANNERS
from data_synth.anatomy import height_at_rest
from data_synth.audit import acceleration, audit
from data_synth.curves import evaluate, quintic
from data_synth.legs import two_bone
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
        assert found.contact_speed < MILLIMETRE
        assert found.contact_height < MILLIMETRE
        assert found.penetration < MILLIMETRE
        assert found.limit_excess == 0, found.at
        assert 0.05 < found.mean_acceleration < 15


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


def test_the_continuity_test_catches_a_kink():
    """Negative control: a foot that stops dead has an acceleration that doubles with the frame rate."""
    worst = []
    for fps in (120, 240):
        motion = take("walk", fps=fps, speed=1.2, seconds=3).motion.to(torch.float64)
        t = torch.arange(motion.frames, dtype=torch.float64) / fps
        root = motion.root + torch.stack(((t - 1.5).clamp(min=0), 0 * t, 0 * t), -1)
        worst.append(acceleration(replace(motion, root=root)).max())
    assert worst[1] > 1.4 * worst[0]


def test_a_sliding_foot_is_caught():
    """Negative control."""
    motion = take("walk").motion
    slid = replace(motion, root=motion.root * torch.tensor([1.0, 1.05, 1.0]))
    assert audit(slid).contact_speed > MILLIMETRE


def test_a_foot_through_the_floor_is_caught():
    """Negative control."""
    motion = take("walk").motion
    assert audit(replace(motion, root=motion.root - torch.tensor([0, 0, 0.01]))).penetration > 5 * MILLIMETRE


@pytest.mark.parametrize("name", ["walk", "dance", "floor"])
def test_the_generator_decides_all(name):
    a, b, c = (take(name, seed=seed).motion for seed in (5, 5, 6))
    assert torch.equal(a.root, b.root) and torch.equal(a.rot, b.rot) and torch.equal(a.contacts, b.contacts)
    frames = min(a.frames, c.frames)
    assert not torch.allclose(a.rot[:frames], c.rot[:frames], atol=1e-2)


def test_step_lengths_vary_with_the_seed():
    def longest_step(seed):
        motion = take("walk", seed=seed).motion
        return float(motion.positions[:, 7, :2].sub(motion.positions[:, 8, :2]).norm(dim=-1).max())

    lengths = [longest_step(seed) for seed in range(5)]
    assert max(lengths) - min(lengths) > 0.02


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


def flexion(motion, side):
    R = motion.rot[:, motion.skeleton.index(f"{side}_knee")]
    return torch.rad2deg(torch.atan2(R[:, 2, 1], R[:, 1, 1]))


def test_the_knee_of_a_walk_bends_twice_a_stride():
    """A small bend under load, the large one early in the swing, and nothing between but a straightening."""
    took = take("walk", 0, 1, speed=1.2, seconds=9.0, fps=60.0)
    knee = flexion(took.motion, "left")
    strikes = (took.phase.diff() < -0.5).nonzero()[1:-1, 0] + 1
    for start, stop in pairwise(strikes.tolist()):
        stride = knee[start:stop]
        at = lambda low, high: stride[int(low * len(stride)) : int(high * len(stride))]  # noqa: B023, E731
        assert 15 < float(at(0.0, 0.3).max()) < 40 and float(at(0.25, 0.5).min()) < 20
        assert 0.66 < int(stride.argmax()) / len(stride) < 0.80
        rising = at(0.45, 0.66)
        assert float(rising.diff().min()) > -0.5, "no second hump between toe-off and the swing"


def test_people_stand_all_but_straight():
    """Recorded people who stand about bend the median knee by 3 to 14 degrees."""
    for subject in range(len(SUBJECTS)):
        motion = take("idle", subject, 1, seconds=10.0).motion
        median = float(torch.cat((flexion(motion, "left"), flexion(motion, "right"))).median())
        assert 3 < median < 14


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


def test_joint_angles_tell_people_apart():
    """Of 16 walks with their own seeds and speeds, all but one are nearest to others of the same person."""

    def habits(subject, seed):
        motion = take("walk", subject, seed, seconds=5.0).motion
        middle = motion.rot[30:-30]
        trunk, elbow = middle[:, 3], middle[:, motion.skeleton.index("left_elbow")]
        bent = torch.atan2(elbow[:, 0, 2], elbow[:, 0, 0]).abs()
        shoulder = middle[:, motion.skeleton.index("left_shoulder"), :, 0]
        foot = motion.world[1][:, motion.skeleton.index("left_ankle")][:30, :2, 2].mean(0)
        out = torch.atan2(foot[0], foot[1]).abs()
        return torch.stack((bent.mean(), shoulder[:, 0].mean(), trunk[:, 2, 1].mean(), out))

    table = torch.stack([habits(subject, seed) for subject in range(4) for seed in range(4)])
    table = (table - table.mean(0)) / table.std(0)
    who = torch.arange(16) // 4
    right = 0
    for i in range(16):
        others = torch.arange(16) != i
        centres = torch.stack([table[others & (who == k)].mean(0) for k in range(4)])
        right += int((centres - table[i]).norm(dim=-1).argmin()) == int(who[i])
    assert right >= 15


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


def test_arms_swing_against_the_legs():
    motion = take("walk", seconds=6.0, speed=1.3).motion
    inside = slice(40, motion.frames - 40)
    p = motion.positions[inside]
    index = motion.skeleton.index
    hand = p[:, index("left_wrist"), 1] - p[:, index("left_shoulder"), 1]
    foot = p[:, index("left_ankle"), 1] - p[:, index("left_hip"), 1]
    assert torch.corrcoef(torch.stack((hand, foot)))[0, 1] < -0.6


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


def test_walks_curve_and_faster_walks_step_longer():
    turned = take("walk", seconds=6.0, turn=1.5).motion
    first, last = turned.rot[0, 0, :, 2], turned.rot[-1, 0, :, 2]
    angle = torch.atan2(first[0] * last[1] - first[1] * last[0], (first * last)[:2].sum())
    assert float(angle) == pytest.approx(1.5, abs=0.2)


def test_a_seat_is_reached():
    motion = take("sit", seat=0.45).motion
    assert float(motion.root[:, 2].min()) == pytest.approx(0.54, abs=0.02)


def test_quintic_matches_scipy():
    start, stop, duration = (0.3, -1.0, 2.0), (1.1, 0.5, -3.0), 0.7
    ours = torch.tensor([quintic(start, stop, duration)], dtype=torch.float64)
    t = torch.linspace(0, 0.699, 50, dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    x = evaluate(0.3 * one, torch.tensor([0]), 0 * one, duration * one, ours, t)[0]
    referee = BPoly.from_derivatives([0, duration], [start, stop])
    torch.testing.assert_close(x, torch.from_numpy(referee(t.numpy())), atol=1e-12, rtol=0)


def test_two_bones_reach_their_target():
    g = torch.Generator().manual_seed(0)
    start = torch.randn(200, 3, generator=g, dtype=torch.float64)
    way = torch.nn.functional.normalize(torch.randn(200, 3, generator=g, dtype=torch.float64), dim=-1)
    target = start + way * (0.4 + 0.45 * torch.rand(200, 1, generator=g, dtype=torch.float64))
    hinge = torch.randn(200, 3, generator=g, dtype=torch.float64)
    upper, lower, axis, flexion = two_bone(start, target, hinge, 0.45, 0.46)
    torch.testing.assert_close(start + 0.45 * upper + 0.46 * lower, target, atol=1e-9, rtol=0)
    torch.testing.assert_close((upper * axis).sum(-1), torch.zeros(200, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close((upper * lower).sum(-1).acos(), flexion, atol=1e-6, rtol=0)


@pytest.mark.parametrize("subject", range(len(SUBJECTS)))
@pytest.mark.parametrize("seed", range(3))
def test_over_knees_and_hands_to_the_belly_and_up(subject, seed):
    """Each knee and each wrist bears twice, planted; the body lies flat in between and stands at the end."""
    motion = take("floor", subject, seed, way="kneel").motion
    found = audit(motion)
    assert found.contact_speed < MILLIMETRE and found.contact_height < MILLIMETRE
    assert found.penetration < MILLIMETRE and found.limit_excess == 0, found.at
    column = motion.skeleton.contact_names.index
    for joint in ("left_knee", "right_knee", "left_wrist", "right_wrist"):
        on = motion.contacts[:, column(joint)] * (motion.root[:, 2] > 0.35)  # lower, they may rest as well
        assert int((on.diff() > 0).sum()) == 2
        assert float(on.mean()) > 0.05
    assert motion.contacts[:, column("pelvis")].any()
    assert float(motion.positions[..., motion.skeleton.index("head"), 2].min()) < 0.2
    assert float(motion.root[-1, 2]) == pytest.approx(SUBJECTS[subject].standing, abs=0.02)


def test_the_floor_is_reached_in_more_than_one_way():
    column = SUBJECTS[0].skeleton.contact_names.index("left_knee")
    knelt = {bool(take("floor", 0, seed).motion.contacts[:, column].any()) for seed in range(6)}
    assert knelt == {True, False}


def test_a_lifted_knee_is_caught():
    """Negative control: knees said to bear a centimetre above the floor."""
    motion = take("floor", way="kneel").motion
    assert audit(replace(motion, root=motion.root + torch.tensor([0, 0, 0.01]))).contact_height > 5 * MILLIMETRE


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


@pytest.mark.parametrize("name", ACTIONS)
def test_arms_stay_out_of_the_trunk(name):
    for subject in range(len(SUBJECTS)):
        assert audit(take(name, subject, 2).motion).arm_depth < 0.02


def test_an_arm_through_the_trunk_is_caught():
    """Negative control: an upper arm turned down past the side."""
    motion = take("idle").motion
    rot = motion.rot.clone()
    rot[:, motion.skeleton.index("left_shoulder")] = rotation_about("z", torch.tensor(-2.0))
    assert audit(replace(motion, rot=rot)).arm_depth > 0.05
