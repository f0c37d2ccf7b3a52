"""What completed poses are judged by: their handles, the joints that are none, and how much completions differ."""

from __future__ import annotations

import torch
from torch import Tensor

from motionlab.metrics.pose import masked_mean
from motionlab.motion import Motion


def missed(motion: Motion, targets: Tensor, which: Tensor) -> Tensor:
    """Distance (B, 22) in metres of every handle of poses (B, 1) from its target; NaN where no handle is."""
    return torch.where(which, (motion.positions[:, 0] - targets).norm(dim=-1), torch.nan)


def unobserved(motion: Motion, truth: Motion, which: Tensor) -> Tensor:
    """Mean error (B,) in metres of the joints of poses (B, 1) that are no handles."""
    return masked_mean((motion.positions - truth.positions)[:, 0].norm(dim=-1), ~which, 1)


def completion_spread(positions: Tensor, which: Tensor) -> Tensor:
    """How much completions differ (B,): mean distance in metres of a free joint in one of K poses (K, B, 22, 3) from
    itself in another."""
    far = (positions[:, None] - positions).norm(dim=-1)
    count = len(positions)
    return masked_mean(far.sum((0, 1)) / (count * (count - 1)), ~which, 1)
