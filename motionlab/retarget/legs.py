"""Feet on the floor: when they rest, how much they slide, and legs that reach where the source's ankles were."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.contact import contacts_from_positions
from motionlab.motion import Motion
from motionlab.skeleton import fk


def resting(points: Tensor, fps: float) -> Tensor:
    """Where points (T, F, 3) rest on the floor: (T, F) bool.

    The project's contacts (:func:`motionlab.contact.contacts_from_positions`), with each point's own low
    (2 % of its heights are lower) as its height on the floor: a file's floor need not be at 0.
    """
    if len(points) < 2:
        return torch.zeros_like(points[..., 2], dtype=torch.bool)
    low = torch.quantile(points[..., 2], 0.02, dim=0)
    return contacts_from_positions(points, fps, low) > 0


def skate(points: Tensor, rests: Tensor) -> float:
    """Mean horizontal slide of points (T, F, 3), mm per frame, over steps whose two frames rest (T, F); NaN if none."""
    both = rests[1:] & rests[:-1]
    step = points[1:, :, :2] - points[:-1, :, :2]
    return 1000 * float(step.norm(dim=-1)[both].mean()) if both.any() else float("nan")


def reach(motion: Motion, ankles: Tensor) -> Motion:
    """Legs bent so that the ankles are at ``ankles`` (T, 2, 3: left, right); feet keep their orientation.

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
        turn_thigh = rotation.between(k - h, new_k - h)
        turn_shin = rotation.between(a - k, h + d * u - new_k)
        upper, lower = turn_thigh @ world[:, hip], turn_shin @ world[:, knee]
        rot[:, hip] = world[:, motion.skeleton.parents[hip]].mT @ upper
        rot[:, knee] = upper.mT @ lower
        rot[:, ankle] = lower.mT @ world[:, ankle]
    return replace(motion, rot=rot)
