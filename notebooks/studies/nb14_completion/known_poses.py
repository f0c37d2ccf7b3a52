"""Completion of poses without a network: what a model of handles must beat.

All poses (N, 1) are on one body, in their own stuck frames. Source: nearest neighbour and ridge regression, the
baselines of notebook 11; regression on whatever subset is seen is the mean of a Gaussian given it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import ShapeError
from motionlab.heading import stuck_root
from motionlab.metrics.generation import nearest_rows
from motionlab.motion import Motion, mirror

RIDGE = 1e-4  # square metres: what is added to the variance of a seen coordinate


@dataclass(frozen=True, eq=False)
class Poses:
    """poses (N, 1): what is known, stuck, on one body, mirror images among them (``known``)."""

    poses: Motion

    @cached_property
    def joints(self) -> Tensor:
        """Positions (N, 22, 3)."""
        return self.poses.positions[:, 0].contiguous()

    @cached_property
    def _numbers(self) -> tuple[Tensor, Tensor]:
        """Float64, centred: what is seen (N, 66) and what a pose is made of (N, 3 + 132), with their means."""
        made = torch.cat((self.poses.root[:, 0], rotation.matrix_to_sixd(self.poses.rot[:, 0]).flatten(1)), -1)
        both = torch.cat((self.joints.flatten(1), made), -1).double()
        return both - both.mean(0), both.mean(0)

    @cached_property
    def _covariance(self) -> Tensor:
        centred, _ = self._numbers
        return centred.mT @ centred / len(centred)

    def nearest(self, targets: Tensor, which: Tensor) -> Motion:
        """For handles ``which`` (B, 22) at targets (B, 22, 3) the known poses (B, 1) whose joints lie nearest there."""
        weight = which.to(targets).repeat_interleave(3, -1)
        goal = torch.where(which[..., None], targets, 0.0).flatten(1)
        library = self.joints.flatten(1)
        squares = weight @ library.square().mT - 2 * goal @ library.mT  # less what does not depend on the pose
        best = squares.argmin(1)
        return self.poses.clip(best)

    def regressed(self, targets: Tensor, which: Tensor, ridge: float = RIDGE) -> Motion:
        """Ridge regression of root and 6-D rotations on the handles' coordinates, for every subset its own; without
        handles the mean pose."""
        _, mean = self._numbers
        size = self.joints.shape[1] * 3
        seen = which.double().repeat_interleave(3, -1)
        among, across = self._covariance[:size, :size], self._covariance[size:, :size]
        eye = torch.eye(size, dtype=torch.float64)
        square = seen[:, :, None] * (among + ridge * eye) * seen[:, None] + torch.diag_embed(1 - seen)
        off = torch.where(seen > 0, targets.flatten(1).double() - mean[:size], 0.0)
        said = mean[size:] + torch.linalg.solve(square, off) @ across.mT
        rot = rotation.sixd_to_matrix(said[:, 3:].unflatten(-1, (-1, 6)))
        like = self.poses
        return Motion(like.skeleton, said[:, None, :3].to(like.root), rot[:, None].to(like.rot), like.fps)

    def mean(self, count: int) -> Motion:
        """The mean pose, ``count`` times."""
        nothing = torch.zeros(count, self.joints.shape[1], dtype=torch.bool)
        return self.regressed(torch.zeros(*nothing.shape, 3), nothing)

    def distance(self, motion: Motion) -> Tensor:
        """How far poses (B, 1) are from the nearest known one (B,): metres, root mean square over joints."""
        joints = stuck_root(motion)[0].positions[:, 0]
        found, _ = nearest_rows(joints.flatten(1), self.joints.flatten(1))
        return (found / joints.shape[1] ** 0.5).to(joints)


def known(motion: Motion, *, mirrored: bool = True) -> Poses:
    """The poses (N, 1) of windows of one frame on one body, and their mirror images.

    Raises:
        ShapeError: longer windows, or a body for each.
    """
    if motion.root.ndim != 3 or motion.frames != 1 or motion.skeleton.offsets.ndim != 2:
        raise ShapeError(f"expected poses (N, 1) on one body, got root {tuple(motion.root.shape)}")
    stuck, _ = stuck_root(motion)
    both = [stuck, mirror(stuck)] if mirrored else [stuck]
    root, rot = (torch.cat([getattr(m, name) for m in both]) for name in ("root", "rot"))
    return Poses(Motion(motion.skeleton, root, rot, motion.fps))
