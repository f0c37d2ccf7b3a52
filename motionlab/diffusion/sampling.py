"""The noising process and its reversal, DDPM steps and DDIM steps; and inpainting, where unknown parts are sampled and
:class:`Inpainting` says how the known enter.

Noising steps are counted from 0: step t has been noised t + 1 times, the thesis's t + 1. All tables are float64.

A denoiser is any function (x_t (B, ...), stamps (B,)) -> x_0 estimate (B, ...). To inpaint, x is (B, T, D); a mask m
is 1 where known (the thesis's 1 - m).

Source: thesis Eqs. 4.1-4.7; Ho et al. 2020; Nichol and Dhariwal 2021; Song et al. 2021 (DDIM). Inpainting: thesis
4.1.2, Eq. 4.10 (RePaint, EDGE: the known part noised to x_{t-1}), 4.2, 4.4.1; MDM (x_0 imputed); Ho et al. 2022,
reconstruction guidance, with CondMDI's weight.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from motionlab.baselines import nearest_known
from motionlab.errors import ShapeError, check_shape

DenoiseFunction = Callable[[Tensor, Tensor], Tensor]
MOST = 0.999  # of the variance that one step may replace


@dataclass(frozen=True, eq=False)
class NoiseSchedule:
    """alpha_bar (T,): share of the signal's variance left at each step, falling. stamps (T,): the step numbers that a
    denoiser is told, those of the schedule it was trained on.

    Raises:
        ShapeError: the tables differ in length, or alpha_bar does not fall from below 1 to above 0.
    """

    alpha_bar: Tensor
    stamps: Tensor

    def __post_init__(self) -> None:
        check_shape(self.alpha_bar, "T", "alpha_bar")
        check_shape(self.stamps, f"{len(self.alpha_bar)}", "stamps")
        if not ((self.alpha_bar > 0) & (self.alpha_bar < 1)).all() or (self.alpha_bar.diff() >= 0).any():
            raise ShapeError("alpha_bar: expected numbers that fall from below 1 to above 0")

    def __len__(self) -> int:
        return len(self.alpha_bar)

    @cached_property
    def before(self) -> Tensor:
        """alpha_bar (T,) one step earlier; 1 before the first."""
        return torch.cat((self.alpha_bar.new_ones(1), self.alpha_bar[:-1]))

    @cached_property
    def alpha(self) -> Tensor:
        """(T,): share of the variance that a step leaves."""
        return self.alpha_bar / self.before

    @cached_property
    def beta(self) -> Tensor:
        """(T,): variance that a step adds, Eq. 4.1."""
        return 1 - self.alpha

    def respaced(self, count: int) -> Self:
        """Returns the same process in fewer steps: evenly spaced from the first to the last, each with its old stamp.

        Source: Nichol and Dhariwal 2021, ``space_timesteps``.
        """
        if not 1 <= count <= len(self):
            raise ValueError(f"count: expected 1 to {len(self)} steps, got {count}")
        last = len(self) - 1
        keep = torch.tensor([round(i * last / (count - 1)) for i in range(count)] if count > 1 else [last])
        return NoiseSchedule(self.alpha_bar[keep], self.stamps[keep])

    def noised(self, x0: Tensor, t: Tensor | int, noise: Tensor) -> Tensor:
        """Computes x_t = sqrt(alpha_bar_t) x_0 + sqrt(1 - alpha_bar_t) noise, Eq. 4.3.

        Args:
            x0, noise: (B, ...) of any unit. t: (B,) or one step for all; -1 is the clean signal.
        """
        a = self._at(torch.cat((self.alpha_bar, self.alpha_bar.new_ones(1))), t, x0)
        return a.sqrt() * x0 + (1 - a).sqrt() * noise

    def posterior(self, x0: Tensor, xt: Tensor, t: Tensor | int) -> tuple[Tensor, Tensor]:
        """Computes mean (B, ...) and variance (broadcasting) of q(x_{t-1} | x_t, x_0), Eqs. 4.6 and 4.7."""
        scale = 1 / (1 - self.alpha_bar)
        towards = self._at(self.before.sqrt() * self.beta * scale, t, xt)
        stay = self._at(self.alpha.sqrt() * (1 - self.before) * scale, t, xt)
        return towards * x0 + stay * xt, self._at((1 - self.before) * self.beta * scale, t, xt)

    def step_back(self, x0: Tensor, xt: Tensor, t: int, generator: torch.Generator) -> Tensor:
        """Draws x_{t-1} (B, ...) of q(x_{t-1} | x_t, x_0), Eq. 4.6; in the last step it is the mean."""
        mean, variance = self.posterior(x0, xt, t)
        return mean + variance.sqrt() * noise_like(xt, generator) if t else mean

    def noise_of(self, x0: Tensor, xt: Tensor, t: Tensor | int) -> Tensor:
        """Computes the noise (B, ...) that turned x_0 into x_t."""
        a = self._at(self.alpha_bar, t, xt)
        return (xt - a.sqrt() * x0) / (1 - a).sqrt()

    def _at(self, table: Tensor, t: Tensor | int, like: Tensor) -> Tensor:
        """Entries t of a table, as numbers that multiply (B, ...)."""
        values = table[torch.as_tensor(t)].to(like)
        return values.reshape(values.shape + (1,) * (like.ndim - values.ndim)) if values.ndim else values


def cosine(steps: int = 1000, *, power: float = 2.0) -> NoiseSchedule:
    """Computes alpha_bar(u) = (f(u) / f(0)), f(u) = cos^power((u + s) / (1 + s) pi / 2), u = (t + 1) / T, Eq. 4.4.

    s = 0.008. Each step replaces at most ``MOST`` of the variance.

    Source: Nichol and Dhariwal 2021, Eq. 17. Differs from the thesis, which prints the cosine without its square
    (``power=1``): then half of the signal's amplitude is left where it should be a quarter, and noise never wins.
    """
    u = torch.arange(steps + 1, dtype=torch.float64) / steps
    f = ((u + 0.008) / (1 + 0.008) * (math.pi / 2)).cos().clamp(min=0) ** power
    beta = (1 - f[1:] / f[:-1]).clamp(max=MOST)
    return NoiseSchedule((1 - beta).cumprod(0), torch.arange(steps))


def noise_like(x: Tensor, generator: torch.Generator) -> Tensor:
    """Draws standard normal numbers shaped as x, from an explicit generator."""
    return torch.randn(x.shape, generator=generator, dtype=x.dtype, device=generator.device).to(x.device)


@torch.no_grad()
def ddpm(denoise: DenoiseFunction, schedule: NoiseSchedule, x: Tensor, generator: torch.Generator) -> Tensor:
    """Draws samples (B, ...) of p(x_0) by x_{t-1} ~ q(x_{t-1} | x_t, x_0 estimate), Eq. 4.6."""
    for t in range(len(schedule) - 1, -1, -1):
        x0 = denoise(x, schedule.stamps[t].to(x.device).expand(len(x)))
        x = schedule.step_back(x0, x, t, generator)
    return x


@torch.no_grad()
def ddim(denoise: DenoiseFunction, schedule: NoiseSchedule, x: Tensor) -> Tensor:
    """Draws samples (B, ...) by steps that keep the estimated noise and draw none (eta = 0)."""
    for t in range(len(schedule) - 1, -1, -1):
        x0, before = denoise(x, schedule.stamps[t].to(x.device).expand(len(x))), schedule.before[t]
        x = before.sqrt().to(x) * x0 + (1 - before).clamp(min=0).sqrt().to(x) * schedule.noise_of(x0, x, t)
    return x


@dataclass(frozen=True)
class Inpainting:
    """How the known part enters the sampling.

    steps: of the respaced process. guidance_weight: of reconstruction guidance, which imputes the known part, as MDM
    does; 0: it is replaced (Eq. 4.10). replace_last: also in the last step, as the thesis does. mask_ramp: frames over
    which the mask's edges rise. blend_frames: over which ``offset_decay`` fades; 0: known parts stay as they are.
    """

    steps: int = 50
    replace_last: bool = True
    guidance_weight: float = 0.0
    mask_ramp: int = 0
    blend_frames: int = 0


@torch.no_grad()
def inpaint(
    denoise: DenoiseFunction, schedule: NoiseSchedule, x0: Tensor, known: Tensor, generator: torch.Generator,
    how: Inpainting,
) -> Tensor:  # fmt: skip
    """Draws samples (B, T, D) that keep x0 (B, T, D) where ``known``, bool (B, T, D) or (T, D), holds.

    How exactly x0 is kept is up to ``how``; elsewhere it is never read. Behind every step the known part is replaced by
    itself, noised to that step; behind the last one it is exact, which is the cause of the seam. By guidance it is
    imputed in the x_0 estimate, whose rest is less weight sqrt(alpha_bar) / 2 times the gradient in x_t of |m (x_0
    estimate - known)|^2, so that it moves to where the network's own estimate agrees with what is known.
    """
    if known.shape[-2:] != x0.shape[-2:] or known.ndim > x0.ndim:
        raise ShapeError(f"known: expected {tuple(x0.shape[-2:])} or {tuple(x0.shape)}, got {tuple(known.shape)}")
    seen, m, schedule = torch.where(known, x0, 0.0), known.to(x0), schedule.respaced(min(how.steps, len(schedule)))
    if how.mask_ramp:
        seen, m = _softened(seen, known, how.mask_ramp)
    x = noise_like(x0, generator)
    for t in range(len(schedule) - 1, -1, -1):
        stamps = schedule.stamps[t].to(x.device).expand(len(x))
        free = t == 0 and not how.replace_last  # the network may have the last word (CondMDI)
        with torch.set_grad_enabled(guided := how.guidance_weight > 0 and not free):
            at = x.detach().requires_grad_(guided)
            estimate = denoise(at, stamps)
            if guided:
                (slope,) = torch.autograd.grad((m * (estimate - seen)).square().sum(), at)
        if guided:
            weight = how.guidance_weight * schedule.alpha_bar[t].to(x).sqrt() / 2
            estimate = (1 - m) * (estimate.detach() - weight * slope) + m * seen
        x = schedule.step_back(estimate, x, t, generator)
        if not free and not guided:
            x = (1 - m) * x + m * schedule.noised(seen, t - 1, noise_like(seen, generator))
    return offset_decay(x, seen, known, how.blend_frames) if how.blend_frames else x


def offset_decay(x: Tensor, known: Tensor, m: Tensor, frames: int) -> Tensor:
    """Computes x (B, T, D) with its known numbers exact; the correction fades out over ``frames`` frames, smooth in
    value and velocity at either end.

    With e and v the offset of the nearest known frame and its change per frame, u the share of the fade that has passed
    and n its frames (no more than a gap has): x + e (2u^3 - 3u^2 + 1) + v n (u^3 - 2u^2 + u), from both sides of a gap.

    Source: inertialisation (Bollo 2018). Differs: a cubic, with no acceleration to match.
    """
    sure = (m >= 1).expand_as(x)
    offset = torch.where(sure, known - x, 0.0)
    left = _fade_from_before(offset, sure, frames)
    right = _fade_from_before(offset.flip(-2), sure.flip(-2), frames).flip(-2)
    return torch.where(sure, known, x + left + right)


def _fade_from_before(offset: Tensor, sure: Tensor, frames: int) -> Tensor:
    """What the known frame before each number adds to it (B, T, D); nothing where none is before."""
    count = offset.shape[-2]
    time = torch.arange(count, device=offset.device)[:, None].expand(offset.shape[-2:])
    before, after = (at.mT for at in nearest_known(sure.mT))
    any_before = (before <= time) & sure.any(-2, keepdim=True)
    earlier = (before - 1).clamp(min=0)
    e = offset.gather(-2, before)
    v = torch.where(sure.gather(-2, earlier) & (before > 0), e - offset.gather(-2, earlier), 0.0)
    n = torch.where(after >= time, (after - before).clamp(max=frames), frames).to(offset)
    u = ((time - before) / n).clamp(0, 1)
    faded = e * (2 * u**3 - 3 * u**2 + 1) + v * n * (u**3 - 2 * u**2 + u)
    return torch.where(any_before & ~sure, faded, 0.0)


def _softened(x: Tensor, known: Tensor, frames: int) -> tuple[Tensor, Tensor]:
    """x (B, T, D) with the known value nearest in time at unknown numbers; and a mask whose edges in time fall outside
    what is known: 1, ..., 1/(n+1), 0 over n frames. A column that knows nothing is 0."""
    known = known.expand_as(x)
    time, some = torch.arange(x.shape[-2])[:, None].expand_as(x), known.any(-2, keepdim=True)
    before, after = (at.mT for at in nearest_known(known.mT))
    nearest = torch.where(time - before <= after - time, before, after)
    share = (1 - (time - nearest).abs().double() / (frames + 1)).clamp(min=0).to(x)
    return torch.where(some, x.gather(-2, nearest), 0.0), torch.where(some, share, 0.0)
