"""Data whose denoiser is known exactly: a Gaussian. What samplers do to it can be said in closed form."""

from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.diffusion.sampling import NoiseSchedule


@dataclass(frozen=True, eq=False)
class GaussianData:
    """x_0 ~ N(mean (D,), covariance (D, D)), float64."""

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
