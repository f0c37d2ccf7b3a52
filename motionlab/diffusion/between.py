"""What the known part says of the rest without a network: the start of a model that is told.

Two rivals of such models at once: windows as a Gaussian of few principal parts say what goes with what (ridge
regression, one for every mask), and what they leave goes straight from one known frame to the next (``between``).
``doubt``: how far from that the truth may be.
Source: Bishop 2006, 12.2, as ``rivals``. Differs from CondMDI, where what is not known is zero, and the network has to
find out about means, correlations and straight lines by itself.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from motionlab.errors import ShapeError

PARTS, RIDGE = 64, 30.0  # principal parts; variance of a known number about them, which say much alike
SURE = 10.0  # frames: at that distance from what is known, half of what could be known without it is open


def between(x: Tensor, known: Tensor) -> Tensor:
    """x (B, T, D) where known (bool, B T D), straight lines between, held before the first and after the last known
    frame, 0 where a column knows nothing. What x holds elsewhere is never read."""
    before, after, any_known = _around(known)
    time = torch.arange(x.shape[-2], device=x.device)[:, None]
    share = (time - before) / (after - before).clamp(min=1)
    left, right = (torch.where(known, x, 0.0).gather(-2, at) for at in (before, after))
    return torch.where(any_known, left + share.to(x) * (right - left), 0.0)


def doubt(known: Tensor) -> Tensor:
    """(B, T, D), 0 where known, 1 in a column that knows nothing, else h / (h + ``SURE``): h, frames, half the harmonic
    mean of the distances to what is known on both sides, as of a Brownian bridge; on one side only, that distance."""
    before, after, any_known = _around(known)
    time = torch.arange(known.shape[-2], device=known.device)[:, None]
    left, right = (time - before).abs().float(), (after - time).abs().float()
    inside = (before <= time) & (time <= after)
    h = torch.where(inside, left * right / (left + right).clamp(min=1.0), torch.minimum(left, right))
    return torch.where(any_known, h / (h + SURE), 1.0)


def _around(known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The known frames next before and after (B, T, D), both the nearest one at the ends; which columns know any."""
    frames = known.shape[-2]
    time = torch.arange(frames, device=known.device)[:, None].expand_as(known)
    before = torch.where(known, time, -1).cummax(-2).values
    after = torch.where(known, time, frames).flip(-2).cummin(-2).values.flip(-2)
    first, last = after[..., :1, :].clamp(max=frames - 1), before[..., -1:, :].clamp(min=0)
    before = torch.where(before < 0, first, before)
    after = torch.where(after == frames, last, after)
    return before, after, known.any(-2, keepdim=True)


def principal(rows: Tensor, parts: int, generator: torch.Generator) -> Tensor:
    """F (D, K) with F F^T about the covariance of centred rows (N, D): its largest K axes, times their deviation.

    Source: Halko et al. 2011, randomised range finder with two power iterations.
    """
    parts = min(parts, len(rows) - 1, rows.shape[1])
    basis = rows.mT @ torch.randn(len(rows), min(parts + 16, *rows.shape), generator=generator)
    for _ in range(2):
        basis = rows.mT @ (rows @ torch.linalg.qr(basis).Q)
    basis = torch.linalg.qr(basis).Q
    values, axes = torch.linalg.eigh((rows @ basis).mT.cov(correction=0))
    return basis @ axes[:, -parts:] * values[-parts:].clamp(min=0).sqrt()


class Start(nn.Module):
    """What is known (B, T, D) -> a guess of all of x_0, exact where it is known. frames, features: T and D.

    ``mean`` (T D,) and ``factor`` F (T D, ``PARTS``) are data, measured by ``measure`` and stored with the weights.
    """

    def __init__(self, frames: int, features: int) -> None:
        super().__init__()
        self.shape = frames, features
        self.register_buffer("mean", torch.zeros(frames * features))
        self.register_buffer("factor", torch.zeros(frames * features, PARTS))

    @torch.no_grad()
    def measure(self, x: Tensor, generator: torch.Generator) -> None:
        """From normalised windows (N, T, D), more than ``PARTS``."""
        rows = x.flatten(1)
        if len(rows) <= PARTS:
            raise ShapeError(f"x: expected more than {PARTS} windows, got {len(rows)}")
        self.mean.copy_(rows.mean(0))
        self.factor.copy_(principal(rows - self.mean, PARTS, generator))

    @torch.no_grad()
    def forward(self, known: Tensor, mask: Tensor) -> Tensor:
        """known, mask (bool): (B, T, D). What ``known`` holds elsewhere is never read."""
        if known.shape[1:] != self.shape:
            raise ShapeError(f"known: expected {self.shape[0]} frames of {self.shape[1]} numbers, got {known.shape}")
        seen = mask.flatten(1).to(known) / RIDGE
        off = torch.where(mask.flatten(1), known.flatten(1) - self.mean, 0.0)
        square = (self.factor.mT * seen[:, None]) @ self.factor + torch.eye(PARTS).to(known)
        z = torch.linalg.solve(square, (seen * off) @ self.factor)
        guess = (self.mean + z @ self.factor.mT).unflatten(1, self.shape)
        return guess + between(known - guess, mask)
