"""Inverse kinematics: two-bone legs in closed form, and any joints to their targets by damped least squares.

Source: Wampler 1986; Nakamura and Hanafusa 1986 (damped least squares), the finish that thesis 4.2.4 leaves to others.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError
from motionlab.motion import Motion
from motionlab.skeleton import fk

_FARTHEST = 0.5  # radians that a joint turns in one step towards its target, at most
_DAMPING = 1e-4  # square metres per square radian, the least


def two_bone_ik(motion: Motion, ankles: Tensor) -> Motion:
    """Bends the legs so that the ankles are at ``ankles`` (T, 2, 3: left, right); feet keep their orientation.

    Two-bone inverse kinematics: the knee stays in its plane, a target out of reach is approached along the
    line from the hip. Thigh and shin turn by the shortest rotation.
    """
    rot = motion.rot.clone()
    positions, world = fk(motion.skeleton, motion.root, motion.rot)
    for side, goal in zip(("left", "right"), ankles.unbind(1), strict=True):
        hip, knee, ankle = motion.skeleton.indices([f"{side}_{part}" for part in ("hip", "knee", "ankle")])
        h, k, a = positions[:, hip], positions[:, knee], positions[:, ankle]
        thigh, shin = (k - h).norm(dim=-1, keepdim=True), (a - k).norm(dim=-1, keepdim=True)
        line = goal - h
        far = line.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        d = far.clamp((thigh - shin).abs().amax() + 1e-4, (thigh + shin).amin() * (1 - 1e-5))
        u = line / far
        bend = (k - h) + 0.02 * world[:, hip, :, 2]  # a straight leg bends forward
        bend = torch.nn.functional.normalize(bend - (bend * u).sum(-1, keepdim=True) * u, dim=-1)
        along = (d**2 + thigh**2 - shin**2) / (2 * d)
        new_k = h + along * u + (thigh**2 - along**2).clamp(min=0).sqrt() * bend
        turn_thigh = rotation.rotation_between(k - h, new_k - h)
        turn_shin = rotation.rotation_between(a - k, h + d * u - new_k)
        upper, lower = turn_thigh @ world[:, hip], turn_shin @ world[:, knee]
        rot[:, hip] = world[:, motion.skeleton.parents[hip]].mT @ upper
        rot[:, knee] = upper.mT @ lower
        rot[:, ankle] = lower.mT @ world[:, ankle]
    return replace(motion, rot=rot)


def reach_targets(motion: Motion, names: Sequence[str], targets: Tensor, *, steps: int = 10) -> Motion:
    """Computes the motion with its handles at their targets, every frame for itself.

    With J the change of the handles' positions by small turns of all joints about world axes (and by shifts of the
    root), each step is J^T (J J^T + damping)^-1 of what is missing: of all steps that close the gap the smallest. A
    frame that a step would make worse stays and is damped more (Levenberg-Marquardt). Out of reach, it ends near.

    Args:
        names: of K handle joints. targets: (..., T, K, 3) metres, world; NaN where a handle is free.

    Raises:
        DataError: a motion that is not finite. KeyError: no such joint. ShapeError: targets of another shape.
    """
    handles = motion.skeleton.indices(list(names))
    if targets.shape != (*motion.root.shape[:-1], len(handles), 3):
        raise ShapeError(f"targets: expected {(*motion.root.shape[:-1], len(handles), 3)}, got {tuple(targets.shape)}")
    if not (motion.root.isfinite().all() and motion.rot.isfinite().all()):
        raise DataError("numbers that are not finite", place=motion.name, remedy="leave those frames out")
    known = targets.isfinite().all(-1)
    above = motion.skeleton.ancestors()[handles].to(motion.root)
    weight = torch.full_like(motion.root[..., 0], _DAMPING)

    def missed(motion: Motion) -> Tensor:  # (..., T, K, 3): the way from every known handle to its target
        return torch.where(known[..., None], targets - motion.positions[..., handles, :], 0.0)

    missing = missed(motion)
    for _ in range(steps):
        tried = _damped_step(motion, handles, above, missing, known, weight)
        left = missed(tried)
        better = left.square().sum((-1, -2)) < missing.square().sum((-1, -2))
        weight = torch.where(better, weight / 3, weight * 10).clamp(min=_DAMPING)
        motion = replace(
            motion,
            root=torch.where(better[..., None], tried.root, motion.root),
            rot=torch.where(better[..., None, None, None], tried.rot, motion.rot),
        )
        missing = torch.where(better[..., None, None], left, missing)
    return motion


def _damped_step(motion, handles, above, missing, known, weight) -> Motion:
    positions, turns = motion.world
    # (..., K, J + 1, 3, 3): a handle's velocity by a turn of each joint above it about the world's axes; by a shift
    lever = positions[..., handles, None, :] - positions[..., None, :, :]
    shift = torch.eye(3).to(positions).expand(*known.shape, 1, 3, 3)
    jacobian = torch.cat((-rotation.skew(lever) * above[..., None, None], shift), -3) * known[..., None, None, None]
    rows = jacobian.movedim(-2, -3).flatten(-4, -3).flatten(-2)  # (..., 3 K, 3 J)
    square = rows @ rows.mT + weight[..., None, None] * torch.eye(rows.shape[-2]).to(rows)
    step = (rows.mT @ torch.linalg.solve(square, missing.flatten(-2)[..., None]))[..., 0].unflatten(-1, (-1, 3))
    turn, shift = step[..., :-1, :], step[..., -1, :]
    turn = turn * (_FARTHEST / turn.norm(dim=-1, keepdim=True).clamp(min=_FARTHEST))
    parents = torch.cat((torch.eye(3).to(turns).expand_as(turns[..., :1, :, :]), turns), -3)
    parent = parents[..., [p + 1 for p in motion.skeleton.parents], :, :]
    local = rotation.exp((parent.mT @ turn[..., None])[..., 0])
    return replace(motion, root=motion.root + shift, rot=local @ motion.rot)
