import math
from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.metrics import distribution
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from studies.nb01_data import sources_compared
from tests.draws import seeded


def gaussians(shift, n=400):
    g = seeded(0)
    return torch.randn(n, 1, generator=g), torch.randn(n, 1, generator=g) + shift


def test_energy_distance_of_two_gaussians_is_the_known_one():
    # D^2 = 2 E|X-Y| - 2 E|X-X'|, where E|N(m, 2)| = 2/sqrt(pi) exp(-m^2/4) + m erf(m/2)
    m = 1.5
    mean_abs = 2 / math.sqrt(math.pi) * math.exp(-(m**2) / 4) + m * math.erf(m / 2)
    truth = math.sqrt(2 * mean_abs - 2 * 2 / math.sqrt(math.pi))
    assert sources_compared._energy_distance(*gaussians(m, n=4000)) == pytest.approx(truth, rel=0.03)


def statue(frames=90, height=0.992):
    rot = torch.eye(3).repeat(frames, 22, 1, 1)
    rot[:, 0] = UPRIGHT
    root = torch.zeros(frames, 3)
    root[:, 2] = height
    return Motion(STANDARD, root, rot, 30.0)


def noisy(seed, shift, count=300):
    source = seeded(seed)
    values = {k: shift + torch.randn(count, generator=source) for k in distribution.DESCRIPTION_UNITS}
    return distribution.Described(values, torch.arange(count // 10).repeat(10))


def test_a_judge_tells_apart_what_differs_and_tosses_a_coin_otherwise():
    assert distribution.told_apart(noisy(0, 0.0), noisy(1, 0.0)) == pytest.approx(0.5, abs=0.08)
    assert distribution.told_apart(noisy(0, 0.0), noisy(1, 2.0)) > 0.95
    mine, other = sources_compared.halves(noisy(0, 0.0), seeded(0))
    assert not set(mine.groups.tolist()) & set(other.groups.tolist())
    assert len(mine.groups) + len(other.groups) == 300
    mixture = [noisy(2, 0.0), noisy(3, 3.0), noisy(4, 3.0)]  # a third like ours, wherever it stands in the pool
    pools = [sources_compared.pool(parts) for parts in (mixture, mixture[::-1])]
    found = [distribution.told_apart(noisy(0, 0.0), pool) for pool in pools]
    assert all(0.7 < share < 0.95 for share in found) and found[0] == pytest.approx(found[1], abs=0.06)


def test_quick_motion_is_the_share_above_four_hertz():
    motion = statue()
    t = torch.arange(90) / 30
    slow, fast = (motion.root + torch.stack((0.1 * (2 * math.pi * f * t).sin(), 0 * t, 0 * t), -1) for f in (1.0, 8.0))
    share = [distribution.describe(replace(motion, root=r))["quick motion"].item() for r in (slow, fast)]
    assert share[0] < 1 < 99 < share[1]


def test_feet_on_the_floor_are_measured():
    on, off = (distribution.describe(statue(height=h))["feet on the floor"].item() for h in (0.992, 1.4))
    assert (on, off) == (100, 0)


def test_describe_a_turning_gliding_statue():
    t = torch.arange(30) / 30
    aa = torch.zeros(30, 22, 3)
    aa[:, STANDARD.index("left_knee"), 0] = aa[:, STANDARD.index("right_knee"), 0] = math.radians(40)
    rot = rotation.axis_angle_to_matrix(aa)
    rot[:, 0] = rotation.rotation_about("z", math.radians(90) * t) @ UPRIGHT
    root = torch.stack((1.2 * t, torch.zeros(30), torch.full((30,), 0.992)), -1)
    found = distribution.describe(Motion(STANDARD, root, rot, 30.0))
    assert set(found) == set(distribution.DESCRIPTION_UNITS)
    expected = {"root speed": 1.2, "turning rate": 90.0, "knee flexion": 40.0, "elbow flexion": 0.0}
    for name, value in expected.items():
        assert found[name].item() == pytest.approx(value, abs=0.05), name
