"""emcee's walkers: right on a Gaussian and a bent ridge, and refused where a chain is too short to report."""

import emcee
import numpy as np
import pytest
import torch

from motionlab.errors import NotConverged
from studies.nb09_posterior.walkers import autocorrelation_times, walkers

COV = torch.tensor([[1.0, 1.8, 0.0], [1.8, 4.0, 0.0], [0.0, 0.0, 0.01]], dtype=torch.float64)
MEAN = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
PRECISION = COV.inverse()


def gaussian(x):
    return -0.5 * ((x - MEAN) @ PRECISION * (x - MEAN)).sum(-1)


def near(generator, many=24):
    noise = torch.randn(many, 3, generator=generator, dtype=torch.float64)
    return MEAN + noise @ torch.linalg.cholesky(COV).mT


def test_correlated_gaussian_is_found_within_sampling_error(generator):
    found = walkers(gaussian, near(generator), generator=generator, steps=20_000, block=500)
    draws = found.draws()
    effective = len(draws) / found.times.amax().item()  # walkers are not independent: this is the most there can be
    assert effective > 24 * 50 * 0.99
    sigma = COV.diagonal().sqrt()
    assert ((draws.mean(0) - MEAN).abs() < 5 * sigma / effective**0.5).all()
    assert ((draws.std(0) / sigma - 1).abs() < 5 / (2 * effective) ** 0.5).all()
    assert draws.mT.corrcoef()[0, 1] == pytest.approx(0.9, abs=5 * (1 - 0.81) / effective**0.5)


def test_a_bent_ridge_is_followed(generator):
    """Haario's banana: its draws, bent back, are Gaussian."""

    def banana(x):
        straight = x[:, 1] + 0.3 * (x[:, 0].square() - 4.0)
        return -0.5 * (x[:, 0].square() / 4.0 + straight.square())

    start = torch.tensor([1.0, 1.0]) + 0.5 * torch.randn(24, 2, generator=generator, dtype=torch.float64)
    found = walkers(banana, start, generator=generator, steps=20_000, block=500)
    x, y = found.draws().unbind(1)
    tolerance = 5 / (len(x) / found.times.amax().item()) ** 0.5
    assert x.std() == pytest.approx(2.0, rel=tolerance) and abs(x.mean()) < 2 * tolerance
    straight = y + 0.3 * (x.square() - 4.0)
    assert straight.std() == pytest.approx(1.0, rel=tolerance) and abs(straight.mean()) < tolerance


def test_times_of_a_process_with_a_known_one():
    """AR(1) with coefficient 0.9: (1 + 0.9) / (1 - 0.9) = 19 steps."""
    random = np.random.default_rng(3)
    x, chain = random.normal(size=16), np.empty((40_000, 16, 1))
    for step in range(len(chain)):
        x = 0.9 * x + (1 - 0.81) ** 0.5 * random.normal(size=16)
        chain[step, :, 0] = x
    assert autocorrelation_times(torch.from_numpy(chain)).item() == pytest.approx(19, rel=0.1)
    noise = torch.from_numpy(random.normal(size=(4000, 16, 1)))
    assert autocorrelation_times(noise).item() == pytest.approx(1, abs=0.05)


def test_control_short_chain_is_refused(generator):
    found = walkers(gaussian, near(generator), generator=generator, steps=60)
    with pytest.raises(NotConverged, match=r"needs 50.*remedy") as caught:
        found.draws()
    assert caught.value.history == found.times.tolist()


def test_control_one_look_at_a_long_chain_is_not_enough(generator):
    """The first look is long by the same estimate that decides when to stop; the next one has to agree."""
    how = {"generator": generator, "block": 800, "least": 12}
    once = walkers(gaussian, near(generator), steps=800, **how)
    assert (len(once.chain) >= 12 * once.times).all() and once.looks == 1
    assert len(walkers(gaussian, near(generator), steps=1600, **how).draws())


def test_control_walker_that_never_moves_is_refused(generator, monkeypatch):
    still = emcee.moves.MHMove(lambda points, random: (points + 1e6, np.zeros(len(points))))
    for name in ("DEMove", "DESnookerMove"):
        monkeypatch.setattr(emcee.moves, name, lambda: still)
    found = walkers(gaussian, near(generator), generator=generator, steps=200)
    assert (found.chain == found.chain[0]).all()
    with pytest.raises(NotConverged):
        found.draws()


def test_what_is_not_finite_is_impossible(generator):
    def half(x):
        return torch.where(x[:, 0] > 0, gaussian(x), torch.nan)

    start = near(generator)
    start[:, 0] = start[:, 0].abs() + 0.01
    found = walkers(half, start, generator=generator, steps=400)
    assert (found.chain[..., 0] > 0).all()
