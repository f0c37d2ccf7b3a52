"""Smooth curves through what is known of a motion.

The conditional mean of a Gaussian process in time, of Matern covariance 3/2, for every number by itself: curves that go
through what is known with a velocity that does not jump, like cubic splines, but come back to zero far from it. Used of
what is left of a motion once a guess is taken off.
Source: Rasmussen and Williams 2006, Eqs. 2.25 and 4.17.
"""

from __future__ import annotations

import torch
from torch import Tensor

FRAMES = 30.0  # the process's length: its covariance falls to a half in so many frames
NOISE = 1e-5  # of its variance: of what is known, so that every pattern can be solved for


def matern(frames: int) -> Tensor:
    """Covariance (T, T) of the process, float64, variance 1."""
    time = torch.arange(frames, dtype=torch.float64)
    far = 3**0.5 * (time[:, None] - time).abs() / FRAMES
    return (1 + far) * torch.exp(-far)


def curves(x: Tensor, known: Tensor) -> Tensor:
    """x (B, T, D) where known (bool, B T D), smooth curves elsewhere, 0 where a column knows nothing. What x holds
    elsewhere is never read."""
    frames = x.shape[-2]
    patterns, which = torch.unique(known.mT.reshape(-1, frames), dim=0, return_inverse=True)
    seen, cov = patterns.double(), matern(frames).to(x.device)
    square = seen[:, :, None] * cov * seen[:, None] + torch.diag_embed(1 - seen + NOISE)
    weights = (cov @ (seen[:, :, None] * torch.linalg.inv(square) * seen[:, None])).to(x)
    told = torch.where(known, x, 0.0)
    drawn = torch.einsum("cij,cj->ci", weights[which], told.mT.reshape(-1, frames))
    return torch.where(known, x, drawn.unflatten(0, (len(x), -1)).mT)
