import pytest
import torch

from motionlab.posterior import mixed, sample
from studies.nb09_posterior import agreement

ROOT = torch.linalg.cholesky(torch.tensor([[1.0, 0.9], [0.9, 1.0]], dtype=torch.float64))
PRECISION = (ROOT @ ROOT.mT).inverse()


def gaussian(x):
    return -0.5 * (x @ PRECISION * x).sum(-1)


def two_places(x):
    """Two standard normals, 20 apart."""
    return torch.logaddexp(-0.5 * x.square().sum(-1), -0.5 * (x - 20.0).square().sum(-1))


def ensembles(log_prob, moves, begin, count=3, **how):
    found = []
    for seed in range(count):
        generator = torch.Generator().manual_seed(seed)
        start = begin(seed) + torch.randn(16, 2, generator=generator, dtype=torch.float64)
        how = {"steps": 20_000, "block": 250} | how
        found.append(sample(log_prob, start, names="ab", generator=generator, moves=moves, **how))
    return found


def test_ensembles_of_one_gaussian_agree():
    found = ensembles(gaussian, mixed(torch.zeros(2), ROOT), lambda seed: 3.0 * seed)
    assert all(each.long_enough for each in found)
    assert agreement.worst(found) <= agreement.AGREED
    assert agreement.of_walkers(found[0]) < 1.1  # a walker alone is 50 autocorrelation times long, half of it half


def test_control_ensembles_in_two_places_pass_by_their_times_and_not_by_each_other():
    """What 50 autocorrelation times cannot see: each ensemble has a guess of one of the two places."""
    guesses = [mixed(torch.full((2,), at), torch.eye(2)) for at in (0.0, 20.0)]
    found = [
        ensembles(two_places, guess, lambda seed, at=at: at, count=1, steps=6000)[0]
        for guess, at in zip(guesses, (0.0, 20.0), strict=True)
    ]
    assert all(each.long_enough for each in found)
    assert agreement.worst(found) > 5
    assert max(agreement.of_walkers(each) for each in found) < 1.1  # each looks done by its own walkers, too


def test_formula_by_hand():
    """Means 0 and 1 of two chains that do not drift, variances 1: between is 1/3 over four halves."""
    one = torch.tensor([-1.0, 1.0, -1.0, 1.0]).reshape(4, 1, 1).repeat(500, 1, 1)
    assert agreement.r_hat([one, one + 1.0]).item() == pytest.approx((4 / 3) ** 0.5, rel=1e-3)
    assert agreement.r_hat([one, one]).item() == pytest.approx(1.0, abs=1e-6)
    drifting = torch.linspace(0, 1, 1000).reshape(-1, 1, 1)
    assert agreement.r_hat([drifting, drifting]).item() > 1.5  # a drift that both share is seen in the halves
