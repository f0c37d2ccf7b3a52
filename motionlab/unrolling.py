"""Rotations along a time axis without jumps: of the many numbers that stand for each, the nearest to the last."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from motionlab.errors import check_shape


def unroll_quaternion(quaternion: Tensor, dim: int = -2) -> Tensor:
    """Signs chosen along the time axis ``dim`` so that each quaternion (..., T, 4) is the nearer one to the last."""
    check_shape(quaternion, "... 4", "quaternion")
    q = quaternion.movedim(dim, 0)
    turn = torch.where((q[1:] * q[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(q)
    return torch.cat((q[:1], q[1:] * turn.cumprod(0))).movedim(0, dim).contiguous()


def unroll_axis_angle(aa: Tensor, dim: int = -2) -> Tensor:
    """Of all vectors of each rotation, (|a| + 2 pi k) a/|a|, the one nearest to the frame before, (..., T, 3).

    The first frame stays; a body that spins on leaves the ball of radius pi. No choice is continuous everywhere:
    when a path that has left that ball passes near the zero rotation (|a| near 2 pi k, k > 0), its axis may
    swing round in one frame and the vector jump with it. A zero rotation (to rounding) takes the axis of the
    frame before. Sweeps over all frames at once: a cumulative sum unwraps the angles along a sign-continuous axis,
    then k is corrected until no frame has a nearer choice.
    """
    check_shape(aa, "... 3", "axis_angle")
    x = aa.movedim(dim, 0)
    angle = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    known = angle > 8 * torch.finfo(x.dtype).eps
    unit = torch.where(known, x / torch.where(known, angle, 1.0), 0.0)
    sign = torch.where((unit[1:] * unit[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(x).cumprod(0)
    jump = torch.diff(sign * angle[1:], dim=0, prepend=angle[:1]) / math.tau
    signed = angle[1:] - sign * math.tau * jump.round().cumsum(0)
    unrolled = torch.cat((x[:1], unit[1:] * signed))
    for _ in range(len(x)):
        before = unrolled[:-1]
        axis = torch.where(known[1:], unit[1:], torch.nn.functional.normalize(before, dim=-1))
        turns = (((axis * before).sum(-1, keepdim=True) - angle[1:]) / math.tau).round()
        update = torch.cat((x[:1], axis * (angle[1:] + math.tau * turns)))
        if torch.equal(update, unrolled):
            break
        unrolled = update
    return unrolled.movedim(0, dim).contiguous()
