import pytest
import torch
from scipy.stats import chi2

from studies.nb09_posterior import calibration


def clips(generator, count=400, size=4, spread=1.0):
    """Truths and, for each, draws from a posterior that is right up to a factor on its spread."""
    factor = torch.randn(size, size, generator=generator, dtype=torch.float64)
    middle = torch.randn(count, size, generator=generator, dtype=torch.float64)
    truth = middle + torch.randn(count, size, generator=generator, dtype=torch.float64) @ factor.mT
    noise = torch.randn(count, 300, size, generator=generator, dtype=torch.float64)
    return middle[:, None] + spread * noise @ factor.mT, truth


def levels(draws, truth, factor=1.0):
    return torch.tensor([calibration.level_of(d, t, factor) for d, t in zip(draws, truth, strict=True)])


def test_right_posterior_holds_the_truth_as_often_as_it_says(generator):
    for row in calibration.coverage(levels(*clips(generator)), generator):
        assert row["low"] - 0.02 < row["level"] < row["high"] + 0.02
        assert row["n"] == 400


@pytest.mark.parametrize("spread", [0.5, 0.2])
def test_control_too_narrow_posterior_is_caught_by_as_much_as_chi_squared_says(generator, spread):
    row = next(
        r for r in calibration.coverage(levels(*clips(generator, spread=spread)), generator) if r["level"] == 0.9
    )
    expected = chi2.cdf(spread**2 * chi2.ppf(0.9, 4), 4)
    assert row["low"] - 0.02 < expected < row["high"] + 0.02
    assert row["high"] < 0.5


def test_ranks_are_uniform_where_the_posterior_is_right_and_lean_where_it_is_shifted(generator):
    draws, truth = clips(generator)
    found = torch.stack([calibration.ranks(d, t) for d, t in zip(draws, truth, strict=True)])
    assert (found.mean(0) - 0.5).abs().max() < 4 * 0.289 / 20
    assert (found.std(0) - 0.289).abs().max() < 0.03
    shifted = torch.stack([calibration.ranks(d, t + 5.0) for d, t in zip(draws, truth, strict=True)])
    assert shifted.mean() > 0.8


def test_factor_of_other_clips_restores_coverage_and_never_looks_at_its_own(generator):
    draws, truth = clips(generator, spread=0.25)
    stretches = torch.tensor([calibration.stretch(d, t) for d, t in zip(draws, truth, strict=True)])
    factors = calibration.fold_factors(stretches)
    inside = (stretches <= factors).double().mean()
    assert 0.85 < inside < 0.95
    own = stretches.clone()
    own[7] = 1e9
    assert calibration.fold_factors(own)[7] == factors[7]
    assert (calibration.fold_factors(own)[8] >= factors[8]) and calibration.fold_factors(own)[8] < 1e6
