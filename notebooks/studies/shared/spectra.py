"""How quick motion is: its power by frequency."""

import torch
from torch import Tensor


def power_spectrum(velocities: Tensor) -> Tensor:
    """Computes the power (..., F) of velocities (..., T, J, 3) by frequency under a Hann window, summed over joints."""
    window = torch.hann_window(velocities.shape[-3], False, dtype=velocities.dtype, device=velocities.device)
    return torch.fft.rfft(velocities * window[:, None, None], dim=-3).abs().square().sum((-1, -2))
