"""Distances and manifolds: against loops, scipy, closed forms, and sets that are wrong on purpose."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch

from motionlab import metrics, rotation
from motionlab.errors import DataError, ShapeError
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from studies.nb01_data import sources_compared
from tests.draws import seeded
from tests.figures import standing


def normal(n, d, seed=0, scale=1.0, shift=0.0):
    return scale * torch.randn(n, d, generator=seeded(seed), dtype=torch.float64) + shift


def correlated(n, d, seed):
    return normal(n, d, seed) @ normal(d, d, seed + 100)


# --------------------------------------------------------------------------------------------------- Frechet
@pytest.mark.parametrize(("n", "d"), [(200, 8), (60, 20), (30, 1)])
def test_frechet_agrees_with_scipy(n, d):
    x, y = correlated(n, d, 1), correlated(n + 7, d, 2) + 0.3
    a, b = (np.atleast_2d(np.cov(z.numpy(), rowvar=False)) for z in (x, y))
    root = scipy.linalg.sqrtm(a @ b).real
    expected = ((x.mean(0) - y.mean(0)) ** 2).sum().item() + np.trace(a + b - 2 * root)
    assert metrics.frechet(x, y) == pytest.approx(expected, rel=1e-9)


def test_frechet_closed_forms():
    square = math.sqrt(1.5) * torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]).double() / math.sqrt(2)
    assert metrics.frechet(square, square + torch.tensor([3.0, 4.0])) == pytest.approx(25)
    assert metrics.frechet(square, square * torch.tensor([2.0, 3.0])) == pytest.approx(5)  # (1 - 2)^2 + (1 - 3)^2
    assert metrics.frechet(square, square * torch.tensor([2.0, 0.0])) == pytest.approx(2)  # singular


def test_frechet_with_fewer_samples_than_features_is_zero_for_equal_sets():
    x = correlated(20, 50, 3)
    assert metrics.frechet(x, x) < 1e-9 * x.var(0).sum().item()
    assert metrics.frechet(x, x + 1) == pytest.approx(50, rel=1e-9)


# ------------------------------------------------------------------------------------------------- manifolds
def naive_density_coverage(fake, real, k):
    radii = [sorted(math.dist(p, q) for q in real)[k] for p in real]
    inside = [[math.dist(p, f) < r for p, r in zip(real, radii, strict=True)] for f in fake]
    density = sum(map(sum, inside)) / (k * len(fake))
    return density, np.mean([any(row[j] for row in inside) for j in range(len(real))])


@pytest.mark.parametrize("k", [1, 3, 5])
def test_manifolds_agree_with_loops(k):
    x, y = normal(40, 3, 1, scale=0.5, shift=1.0), normal(50, 3, 2)
    assert metrics.density_coverage(x, y, k) == pytest.approx(naive_density_coverage(x.tolist(), y.tolist(), k))


def test_manifolds_by_hand_on_the_edge_of_a_ball():
    """Real samples 0..4 on a line, k = 1: every ball has radius 1, and its edge does not count."""
    real = torch.arange(5.0)[:, None]
    fake = torch.tensor([[1.0], [-1.0], [5.5]])
    assert metrics.density_coverage(fake, real, 1) == pytest.approx((1 / 3, 1 / 5))  # only 1 lies in a ball, its own


@pytest.mark.parametrize("measure", [metrics.frechet, metrics.density_coverage])
def test_bad_sets_are_refused(measure):
    good = normal(10, 3)
    for bad in (normal(10, 4), normal(1, 3), normal(10, 3)[0]):
        with pytest.raises(ShapeError):
            measure(bad, good)
        with pytest.raises(ShapeError):
            measure(good, bad)
    spoilt = good.clone()
    spoilt[4, 1] = torch.nan
    with pytest.raises(DataError, match=r"row 4.*remedy"):
        measure(good, spoilt)


# ------------------------------------------------------------------------------------------- physical descriptions
def noisy(seed, shift, people=30):
    table = shift + torch.randn(10 * people, len(sources_compared.DESCRIPTION_UNITS), generator=seeded(seed))
    return sources_compared.Windows(table, torch.arange(people).repeat_interleave(10), ("walk",) * len(table))


def test_a_judge_tells_apart_what_differs_and_tosses_a_coin_otherwise():
    for other in (noisy(1, 0.0), noisy(1, 0.0, people=4)):  # the few: a quarter of its windows are of the one judged
        assert sources_compared.judge(noisy(0, 0.0), other).mean() == pytest.approx(0.5, abs=0.08)
    assert len(found := sources_compared.judge(noisy(0, 0.0), noisy(1, 2.0))) == 30 and found.min() > 0.9


def test_what_differs_most_is_found_on_other_people():
    (made := noisy(1, 0.0)).table[:, 3] -= 1.0
    found = [sources_compared.lacking(noisy(0, 0.0), some) for some in (noisy(1, 0.0), made)]
    chance, most = (sources_compared.largest_elsewhere(gaps).mean() for gaps in found)
    assert chance < 0.3 and most == pytest.approx(1.0, abs=0.15)


def test_quick_motion_is_the_share_above_four_hertz():
    motion = standing(90)
    t = torch.arange(90) / 30
    slow, fast = (motion.root + torch.stack((0.1 * (2 * math.pi * f * t).sin(), 0 * t, 0 * t), -1) for f in (1.0, 8.0))
    share = [sources_compared.describe(replace(motion, root=r))["quick motion"].item() for r in (slow, fast)]
    assert share[0] < 1 < 99 < share[1]


def test_feet_on_the_floor_are_measured():
    motion = standing(90)
    lifted = replace(motion, root=motion.root + torch.tensor([0.0, 0.0, 0.4]))
    on, off = (sources_compared.describe(m)["feet on the floor"].item() for m in (motion, lifted))
    assert (on, off) == (100, 0)


def test_describe_a_turning_gliding_statue():
    t = torch.arange(30) / 30
    aa = torch.zeros(30, 22, 3)
    aa[:, STANDARD.index("left_knee"), 0] = aa[:, STANDARD.index("right_knee"), 0] = math.radians(40)
    rot = rotation.axis_angle_to_matrix(aa)
    rot[:, 0] = rotation.rotation_about("z", math.radians(90) * t) @ UPRIGHT
    root = torch.stack((1.2 * t, torch.zeros(30), torch.full((30,), 0.992)), -1)
    found = sources_compared.describe(Motion(STANDARD, root, rot, 30.0))
    assert set(found) == set(sources_compared.DESCRIPTION_UNITS)
    expected = {"root speed": 1.2, "turning rate": 90.0, "knee flexion": 40.0, "elbow flexion": 0.0}
    for name, value in expected.items():
        assert found[name].item() == pytest.approx(value, abs=0.05), name
