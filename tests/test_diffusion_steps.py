"""Samplers in few steps on data whose best denoiser is known, the measures that compare them, and the x_0 estimate."""

import pytest
import torch
from tiny_diffusion import tiny

from motionlab.diffusion import late, sampling, steps, whitened
from motionlab.diffusion.gaussian import GaussianData
from motionlab.diffusion.schedule import cosine
from motionlab.diffusion.spectral import cosines
from motionlab.errors import ShapeError
from motionlab.metrics.generation import polynomial_mmd

F64 = torch.float64
T = 16
POWER = 4 / (1 + torch.arange(T, dtype=F64)) ** 2  # of each cosine, from slow to quick
SCHEDULE = cosine(1000)


@pytest.fixture(scope="module")
def denoise():
    """The exact denoiser of Gaussian curves (B, T, 1) with that spectrum."""
    c = cosines(T).double()
    inner = GaussianData(torch.zeros(T, dtype=F64), c.T @ torch.diag(POWER) @ c).denoiser(SCHEDULE)
    return lambda x, stamps: inner(x[..., 0], stamps)[..., None]


def noise(count, seed=0):
    return torch.randn(count, T, 1, generator=torch.Generator().manual_seed(seed), dtype=F64)


def spectrum_of(x):
    return (cosines(T).to(x) @ x).square().mean(0)[:, 0] / POWER


@pytest.mark.parametrize("sampler", steps.SAMPLERS)
def test_every_sampler_comes_near_the_data(denoise, sampler, generator):
    """Power of the slow half within a quarter in 50 steps, and less well in 3 unless the solver knows the spectrum."""
    power = {
        n: spectrum_of(steps.walk(sampler, denoise, SCHEDULE, noise(1500), n, generator, POWER[:, None]))[: T // 2]
        for n in (3, 50)
    }
    assert (power[50] - 1).abs().max() < 0.25
    assert sampler == "whitened flow" or (power[3] - 1).abs().max() > 0.3


@pytest.mark.parametrize("sampler", steps.SAMPLERS)
def test_the_network_is_told_the_noise_that_there_is(sampler, generator):
    """Where all data is zero, x_t is noise of deviation sqrt(1 - alpha_bar) of the *original* process's stamp."""
    seen = []

    def nothing(x, stamps):
        seen.append((x.std().item(), (1 - SCHEDULE.alpha_bar[stamps[0]]).sqrt().item()))
        return torch.zeros_like(x)

    steps.walk(sampler, nothing, SCHEDULE, noise(2000), 8, generator, torch.full((T, 1), 1e-6, dtype=F64))
    assert len(seen) == 8 and len({round(level, 6) for _, level in seen}) == 8
    assert all(std == pytest.approx(level, rel=0.03) for std, level in seen)


def test_the_whitened_flow_is_exact_in_one_step_where_motion_is_gaussian(denoise):
    x = noise(4000)
    exact = cosines(T).double().T @ (POWER.sqrt()[:, None] * (cosines(T).double() @ x))
    for order, count in ((1, 1), (2, 4)):
        few = whitened.spaced(SCHEDULE, POWER[:, None], count)
        found = whitened.flow(denoise, few, POWER[:, None], x, order=order)
        assert (found - exact).abs().max() < 5e-3  # the first noise is not quite all noise
    ddim = sampling.ddim(denoise, SCHEDULE.respaced(4), x)
    assert spectrum_of(ddim)[-4:].max() < 0.2 < 0.9 < spectrum_of(found)[-4:].min()


def test_the_second_order_follows_a_denoiser_that_is_not_gaussian():
    """Curves that all are one curve: the estimate is that curve; few steps of either order end there."""
    curve = torch.sin(torch.arange(T, dtype=F64) / 3)[:, None]
    few = whitened.spaced(SCHEDULE, torch.ones(T, 1), 6)
    off = {
        order: (whitened.flow(lambda x, s: curve.expand_as(x), few, torch.ones(T, 1), noise(5), order=order) - curve)
        for order in (1, 2)
    }
    assert off[2].abs().max() < off[1].abs().max() < 0.5


def test_steps_of_equal_angle():
    few = whitened.spaced(SCHEDULE, POWER[:, None], 7)
    weight = POWER.sqrt()[:, None]
    turn = (whitened.angles(few, POWER[:, None]) * weight).sum((1, 2)) / weight.sum()
    step = torch.cat((turn[:1], turn.diff()))
    assert few.stamps[-1] == 999 and step.max() / step.min() < 1.05
    crowded = whitened.spaced(cosine(10), POWER[:, None], 10)
    assert crowded.stamps.tolist() == list(range(10))
    with pytest.raises(ValueError, match="1 to 1000"):
        whitened.spaced(SCHEDULE, POWER[:, None], 0)


def test_bad_calls(denoise, generator):
    with pytest.raises(ShapeError):
        whitened.flow(denoise, SCHEDULE.respaced(3), POWER[:4, None], noise(2))
    with pytest.raises(ValueError, match="spectrum"):
        steps.walk("whitened flow", denoise, SCHEDULE, noise(2), 3, generator)
    with pytest.raises(ValueError, match="DDPM"):
        steps.draw(tiny(), "Euler", 3, 2, generator)
    with pytest.raises(ValueError, match="1 to 1000"):
        steps.draw(tiny(), "DDIM", 1001, 2, generator)


def test_drawn_motions_depend_on_the_generator_alone():
    a, b, c = (steps.draw(tiny(), "DDPM", 3, 5, torch.Generator().manual_seed(s), batch=2) for s in (1, 1, 2))
    assert a.root.shape[:1] == (5,) and torch.equal(a.root, b.root) and not torch.equal(a.root, c.root)


# ------------------------------------------------------------------------------------------------- measures
def test_contributions_are_the_jackknife_of_the_kernel_distance(generator):
    x, y = (torch.randn(n, 4, generator=generator, dtype=F64) + shift for n, shift in ((9, 0.3), (12, 0.0)))
    found = steps.contributions(x, y)
    whole = polynomial_mmd(x, y)
    without = torch.tensor([polynomial_mmd(torch.cat((x[:i], x[i + 1 :])), y) for i in range(9)], dtype=F64)
    assert found.mean().item() == pytest.approx(whole, abs=1e-10)
    assert (found - (9 * whole - 8 * without)).abs().max() < 1e-9


def test_sets_are_told_apart_where_they_differ(generator):
    x, y, z = (torch.randn(120, 3, generator=generator) + shift for shift in (0.0, 0.0, 2.5))
    assert steps.told_apart(x, y).mean() < 0.6 < 0.9 < steps.told_apart(x, z).mean()
    with pytest.raises(ShapeError):
        steps.told_apart(x, y[:50])


def test_the_best_point_is_the_nearest_of_those_quick_enough(generator):
    def point(name, n, shift):
        return steps.Point(name, n, torch.randn(60, 3, generator=generator) + shift, torch.ones(60), torch.zeros(60))

    points = [point("far", 5, 1.0), point("near", 10, 0.2), point("slow", 50, 0.0)]
    data = point("data", 0, 0.0)
    assert steps.best(points, data, 10).sampler == "near" and steps.best(points, data, 5).sampler == "far"
    with pytest.raises(ValueError, match="2 steps"):
        steps.best(points, data, 2)


# ------------------------------------------------------------------------------------- the estimate along the way
def test_the_path_ends_at_the_result(generator):
    path = late.record(tiny(), 4, generator, steps=10)
    assert path.estimates.shape[:2] == (10, 4) and path.left[-1] == 0 and path.left[0] == pytest.approx(0.9)
    assert path.left[path.at(0.3)] == pytest.approx(0.3)
    away = late.far(path)
    assert away[-1].abs().max() == 0 and away[0].min() > 0
    assert late.spread(path)[-1].mean() == pytest.approx(1.0)
    for bands in late.by_band(path).values():
        assert set(bands) == set(late.BANDS) and all(x[-1] == 0 and x[0] > 0 for x in bands.values())


def test_the_share_of_a_steady_change_is_the_share_of_steps(generator):
    model = tiny()
    numbers = torch.randn(1, 3, model.recipe.frames, model.layout.size, generator=generator)
    steady = late.Path(numbers * torch.arange(21)[:, None, None, None], torch.arange(20, -1, -1) / 21, model)
    assert late.share_late(steady, 0.1) == pytest.approx(dict.fromkeys(("root", "legs", "arms"), 2 / 20))
    early = late.Path(steady.estimates.clamp(-0.5, 0.5), steady.left, model)
    assert max(late.share_late(early, 0.1).values()) < 0.02


def test_bands_find_what_changes(generator):
    """A last step that adds only a quick wave to the legs shows in their quick band alone."""
    model = tiny()
    frames, legs = model.recipe.frames, late.columns(model)["legs"]
    still = torch.randn(1, 6, frames, model.layout.size, generator=generator)
    wave = cosines(frames)[-2][:, None] * legs
    path = late.Path(torch.cat((still, still + wave)), torch.tensor([0.5, 0.0]), model)
    found = late.by_band(path)
    assert found["legs"]["above 4 Hz"][0] > 0.01
    assert max(found["legs"]["1 to 4 Hz"][0], found["arms"]["above 4 Hz"][0], found["root"]["still"][0]) < 1e-5


def test_the_printed_schedule_is_told_with_stamps_of_equal_noise():
    ours = cosine(1000)
    other = late.printed(ours)
    told = ours.alpha_bar[other.stamps]
    assert (torch.logit(told) - torch.logit(other.alpha_bar))[5:-5].abs().max() < 0.25
    assert other.alpha_bar[499] == pytest.approx(0.7016, abs=2e-3) and ours.alpha_bar[499] < 0.5
