import torch
from scipy.optimize import curve_fit

from studies.nb06_profile.scaling import power_law


def points(a=3.0, b=0.7, noise=0.05, repeats=5, seed=0):
    x = torch.tensor([15.0, 30.0, 60.0, 120.0]).repeat(repeats).double()
    g = torch.Generator().manual_seed(seed)
    return x, a * x**b * (noise * torch.randn(len(x), generator=g, dtype=torch.float64)).exp()


def test_known_exponent_lies_in_the_interval_about_as_often_as_it_says():
    inside = 0
    for seed in range(10):
        _, low, high = power_law(*points(seed=seed), draws=1600).interval()
        inside += low <= 0.7 <= high
    assert inside >= 7  # 95 % of 10; P(6 or fewer) < 0.1 %


def test_median_and_width_agree_with_least_squares_in_the_logarithm():
    x, y = points()
    law = power_law(x, y)
    found, cov = curve_fit(lambda u, c, b: c + b * u, x.log().numpy(), y.log().numpy())
    median, low, high = law.interval()
    deviation = cov[1, 1] ** 0.5
    assert abs(median - found[1]) < 0.2 * deviation
    assert 0.85 < (high - low) / (2 * 2.1 * deviation) < 1.25  # 2.1: Student's t with 18 degrees of freedom
