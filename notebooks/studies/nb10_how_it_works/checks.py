"""Checks of the maths, one row each: our tables and steps beside formulas, Bayes' rule, diffusers and exact Gaussians.

Source: thesis Eqs. 4.1-4.7; Ho et al. 2020; Nichol and Dhariwal 2021; Song et al. 2021.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.diffusion import sampling
from motionlab.diffusion.sampling import MOST, NoiseSchedule, cosine

F64 = torch.float64
SIZE = 5  # of the Gaussian data


@dataclass(frozen=True)
class Check:
    """error: largest difference from ``against``. tolerance: fixed beforehand; both in the unit of the quantity."""

    what: str
    equation: str
    against: str
    error: float
    tolerance: float = 1e-6

    @property
    def holds(self) -> bool:
        """Within its tolerance; NaN is not."""
        return self.error <= self.tolerance


# -------------------------------------------------------------------------------------------------- the formulas
def all_of(power: float, generator: torch.Generator) -> list[Check]:
    """Every check of Eqs. 4.1 to 4.7, with Eq. 4.4 to this power of the cosine."""
    return of_schedule(cosine(1000, power=power), generator) + of_samplers(cosine(50, power=power), generator)


def table(rows: list[Check], others: list[Check]) -> list[dict[str, str]]:
    """Checks beside the same of another schedule, as a table's rows."""
    return [
        {
            "what": row.what, "Eq.": row.equation, "against": row.against, "off by": f"{row.error:.0e}",
            "holds": "yes" if row.holds else "**no**", "as printed, off by": f"{other.error:.0e}",
        }
        for row, other in zip(rows, others, strict=True)
    ]  # fmt: skip


def of_schedule(schedule: NoiseSchedule, generator: torch.Generator) -> list[Check]:
    """A schedule said to be the cited paper's, s = 0.008: its tables, its noising, its posterior, its respacing."""
    from diffusers import DDPMScheduler

    steps = len(schedule)
    theirs = DDPMScheduler(steps, beta_schedule="squaredcos_cap_v2").betas.double()
    x0, noise = (torch.randn(steps, 3, generator=generator, dtype=F64) for _ in range(2))
    xt = schedule.noised(x0, torch.arange(steps), noise)
    beta, level = _by_hand(steps)
    few = schedule.respaced(10)
    stamps = [round(k * (steps - 1) / 9) for k in range(10)]
    back = schedule.noise_of(x0, xt, torch.arange(steps))
    same = "the paper's at the same stamps"
    of_mean, of_variance = _bayes(schedule, x0, xt)
    return [
        Check("alpha-bar", "4.4", "cos² of the cited paper, in plain floats", _most(schedule.alpha_bar - level)),
        Check("beta", "4.1", "diffusers, squaredcos_cap_v2 (float32)", _most(schedule.beta - theirs)),
        Check("x_t from x_0", "4.3", "Eq. 4.1 walked step by step", _most(xt - _walked(x0, noise, beta))),
        Check("posterior mean", "4.6, 4.7", "product of two Gaussians", of_mean),
        Check("posterior variance", "4.7", "product of two Gaussians", of_variance),
        Check("noise from x_0 and x_t", "4.3", "the noise put in", _most(back - noise)),
        Check("10 of the steps: alpha-bar", "4.4", same, _most(few.alpha_bar - level[stamps])),
        Check("10 of the steps: product of alpha", "4.3", same, _most(few.alpha.cumprod(0) - level[stamps])),
    ]


def of_samplers(schedule: NoiseSchedule, generator: torch.Generator) -> list[Check]:
    """DDPM and DDIM from the same noise as diffusers' schedulers, whose betas are made for Eq. 4.4 with its square."""
    from diffusers import DDIMScheduler, DDPMScheduler

    data, count = gaussian_data(generator), len(schedule)
    true = cosine(count)
    denoise, start = data.denoiser(schedule), torch.randn(4, SIZE, generator=generator, dtype=F64)
    state = generator.get_state()
    options = {"prediction_type": "sample", "clip_sample": False, "trained_betas": true.beta.numpy()}
    rows = []
    for name, made, draws in (
        ("DDPM, all steps", DDPMScheduler(count, variance_type="fixed_small", **options), True),
        ("DDIM, all steps", DDIMScheduler(count, set_alpha_to_one=True, **options), False),
    ):
        made.alphas_cumprod, made.betas, made.alphas = true.alpha_bar, true.beta, true.alpha  # float64, not float32
        made.set_timesteps(count)
        generator.set_state(state)
        x = start
        for t in made.timesteps:
            x = made.step(denoise(x, t.expand(len(x))), t, x, generator=generator if draws else None).prev_sample
        generator.set_state(state)
        ours = sampling.ddpm(denoise, schedule, start, generator) if draws else sampling.ddim(denoise, schedule, start)
        rows.append(Check(name, "4.6" if draws else "Song 2021", f"diffusers, {type(made).__name__}", _most(ours - x)))
    return rows


def _by_hand(steps: int) -> tuple[list[float], Tensor]:
    f = [math.cos((t / steps + 0.008) / 1.008 * math.pi / 2) ** 2 for t in range(steps + 1)]
    beta = [min(1 - f[t + 1] / f[t], MOST) for t in range(steps)]
    level, found = 1.0, []
    for b in beta:
        level *= 1 - b
        found.append(level)
    return beta, torch.tensor(found, dtype=F64)


def _walked(x0: Tensor, noise: Tensor, beta: list[float]) -> Tensor:
    """Row t: x_0 noised t + 1 times by Eq. 4.1, mean and deviation step by step."""
    factor, variance, rows = 1.0, 0.0, []
    for t, b in enumerate(beta):
        factor, variance = math.sqrt(1 - b) * factor, (1 - b) * variance + b
        rows.append(factor * x0[t] + math.sqrt(variance) * noise[t])
    return torch.stack(rows)


def _bayes(schedule: NoiseSchedule, x0: Tensor, xt: Tensor) -> tuple[float, float]:
    """Largest errors of mean and variance of N(x_{t-1}; sqrt(a) x_0, 1 - a) N(x_t; sqrt(alpha) x_{t-1}, beta)."""
    t = torch.arange(1, len(schedule))
    mean, variance = schedule.posterior(x0[1:], xt[1:], t)
    beta, level = _by_hand(len(schedule))
    a, step = level[:-1, None], torch.tensor(beta[1:], dtype=F64)[:, None]
    precision = 1 / (1 - a) + (1 - step) / step
    expected = (a.sqrt() * x0[1:] / (1 - a) + (1 - step).sqrt() * xt[1:] / step) / precision
    return _most(mean - expected), _most(variance - 1 / precision)


def _most(x: Tensor) -> float:
    return x.abs().max().item()


# ------------------------------------------------------------------------------------------------- exact Gaussians
@dataclass(frozen=True, eq=False)
class GaussianData:
    """Data whose denoiser is known exactly: x_0 ~ N(mean (D,), covariance (D, D)), float64."""

    mean: Tensor
    covariance: Tensor

    def denoiser(self, schedule: NoiseSchedule):
        """E[x_0 | x_t] = m + sqrt(a) C (a C + (1 - a) I)^-1 (x_t - sqrt(a) m): (x_t (B, D), stamps (B,)) -> (B, D)."""
        values, axes = torch.linalg.eigh(self.covariance)
        level = dict(zip(schedule.stamps.tolist(), schedule.alpha_bar.tolist(), strict=True))

        def denoise(x: Tensor, stamps: Tensor) -> Tensor:
            a = x.new_tensor([level[t] for t in stamps.tolist()])[:, None]
            gain = a.sqrt() * values / (a * values + 1 - a)
            return self.mean + ((x - a.sqrt() * self.mean) @ axes * gain) @ axes.mT

        return denoise

    def sampled(self, schedule: NoiseSchedule) -> tuple[Tensor, Tensor]:
        """Mean (D,) and covariance (D, D) of what DDPM makes of this schedule with the exact denoiser, from N(0, I)."""
        values, axes = torch.linalg.eigh(self.covariance)
        m, mean, var = self.mean @ axes, torch.zeros_like(self.mean), torch.ones_like(values)
        for t in range(len(schedule) - 1, -1, -1):
            a = schedule.alpha_bar[t]
            gain = a.sqrt() * values / (a * values + 1 - a)
            one, zero = torch.ones((), dtype=a.dtype), torch.zeros((), dtype=a.dtype)
            stay, extra = schedule.posterior(zero, one, t)
            towards, _ = schedule.posterior(one, zero, t)
            factor = towards * gain + stay
            mean = factor * mean + towards * (m - gain * a.sqrt() * m)
            var = factor**2 * var + (extra if t else 0.0)
        return axes @ mean, axes * var @ axes.mT


def gaussian_data(generator: torch.Generator) -> GaussianData:
    """A Gaussian with random mean and covariance, float64, of about unit size."""
    a = torch.randn(SIZE, SIZE, generator=generator, dtype=F64)
    mean = torch.randn(SIZE, generator=generator, dtype=F64)
    return GaussianData(mean, a @ a.T / SIZE + 0.05 * torch.eye(SIZE, dtype=F64))


def deviation(x: Tensor, mean: Tensor, covariance: Tensor) -> float:
    """Worst entry of the sample mean and covariance of x (N, D), in standard errors of Gaussian samples."""
    n, v = len(x), covariance.diagonal()
    of_mean = (x.mean(0) - mean) / (v / n).sqrt()
    of_covariance = (torch.cov(x.T) - covariance) / ((v[:, None] * v + covariance.square()) / n).sqrt()
    return max(_most(of_mean), _most(of_covariance))


def end_to_end(
    schedule: NoiseSchedule, steps: int, count: int, generator: torch.Generator, *, off: float = 0.0
) -> dict[str, float]:
    """DDPM in ``steps`` of a schedule's steps on Gaussian data with its exact denoiser, ``count`` samples from noise:
    worst entries in standard errors, "chain" from what the chain must give (``GaussianData.sampled``), "data" from the
    data. off: added to the mean that samples are compared with, a control."""
    data, few = gaussian_data(generator), schedule.respaced(steps)
    noise = torch.randn(count, SIZE, generator=generator, dtype=F64)
    denoise = data.denoiser(few)
    x = sampling.ddpm(lambda x, stamps: denoise(x, stamps[:1]), few, noise, generator)  # all at one step
    mean, covariance = data.sampled(few)
    return {"chain": deviation(x, mean + off, covariance), "data": deviation(x, data.mean + off, data.covariance)}


def covariance_error(schedule: NoiseSchedule, data: GaussianData) -> float:
    """|C_sampled - C| / |C| (Frobenius) of DDPM with the exact denoiser, from N(0, I): closed form, no draws."""
    _, covariance = data.sampled(schedule)
    return ((covariance - data.covariance).norm() / data.covariance.norm()).item()
