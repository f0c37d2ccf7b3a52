"""Samplers on data whose denoiser is exact. Beside diffusers, step by step: ``test_diffusion_checks``."""

import pytest
import torch

from motionlab.diffusion import sampling
from motionlab.diffusion.sampling import cosine
from studies.nb10_diffusion.gaussian import GaussianData

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


def test_steps_that_are_not_walked_leave_the_mean_of_what_they_would_make(data, generator):
    """Against many walks of the same last steps: the exact denoiser's estimate is their mean, and varies less."""
    schedule, denoise = cosine(20), data.denoiser(cosine(20))
    x = noise(8, generator)
    early = sampling.ddpm(denoise, schedule, x, torch.Generator().manual_seed(0), rest=6)
    middle = sampling.ddpm(denoise, schedule, x, torch.Generator().manual_seed(0), rest=7)
    assert not torch.allclose(early, middle)
    same = torch.Generator().manual_seed(0)
    at = x
    for t in range(19, 6, -1):  # by hand, down to step 6
        mean, variance = schedule.posterior(denoise(at, torch.full((8,), t)), at, t)
        at = mean + variance.sqrt() * sampling.noise_like(at, same)
    walks = sampling.ddpm(denoise, schedule, at.repeat(1000, 1), generator, start=6).unflatten(0, (1000, 8))
    assert ((walks.mean(0) - early) / (walks.std(0) / 1000**0.5)).abs().max() < 5
    everything = sampling.ddpm(denoise, schedule, noise(4000, generator), generator)
    rested = sampling.ddpm(denoise, schedule, noise(4000, generator), generator, rest=6)
    assert torch.cov(rested.T).trace() < 0.99 * torch.cov(everything.T).trace()


def test_known_parts_come_back_where_the_last_steps_are_not_walked(data, generator):
    put = lambda x, x0, t: torch.where(torch.arange(5) < 2, 7.0, x)  # noqa: E731
    made = sampling.ddpm(data.denoiser(cosine(20)), cosine(20), noise(3, generator), generator, after=put, rest=4)
    assert (made[:, :2] == 7).all() and (made[:, 2:] != 7).all()


def test_what_rests_must_lie_before_the_first_step(data, generator):
    for rest, start in ((-1, None), (20, None), (6, 5)):
        with pytest.raises(ValueError, match="rest: expected"):
            sampling.ddpm(data.denoiser(cosine(20)), cosine(20), noise(2, generator), generator, rest=rest, start=start)
