"""The noising process and its reversal: DDPM steps, DDIM steps.

Noising steps are counted from 0: step t has been noised t + 1 times, the thesis's t + 1. All tables are float64.

A denoiser is any function (x_t (B, ...), stamps (B,)) -> x_0 estimate (B, ...). ``after`` is called as
after(x_{t-1}, x_0 estimate, t) -> x_{t-1} behind every step, which is where known parts are put back (``inpaint``).

Source: thesis Eqs. 4.1-4.7; Ho et al. 2020; Nichol and Dhariwal 2021; Song et al. 2021 (DDIM).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from motionlab.errors import ShapeError, check_shape

DenoiseFunction = Callable[[Tensor, Tensor], Tensor]
After = Callable[[Tensor, Tensor, int], Tensor]
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
    if steps < 1:
        raise ValueError(f"steps: expected 1 or more, got {steps}")
    u = torch.arange(steps + 1, dtype=torch.float64) / steps
    f = ((u + 0.008) / (1 + 0.008) * (math.pi / 2)).cos().clamp(min=0) ** power
    beta = (1 - f[1:] / f[:-1]).clamp(max=MOST)
    return NoiseSchedule((1 - beta).cumprod(0), torch.arange(steps))


def noise_like(x: Tensor, generator: torch.Generator) -> Tensor:
    """Draws standard normal numbers shaped as x, from an explicit generator."""
    return torch.randn(x.shape, generator=generator, dtype=x.dtype, device=generator.device).to(x.device)


@torch.no_grad()
def ddpm(
    denoise: DenoiseFunction, schedule: NoiseSchedule, x: Tensor, generator: torch.Generator, *,
    after: After | None = None,
) -> Tensor:  # fmt: skip
    """Draws samples (B, ...) of p(x_0) by x_{t-1} ~ q(x_{t-1} | x_t, x_0 estimate), Eq. 4.6; none in the last step."""
    for t in range(len(schedule) - 1, -1, -1):
        x0 = denoise(x, schedule.stamps[t].to(x.device).expand(len(x)))
        mean, variance = schedule.posterior(x0, x, t)
        x = mean + variance.sqrt() * noise_like(x, generator) if t else mean
        x = after(x, x0, t) if after else x
    return x


@torch.no_grad()
def ddim(denoise: DenoiseFunction, schedule: NoiseSchedule, x: Tensor) -> Tensor:
    """Draws samples (B, ...) by steps that keep the estimated noise and draw none (eta = 0)."""
    for t in range(len(schedule) - 1, -1, -1):
        x0, before = denoise(x, schedule.stamps[t].to(x.device).expand(len(x))), schedule.before[t]
        x = before.sqrt().to(x) * x0 + (1 - before).clamp(min=0).sqrt().to(x) * schedule.noise_of(x0, x, t)
    return x
