"""From noise to signal: DDPM steps, DDIM steps, and every scheduler of diffusers.

A denoiser is any function (x_t (B, ...), stamps (B,)) -> x_0 estimate (B, ...). ``after`` is called as
after(x_{t-1}, x_0 estimate, t) -> x_{t-1} behind every step, which is where known parts are put back (``inpainting``).

Source: thesis Eq. 4.6; Ho et al. 2020; Song et al. 2021 (DDIM).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from inspect import signature

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab.diffusion.schedule import Schedule

Denoiser = Callable[[Tensor, Tensor], Tensor]
After = Callable[[Tensor, Tensor, int], Tensor]


def noise_like(x: Tensor, generator: torch.Generator) -> Tensor:
    """Standard normal numbers shaped as x, from an explicit generator."""
    return torch.randn(x.shape, generator=generator, dtype=x.dtype, device=generator.device).to(x.device)


def _stamps(schedule: Schedule, t: int, x: Tensor) -> Tensor:
    return schedule.stamps[t].to(x.device).expand(len(x))


@torch.no_grad()
def ddpm(
    denoise: Denoiser,
    schedule: Schedule,
    x: Tensor,
    generator: torch.Generator,
    *,
    after: After | None = None,
    start: int | None = None,
    rest: int = 0,
    progress: bool = False,
) -> Tensor:
    """Samples (B, ...) of p(x_0) by x_{t-1} ~ q(x_{t-1} | x_t, x_0 estimate), Eq. 4.6; no noise in the last step.

    Args:
        x: x_T (B, ...), or x_start where the signal is already partly there. start: its step; default the last.
        rest: of the last steps so many are not walked: the estimate of x_0 before them is the result; with an exact
            denoiser the mean of all that those steps might still make of it.

    Raises:
        ValueError: rest is no step before the first one.
    """
    first = len(schedule) - 1 if start is None else start
    if not 0 <= rest <= max(first, 0):
        raise ValueError(f"rest: expected 0 to {first}, got {rest}")
    for t in tqdm(range(first, -1, -1), disable=not progress, leave=False, unit="step"):
        x0 = denoise(x, _stamps(schedule, t, x))
        if t and t == rest:
            return after(x0, x0, 0) if after else x0
        mean, variance = schedule.posterior(x0, x, t)
        x = mean + variance.sqrt() * noise_like(x, generator) if t else mean
        x = after(x, x0, t) if after else x
    return x


@torch.no_grad()
def ddim(
    denoise: Denoiser,
    schedule: Schedule,
    x: Tensor,
    generator: torch.Generator | None = None,
    *,
    eta: float = 0.0,
    after: After | None = None,
    progress: bool = False,
) -> Tensor:
    """Samples (B, ...) by steps that keep the estimated noise: eta = 0 draws nothing, eta = 1 is DDPM's variance."""
    for t in tqdm(range(len(schedule) - 1, -1, -1), disable=not progress, leave=False, unit="step"):
        x0 = denoise(x, _stamps(schedule, t, x))
        left, before = schedule.alpha_bar[t], schedule.before[t]
        sigma = eta * ((1 - before) / (1 - left) * (1 - left / before)).sqrt()
        x = before.sqrt().to(x) * x0 + (1 - before - sigma**2).clamp(min=0).sqrt().to(x) * schedule.noise_of(x0, x, t)
        if eta and t:
            x = x + sigma.to(x) * noise_like(x, generator)
        x = after(x, x0, t) if after else x
    return x


@torch.no_grad()
def through(
    scheduler, denoise: Denoiser, x: Tensor, count: int | list[int], generator: torch.Generator | None = None
) -> Tensor:
    """Samples (B, ...) by ``count`` steps of any scheduler of diffusers that takes x_0 estimates (``scheduler``).

    count: how many, or the steps themselves, falling, where the scheduler lets them be chosen.
    """
    with warnings.catch_warnings():  # numpy 2 and the way some schedulers read tensors
        warnings.simplefilter("ignore", DeprecationWarning)
        scheduler.set_timesteps(**({"num_inference_steps": count} if isinstance(count, int) else {"timesteps": count}))
    takes = {"generator": generator} if "generator" in signature(scheduler.step).parameters else {}
    for t in scheduler.timesteps:
        x0 = denoise(scheduler.scale_model_input(x, t), t.to(x.device).expand(len(x)))
        x = scheduler.step(x0, t, x, **takes).prev_sample
    return x


def scheduler(name: str, schedule: Schedule, **options):
    """A scheduler of diffusers on our betas, x_0 estimates, nothing clipped, spaced to reach the last step.

    name: of its class, as "DPMSolverMultistepScheduler".
    """
    import diffusers

    betas = schedule.beta.float().numpy()
    how = {"trained_betas": betas, "prediction_type": "sample", "timestep_spacing": "trailing"} | options
    made = getattr(diffusers, name)
    known = signature(made.__init__).parameters
    return made(**{k: v for k, v in (how | {"clip_sample": False}).items() if k in known})


@torch.no_grad()
def resampled(
    denoise: Denoiser,
    schedule: Schedule,
    x: Tensor,
    generator: torch.Generator,
    *,
    after: After,
    times: int = 10,
    jump: int = 10,
    progress: bool = False,
) -> Tensor:
    """DDPM that goes back and over again: every ``jump`` steps are walked ``times`` times, so that what is made and
    what is known come to agree.

    Source: RePaint (Lugmayr et al. 2022), algorithm 1, jump length and resampling count.
    """
    t, last, left = len(schedule) - 1, len(schedule) - 1, {}
    bar = tqdm(disable=not progress, leave=False, unit="step")
    while t >= 0:
        x0 = denoise(x, _stamps(schedule, t, x))
        mean, variance = schedule.posterior(x0, x, t)
        x = after(mean + variance.sqrt() * noise_like(x, generator) if t else mean, x0, t)
        bar.update()
        t -= 1
        if t >= 0 and (last - t) % jump == 0 and left.setdefault(t, times - 1) > 0:
            left[t] -= 1
            back = min(t + jump, last)
            keep = schedule.alpha_bar[back] / schedule.alpha_bar[t]
            x = keep.sqrt().to(x) * x + (1 - keep).sqrt().to(x) * noise_like(x, generator)
            t = back
    bar.close()
    return x
