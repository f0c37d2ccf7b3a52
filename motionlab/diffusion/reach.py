"""Handles made exact: a few Gauss-Newton steps of inverse kinematics that change a pose as little as they can.

Source: damped least squares (Wampler 1986; Nakamura and Hanafusa 1986); the finish that thesis 4.2.4 leaves to others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError
from motionlab.motion import Motion

FARTHEST = 0.5  # radians that a joint turns in one step, at most


def reach(
    motion: Motion,
    names: Sequence[str],
    targets: Tensor,
    *,
    steps: int = 10,
    damping: float = 1e-4,
    moves_root: bool = True,
) -> Motion:
    """The motion with its handles at their targets, every frame for itself.

    With J the change of the handles' positions by small turns of all joints about world axes (and by shifts of the
    root), each step is J^T (J J^T + damping)^-1 of what is missing: of all steps that close the gap the smallest. A
    frame that a step would make worse stays and is damped more (Levenberg-Marquardt).

    Args:
        names: of K handle joints. targets: (..., T, K, 3) metres, world; NaN where a handle is free.
        damping: square metres per square radian, the least. Out of reach, the arm ends as near as it can.
        moves_root: whether the pelvis may be shifted too.

    Raises:
        DataError: a motion that is not finite. KeyError: no such joint. ShapeError: targets of another shape.
    """
    handles = motion.skeleton.indices(list(names))
    if targets.shape != (*motion.root.shape[:-1], len(handles), 3):
        raise ShapeError(f"targets: expected {(*motion.root.shape[:-1], len(handles), 3)}, got {tuple(targets.shape)}")
    if not (motion.root.isfinite().all() and motion.rot.isfinite().all()):
        raise DataError("numbers that are not finite", place=motion.name, remedy="leave those frames out")
    known = targets.isfinite().all(-1)
    above = _above(motion.skeleton, handles).to(motion.root)
    weight = torch.full_like(motion.root[..., 0], damping)
    missing = _missing(motion, handles, targets, known)
    for _ in range(steps):
        tried = _stepped(motion, handles, above, missing, known, weight, moves_root)
        left = _missing(tried, handles, targets, known)
        better = left.square().sum((-1, -2)) < missing.square().sum((-1, -2))
        weight = torch.where(better, weight / 3, weight * 10).clamp(min=damping)
        motion = replace(
            motion,
            root=torch.where(better[..., None], tried.root, motion.root),
            rot=torch.where(better[..., None, None, None], tried.rot, motion.rot),
        )
        missing = torch.where(better[..., None, None], left, missing)
    return motion


def _missing(motion: Motion, handles: Sequence[int], targets: Tensor, known: Tensor) -> Tensor:
    """(..., T, K, 3): the way from every known handle to its target."""
    return torch.where(known[..., None], targets - motion.positions[..., handles, :], 0.0)


def _stepped(motion, handles, above, missing, known, weight, moves_root) -> Motion:
    positions, turns = motion.world
    jacobian = _jacobian(positions, handles, above) * known[..., None, None, None]
    if moves_root:
        shift = torch.eye(3).to(positions).expand(*known.shape, 1, 3, 3) * known[..., None, None, None]
        jacobian = torch.cat((jacobian, shift), -3)
    rows = jacobian.movedim(-2, -3).flatten(-4, -3).flatten(-2)  # (..., 3 K, 3 J)
    square = rows @ rows.mT + weight[..., None, None] * torch.eye(rows.shape[-2]).to(rows)
    step = (rows.mT @ torch.linalg.solve(square, missing.flatten(-2)[..., None]))[..., 0].unflatten(-1, (-1, 3))
    turn, shift = (step[..., :-1, :], step[..., -1, :]) if moves_root else (step, 0.0)
    turn = turn * (FARTHEST / turn.norm(dim=-1, keepdim=True).clamp(min=FARTHEST))
    parents = torch.cat((torch.eye(3).to(turns).expand_as(turns[..., :1, :, :]), turns), -3)
    parent = parents[..., [p + 1 for p in motion.skeleton.parents], :, :]
    local = rotation.exp((parent.mT @ turn[..., None])[..., 0])
    return replace(motion, root=motion.root + shift, rot=local @ motion.rot)


def _above(skeleton, handles: Sequence[int]) -> Tensor:
    """(K, J): 1 where a joint's turn moves a handle: the joints above it."""
    found = torch.zeros(len(handles), len(skeleton))
    for row, joint in enumerate(handles):
        while (joint := skeleton.parents[joint]) >= 0:
            found[row, joint] = 1
    return found


def _jacobian(positions: Tensor, handles: Sequence[int], above: Tensor) -> Tensor:
    """(..., K, J, 3, 3): handle's velocity by a turn of joint j about the world's axes, -skew(p_handle - p_j)."""
    lever = positions[..., handles, None, :] - positions[..., None, :, :]
    return -rotation.skew(lever) * above[..., None, None]
