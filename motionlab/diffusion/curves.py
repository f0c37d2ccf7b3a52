"""Draws curves through known numbers of a window: straight lines, and smooth ones.

The smooth ones are, number by number, the conditional mean of a Gaussian process in time of Matern covariance 3/2. Like
cubic splines these have a velocity that does not jump, but far from known entries they come back to zero.

Source: Rasmussen and Williams 2006, Eqs. 2.25 and 4.17.
"""

import torch
from torch import Tensor

from motionlab.baselines import between_known

_FRAMES = 30.0  # length of the curves' Gaussian process: its covariance falls to a half in so many frames
_NOISE = 1e-5  # of its variance: of what is known, so that every pattern can be solved for


def lines_between(x: Tensor, known: Tensor) -> Tensor:
    """Computes x (B, T, D) with unknown entries (not ``known``, bool B T D) interpolated linearly in time, held at the
    ends; 0 in a column without known ones. What x holds at unknown entries is never read."""
    before, after, share = between_known(known)  # both the nearest one at the ends
    left, right = (torch.where(known, x, 0.0).gather(-2, at) for at in (before, after))
    return torch.where(known.any(-2, keepdim=True), left + share.to(x) * (right - left), 0.0)


def _matern(frames: int) -> Tensor:
    """Covariance (T, T) of the curves' process, float64, variance 1."""
    time = torch.arange(frames, dtype=torch.float64)
    far = 3**0.5 * (time[:, None] - time).abs() / _FRAMES
    return (1 + far) * torch.exp(-far)


def smooth_curves(x: Tensor, known: Tensor, owners: Tensor) -> Tensor:
    """Computes x (B, T, D) with smooth curves through what is known, 0 in a column that knows nothing. What x holds
    elsewhere is never read.

    known (B, T, U), bool: units; owners (D,): the unit that each number belongs to.
    """
    patterns, which = torch.unique(known.mT.flatten(0, 1), dim=0, return_inverse=True)
    which = which.unflatten(0, (len(known), -1))[:, owners].flatten()
    told = torch.where(known[..., owners], x, 0.0).mT.flatten(0, 1)
    drawn = torch.zeros_like(told)
    for k, weights in enumerate(curve_weights(patterns).to(told)):
        mine = (which == k).nonzero()[:, 0]
        drawn[mine] = told[mine] @ weights.mT
    return torch.where(known[..., owners], x, drawn.unflatten(0, (len(known), -1)).mT)


def curve_weights(patterns: Tensor) -> Tensor:
    """Computes what a smooth curve is of what it knows: (P, T, T), float64, for patterns of known frames (P, T)."""
    seen, cov = patterns.double(), _matern(patterns.shape[-1]).to(patterns.device)
    square = seen[:, :, None] * cov * seen[:, None] + torch.diag_embed(1 - seen + _NOISE)
    return cov @ (seen[:, :, None] * torch.linalg.inv(square) * seen[:, None])
