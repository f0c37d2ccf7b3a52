"""Handles: joints of a pose that are asked to be at a place; which ones, and what a network hears of them.

Targets (..., 22, 3) are metres in the pose's own stuck frame: above the origin, facing +y. So where a character stands
and which way it faces is given, as a rig's root is to an animator; how high its pelvis is and how it leans is not.
Source: thesis 4.2.4, a subset of joints that an animator fixes. Differs: asked of a handle is its place, where the
thesis keeps what the state holds of it, a rotation (``completion.keep`` does that).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from motionlab.errors import ShapeError, check_shape
from motionlab.frames import stuck_root
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

MOST = 8  # handles of a pose in training, at most
NONE, USUAL = 0.1, 0.45  # how often training draws no handle, and some of ``EFFECTORS``; else of all joints
#: What people hold a figure by.
EFFECTORS = (
    "pelvis", "head", "left_wrist", "right_wrist", "left_ankle", "right_ankle", "left_foot", "right_foot",
)  # fmt: skip
#: Handles by name: joints, or how many are drawn at random for every pose.
SETS: Mapping[str, tuple[str, ...] | int] = {
    "hands": ("left_wrist", "right_wrist"),
    "random 3": 3,
    "five effectors": ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle"),
    "random 6": 6,
}


def told(targets: Tensor, which: Tensor) -> Tensor:
    """What the denoiser hears (..., 22, 4): the targets (..., 22, 3) of handles (..., 22), and a one for each."""
    check_shape(targets, f"... {len(STANDARD)} 3", "targets")
    if which.shape != targets.shape[:-1]:
        raise ShapeError(f"which: expected {tuple(targets.shape[:-1])}, got {tuple(which.shape)}")
    which = which.bool()[..., None]
    return torch.cat((torch.where(which, targets, 0.0), which.to(targets)), -1)


def draw(motion: Motion, generator: torch.Generator) -> Tensor:
    """(B, T, 22, 4): for every window (B, T) handles at random, the same in all its frames, where its joints are.

    None, some of ``EFFECTORS`` or some of all joints, up to ``MOST``, evenly in number.
    """
    count, joints = len(motion.root), len(motion.skeleton)
    kind = torch.rand(count, 1, generator=generator)
    last = torch.ones(joints)
    last[motion.skeleton.indices(list(EFFECTORS))] = 0.0
    order = torch.rand(count, joints, generator=generator) + last * (kind < USUAL)
    number = torch.randint(1, MOST + 1, (count, 1), generator=generator)
    which = (order.argsort(-1).argsort(-1) < number) & (kind < 1 - NONE)
    targets = stuck_root(motion)[0].positions
    return told(targets, which[:, None].expand(targets.shape[:-1]))


def chosen(handles: Sequence[str] | int, count: int, generator: torch.Generator) -> Tensor:
    """Which joints (count, 22) are handles: those of these names, or so many drawn anew for every pose.

    Raises:
        KeyError: no such joint. ValueError: a number of handles that there is not.
    """
    joints = len(STANDARD)
    if isinstance(handles, int):
        if not 0 <= handles <= joints:
            raise ValueError(f"handles: expected 0 to {joints}, got {handles}")
        return torch.rand(count, joints, generator=generator).argsort(-1).argsort(-1) < handles
    which = torch.zeros(count, joints, dtype=torch.bool)
    which[:, STANDARD.indices(list(handles))] = True
    return which
