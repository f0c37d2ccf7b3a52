"""Computes how people go on without a model: the pose held, or every joint at constant velocity."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.motion import Motion
from motionlab.skeleton import Skeleton


class Points(NamedTuple):
    """As much of a motion (B, T) as the measures of ``metrics.gait`` read: of a model of points there is no more."""

    positions: Tensor
    rot: Tensor
    skeleton: Skeleton
    fps: float


def going_on(motion: Motion, at: int, steps: int) -> dict[str, Points]:
    """What knows nothing makes of frame ``at`` of motions (B, T), as (B, steps + 1): "hold", the pose stays; "constant
    velocity", every joint goes on along a line with its velocity, the central difference that a state contains."""
    joints, time = motion.positions, torch.arange(float(steps + 1))[:, None, None]
    velocity = (joints[:, at + 1] - joints[:, at - 1])[:, None] / 2
    held = joints[:, at, None].expand(-1, steps + 1, -1, -1)
    rot = motion.rot[:, at, None].expand(-1, steps + 1, -1, -1, -1)
    paths = {"hold": held, "constant velocity": held + time * velocity}
    return {name: Points(path, rot, motion.skeleton, motion.fps) for name, path in paths.items()}


def walks_on(found: Motion | Points, person: Motion, frames: int = 15) -> Tensor:
    """1 where the pelvis's mean speed over the floor in the last ``frames`` steps is above half of the person's mean
    speed over the whole of the clip, else 0: (B,)."""
    ours, own = (m.positions[..., 0, :2].diff(dim=1).norm(dim=-1) * m.fps for m in (found, person))
    return (ours[:, -frames:].mean(1) > 0.5 * own.mean(1)).to(ours)
