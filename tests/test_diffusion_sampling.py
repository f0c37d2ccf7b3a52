"""Samplers on data whose denoiser is exact, and the noise. Beside diffusers: ``studies.nb10_how_it_works.checks``."""

import math

import pytest
import torch

from motionlab.diffusion import sampling
from motionlab.diffusion.sampling import MOST, NoiseSchedule, cosine
from motionlab.errors import ShapeError
from studies.nb10_how_it_works.checks import GaussianData

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


# ------------------------------------------------------------------------------------------------ the schedule
@pytest.fixture(scope="module")
def thousand():
    return cosine(1000)


def test_the_cosine_is_the_paper_s(thousand):
    f = [math.cos((t / 1000 + 0.008) / 1.008 * math.pi / 2) ** 2 for t in range(1001)]
    for t in (0, 1, 499, 900):
        assert thousand.alpha_bar[t].item() == pytest.approx(f[t + 1] / f[0], rel=1e-12)
    assert thousand.beta.max() <= MOST + 1e-12 and thousand.alpha_bar.dtype == torch.float64


def test_the_printed_form_never_lets_noise_win(thousand):
    printed = cosine(1000, power=1)
    for found, level in ((printed, 0.703), (thousand, 0.494)):
        assert found.alpha_bar[499] == pytest.approx(level, abs=1e-3)
    assert printed.alpha_bar[998] > 500 * thousand.alpha_bar[998]


def test_noise_goes_in_and_comes_out(thousand, generator):
    x0, noise = torch.randn(4, 5, 3, generator=generator), torch.randn(4, 5, 3, generator=generator)
    t = torch.tensor([0, 10, 500, 990])
    xt = thousand.noised(x0, t, noise)
    torch.testing.assert_close(thousand.noise_of(x0, xt, t), noise, atol=1e-3, rtol=1e-3)
    assert torch.equal(thousand.noised(x0, -1, noise), x0)
    mean, variance = thousand.posterior(x0, xt, 0)
    torch.testing.assert_close(mean, x0)
    assert variance.abs().max() < 1e-15
    one_by_one = torch.stack([thousand.noised(x0[i], int(t[i]), noise[i]) for i in range(4)])
    torch.testing.assert_close(xt, one_by_one)


def test_fewer_steps_keep_first_last_and_level(thousand):
    ten = thousand.respaced(10)
    assert ten.stamps.tolist() == [0, 111, 222, 333, 444, 555, 666, 777, 888, 999]
    assert torch.equal(ten.alpha_bar, thousand.alpha_bar[ten.stamps])
    assert torch.allclose((1 - ten.beta).cumprod(0), ten.alpha_bar)
    assert thousand.respaced(1000).stamps.tolist() == list(range(1000))
    assert thousand.respaced(1).stamps.tolist() == [999]
    assert ten.respaced(4).stamps.tolist() == [0, 333, 666, 999]


def test_tables_and_spacings_that_are_none(thousand):
    for count in (0, 1001):
        with pytest.raises(ValueError, match="steps"):
            thousand.respaced(count)
    with pytest.raises(ShapeError):
        NoiseSchedule(torch.tensor([0.5, 0.6]), torch.arange(2))
    with pytest.raises(ShapeError):
        NoiseSchedule(torch.tensor([0.6, 0.5]), torch.arange(3))
