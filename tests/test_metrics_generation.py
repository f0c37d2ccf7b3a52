"""Distances and manifolds: against loops, scipy, closed forms, and sets that are wrong on purpose."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch

from motionlab import metrics
from motionlab.errors import DataError, ShapeError
from tests.draws import seeded


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
    assert metrics.frechet(square, square * torch.tensor([2.0, 0.0])) == pytest.approx(
        2
    )  # singular: (1 - 2)^2 + (1 - 0)^2


def test_frechet_with_fewer_samples_than_features_is_zero_for_equal_sets():
    x = correlated(20, 50, 3)
    assert metrics.frechet(x, x) < 1e-9 * x.var(0).sum().item()
    assert metrics.frechet(x, x + 1) == pytest.approx(50, rel=1e-9)


# ------------------------------------------------------------------------------------------------- manifolds
def naive_manifold(a, b, k):
    """Share of b inside the balls around a that reach the k-th neighbour, itself counted as the 0-th."""
    radii = [np.partition([math.dist(p, q) for q in a], k)[k] for p in a]
    return np.mean([any(math.dist(p, q) <= r for p, r in zip(a, radii, strict=True)) for q in b])


def naive_density_coverage(fake, real, k):
    radii = [sorted(math.dist(p, q) for q in real)[k] for p in real]
    inside = [[math.dist(p, f) < r for p, r in zip(real, radii, strict=True)] for f in fake]
    density = sum(map(sum, inside)) / (k * len(fake))
    return density, np.mean([any(row[j] for row in inside) for j in range(len(real))])


@pytest.mark.parametrize("k", [1, 3, 5])
def test_manifolds_agree_with_loops(k):
    x, y = normal(40, 3, 1, scale=0.5, shift=1.0), normal(50, 3, 2)
    precision, recall = metrics.precision_recall(x, y, k)
    assert precision == pytest.approx(naive_manifold(y.tolist(), x.tolist(), k))
    assert recall == pytest.approx(naive_manifold(x.tolist(), y.tolist(), k))
    assert 0 < recall < 1
    assert metrics.density_coverage(x, y, k) == pytest.approx(naive_density_coverage(x.tolist(), y.tolist(), k))


def test_manifolds_by_hand_on_the_edge_of_a_ball():
    """Real samples 0..4 on a line, k = 1: every ball has radius 1. Precision counts the edge, density does not."""
    real = torch.arange(5.0)[:, None]
    fake = torch.tensor([[1.0], [-1.0], [5.5]])
    assert metrics.precision_recall(fake, real, 1)[0] == pytest.approx(2 / 3)
    assert metrics.density_coverage(fake, real, 1) == pytest.approx((1 / 3, 1 / 5))  # only 1 lies in a ball, its own


def test_equal_sets_score_one_and_disjoint_sets_zero():
    x = normal(80, 4, 3)
    far = x + 1000
    assert metrics.precision_recall(x, x.clone()) == (1, 1) and metrics.precision_recall(x, far) == (0, 0)
    density, coverage = metrics.density_coverage(x, x.clone())
    assert density == pytest.approx(1, abs=0.2) and coverage == 1 and metrics.density_coverage(x, far) == (0, 0)
    turn, shift = torch.linalg.qr(normal(4, 4, 5)).Q, 7.0
    y = normal(80, 4, 4)
    assert metrics.precision_recall(3 * x @ turn + shift, 3 * y @ turn + shift) == metrics.precision_recall(x, y)


def test_control_mode_collapse_costs_recall_and_coverage_but_not_precision():
    """Half of a two-humped set is never generated."""
    hump = torch.tensor([8.0, 0.0, 0.0])
    real = torch.cat((normal(150, 3, 1), normal(150, 3, 2) + hump))
    good = torch.cat((normal(150, 3, 3), normal(150, 3, 4) + hump))
    collapsed = normal(300, 3, 5)
    for fake, whole in ((good, True), (collapsed, False)):
        (precision, recall), (_, coverage) = metrics.precision_recall(fake, real), metrics.density_coverage(fake, real)
        assert precision > 0.8 and (recall > 0.8) == whole and (coverage > 0.8) == whole
    assert metrics.precision_recall(collapsed, real)[1] == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize("measure", [metrics.frechet, metrics.precision_recall, metrics.density_coverage])
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
