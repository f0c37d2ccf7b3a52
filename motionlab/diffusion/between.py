"""What the known part alone says of the rest: each number straight from one frame where it is known to the next.

``between`` is what a model that is told starts from, ``doubt`` how far from it the truth may be.
Differs from CondMDI, where what is not known is zero, and the network has to find out about straight lines by itself.
"""

from __future__ import annotations

import torch
from torch import Tensor

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
