"""Samplers in few steps on data whose best denoiser is known, the measures that compare them, and the x_0 estimate."""

from types import SimpleNamespace

import pytest
import torch

from motionlab.baselines import cosine_transform
from motionlab.diffusion import sampling
from motionlab.diffusion.sampling import cosine
from motionlab.errors import ShapeError
from motionlab.metrics.generation import _polynomial_mmd
from studies.nb10_diffusion.gaussian import GaussianData
from studies.nb13_steps import samplers, solvers

F64 = torch.float64
T = 16
POWER = 4 / (1 + torch.arange(T, dtype=F64)) ** 2  # of each cosine, from slow to quick
SCHEDULE = cosine(1000)


@pytest.fixture(scope="module")
def denoise():
    """The exact denoiser of Gaussian curves (B, T, 1) with that spectrum."""
    c = cosine_transform(T).double()
    inner = GaussianData(torch.zeros(T, dtype=F64), c.T @ torch.diag(POWER) @ c).denoiser(SCHEDULE)
    return lambda x, stamps: inner(x[..., 0], stamps)[..., None]


def noise(count, seed=0):
    return torch.randn(count, T, 1, generator=torch.Generator().manual_seed(seed), dtype=F64)


def spectrum_of(x):
    return (cosine_transform(T).to(x) @ x).square().mean(0)[:, 0] / POWER


@pytest.mark.parametrize("sampler", samplers.SAMPLERS)
def test_every_sampler_comes_near_the_data(denoise, sampler, generator):
    """Power of the slow half within a quarter in 50 steps, and less well in 3 unless the solver knows the spectrum."""
    power = {
        n: spectrum_of(samplers.walk(sampler, denoise, SCHEDULE, noise(1500), n, generator, POWER[:, None]))[: T // 2]
        for n in (3, 50)
    }
    assert (power[50] - 1).abs().max() < 0.25
    assert sampler == "whitened flow" or (power[3] - 1).abs().max() > 0.3


@pytest.mark.parametrize("sampler", samplers.SAMPLERS)
def test_the_network_is_told_the_noise_that_there_is(sampler, generator):
    """Where all data is zero, x_t is noise of deviation sqrt(1 - alpha_bar) of the *original* process's stamp."""
    seen = []

    def nothing(x, stamps):
        seen.append((x.std().item(), (1 - SCHEDULE.alpha_bar[stamps[0]]).sqrt().item()))
        return torch.zeros_like(x)

    samplers.walk(sampler, nothing, SCHEDULE, noise(2000), 8, generator, torch.full((T, 1), 1e-6, dtype=F64))
    assert len(seen) == 8 and len({round(level, 6) for _, level in seen}) == 8
    assert all(std == pytest.approx(level, rel=0.03) for std, level in seen)


def test_the_whitened_flow_is_exact_in_one_step_where_motion_is_gaussian(denoise):
    x = noise(4000)
    exact = cosine_transform(T).double().T @ (POWER.sqrt()[:, None] * (cosine_transform(T).double() @ x))
    for order, count in ((1, 1), (2, 4)):
        few = solvers.spaced(SCHEDULE, POWER[:, None], count)
        found = solvers.flow(denoise, few, POWER[:, None], x, order=order)
        assert (found - exact).abs().max() < 5e-3  # the first noise is not quite all noise
    ddim = sampling.ddim(denoise, SCHEDULE.respaced(4), x)
    assert spectrum_of(ddim)[-4:].max() < 0.2 < 0.9 < spectrum_of(found)[-4:].min()


def test_the_second_order_follows_a_denoiser_that_is_not_gaussian():
    """Curves that all are one curve: the estimate is that curve; few steps of either order end there."""
    curve = torch.sin(torch.arange(T, dtype=F64) / 3)[:, None]
    few = solvers.spaced(SCHEDULE, torch.ones(T, 1), 6)
    off = {
        order: (solvers.flow(lambda x, s: curve.expand_as(x), few, torch.ones(T, 1), noise(5), order=order) - curve)
        for order in (1, 2)
    }
    assert off[2].abs().max() < off[1].abs().max() < 0.5


def test_bad_calls(denoise, generator):
    with pytest.raises(ShapeError):
        solvers.flow(denoise, SCHEDULE.respaced(3), POWER[:4, None], noise(2))
    with pytest.raises(ValueError, match="spectrum"):
        samplers.walk("whitened flow", denoise, SCHEDULE, noise(2), 3, generator)
    model = SimpleNamespace(schedule=SCHEDULE)
    with pytest.raises(ValueError, match="DDPM"):
        samplers.draw(model, "Euler", 3, 2, generator)
    with pytest.raises(ValueError, match="1 to 1000"):
        samplers.draw(model, "DDIM", 1001, 2, generator)


# ------------------------------------------------------------------------------------------------- measures
def test_contributions_are_the_jackknife_of_the_kernel_distance(generator):
    x, y = (torch.randn(n, 4, generator=generator, dtype=F64) + shift for n, shift in ((9, 0.3), (12, 0.0)))
    found = samplers.contributions(x, y)
    whole = _polynomial_mmd(x, y)
    without = torch.tensor([_polynomial_mmd(torch.cat((x[:i], x[i + 1 :])), y) for i in range(9)], dtype=F64)
    assert found.mean().item() == pytest.approx(whole, abs=1e-10)
    assert (found - (9 * whole - 8 * without)).abs().max() < 1e-9
