"""Samplers on data whose denoiser is exact. Beside diffusers, step by step: ``studies.nb10_how_it_works.checks``."""

import pytest
import torch

from motionlab.diffusion import sampling
from motionlab.diffusion.sampling import cosine
from studies.nb10_how_it_works.gaussian import GaussianData

F64 = torch.float64


@pytest.fixture(scope="module")
def data():
    gen = torch.Generator().manual_seed(1)
    a = torch.randn(5, 5, generator=gen, dtype=F64)
    return GaussianData(torch.randn(5, generator=gen, dtype=F64), a @ a.T / 5 + 0.05 * torch.eye(5, dtype=F64))


def noise(count, generator):
    return torch.randn(count, 5, generator=generator, dtype=F64)


def off(x, mean, covariance):
    """Worst error of mean and covariance in standard errors of n samples."""
    n, spread = len(x), covariance.diagonal().sqrt()
    of_mean = ((x.mean(0) - mean) / spread * n**0.5).abs().max()
    of_covariance = ((torch.cov(x.T) - covariance) / (spread[:, None] * spread) * (n / 2) ** 0.5).abs().max()
    return max(of_mean.item(), of_covariance.item())


def test_the_exact_denoiser_is_the_regression(data, generator):
    """E[x_0 | x_t] by least squares on drawn pairs."""
    schedule = cosine(100)
    x0 = data.mean + noise(40_000, generator) @ torch.linalg.cholesky(data.covariance).T
    xt = schedule.noised(x0, 60, noise(40_000, generator))
    design = torch.cat((xt, torch.ones(len(xt), 1, dtype=F64)), 1)
    fitted = design @ torch.linalg.lstsq(design, x0).solution
    exact = data.denoiser(schedule)(xt, torch.full((len(xt),), 60))
    assert (fitted - exact).square().mean().sqrt() < 0.02


def test_many_steps_give_the_data_back(data):
    mean, covariance = data.sampled(cosine(1000))
    assert (mean - data.mean).abs().max() < 1e-6
    assert (covariance - data.covariance).abs().max() < 0.02
    _, few = data.sampled(cosine(1000).respaced(5))
    assert (few - data.covariance).abs().max() > 0.1


@pytest.mark.parametrize("steps", [50, 7])
def test_ddpm_samples_are_distributed_as_computed(data, generator, steps):
    schedule = cosine(1000).respaced(steps)
    x = sampling.ddpm(data.denoiser(schedule), schedule, noise(20_000, generator), generator)
    assert off(x, *data.sampled(schedule)) < 4.5
    wrong = GaussianData(data.mean + 0.1, data.covariance)
    assert off(x, *wrong.sampled(schedule)) > 6  # the control


def test_the_generator_decides(data):
    schedule = cosine(20)
    a, b, c = (
        sampling.ddpm(data.denoiser(schedule), schedule, torch.zeros(2, 5, dtype=F64), torch.Generator().manual_seed(s))
        for s in (1, 1, 2)
    )
    assert torch.equal(a, b) and not torch.equal(a, c)


def test_ddim_draws_nothing_and_ends_with_the_covariance_of_the_data(data):
    """An exact denoiser of Gaussian data makes it an affine map of the noise, of which the covariance is known."""
    schedule = cosine(1000)
    x = torch.cat((torch.zeros(1, 5, dtype=F64), torch.eye(5, dtype=F64)))
    many, few = (
        sampling.ddim(data.denoiser(schedule), steps, x) for steps in (schedule.respaced(500), schedule.respaced(4))
    )
    off = [((x[1:] - x[0]).mT @ (x[1:] - x[0]) - data.covariance).abs().max() for x in (many, few)]
    assert off[0] < 0.02 and (many[0] - data.mean).abs().max() < 0.01 and off[1] > 0.1
