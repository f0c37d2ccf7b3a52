"""Recordings longer than the roll-out can carry: cut into overlapping windows of one length, and put together again.

In stage 3 neighbours are asked to agree over the frames they share (``stages.OVERLAP``); what is left of the gap
between them is blended here.

Source: the official code's ``use_split`` (windows of 60 frames, at least 10 shared, the remainder spread).
Differs: neighbours are blended over the frames they share, where the official code keeps the earlier one's.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import ShapeError


def plan(frames: int, length: int, overlap: int) -> tuple[int, ...]:
    """First frames of the fewest windows of ``length`` that cover ``frames`` and share at least ``overlap`` each.

    Raises:
        ShapeError: windows that could not move on.
    """
    if not 0 < overlap < length:
        raise ShapeError(f"overlap: expected 1 to {length - 1} of {length} frames, got {overlap}")
    if frames <= length:
        return (0,)
    count = -(-(frames - overlap) // (length - overlap))
    return tuple(round(k * (frames - length) / (count - 1)) for k in range(count))


def cut(x: Tensor, starts: Sequence[int], length: int) -> Tensor:
    """Windows (G, W, L, ...) of (G, T, ...)."""
    return x[:, torch.tensor(starts)[:, None] + torch.arange(min(length, x.shape[1]))]


def stitch(x: Tensor, starts: Sequence[int], *, turns: bool = False) -> Tensor:
    """One (G, T, ...) from windows (G, W, L, ...); over shared frames the weight moves evenly to the later one.

    turns: x are rotations (..., 3, 3), blended along the shortest way.
    """
    out = x[:, 0]
    for w, start in enumerate(starts[1:], start=1):
        shared = out.shape[1] - start
        ramp = (torch.arange(1, shared + 1) / (shared + 1)).to(x)
        before, after = out[:, start:], x[:, w, :shared]
        if turns:
            ramp = ramp.reshape(-1, *(1,) * (x.ndim - 5))  # (shared, 1 per joint)
            mixed = rotation.slerp(before, after, ramp.expand(before.shape[1:-2]))
        else:
            mixed = torch.lerp(before, after, ramp.reshape(-1, *(1,) * (x.ndim - 3)))
        out = torch.cat((out[:, :start], mixed, x[:, w, shared:]), 1)
    return out
