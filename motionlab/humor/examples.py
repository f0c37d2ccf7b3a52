"""What the prior learns from: windows of states and contacts, drawn from motions on the 22 joints."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.errors import DataError, ShapeError
from motionlab.humor.state import from_motion
from motionlab.motion import Motion, mirror


@dataclass(frozen=True, eq=False)
class Examples:
    """All frames of many motions in one row.

    states (N, 339), world; contacts (N, 9); offsets (N, 22, 3): metres, the bones of each frame's body. begins: the
    frames from which a whole window of ``length`` frames lies inside one motion.
    """

    states: Tensor
    contacts: Tensor
    offsets: Tensor
    begins: Tensor
    length: int

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Windows chosen evenly over all begins: states (B, L, 339), contacts (B, L, 9), offsets (B, 22, 3)."""
        begin = self.begins[torch.randint(len(self.begins), (count,), generator=generator)]
        at = begin[:, None] + torch.arange(self.length)
        return self.states[at], self.contacts[at], self.offsets[begin]

    @property
    def digest(self) -> str:
        """A hash of all numbers, for the recipe."""
        whole = hashlib.sha256()
        for x in (self.states, self.contacts, self.offsets):
            whole.update(x.numpy().tobytes())
        return whole.hexdigest()[:16]


def examples(motions: Sequence[Motion], length: int, *, mirrored: bool = True) -> Examples:
    """Windows of ``length`` frames from motions with contacts, 30 fps, floor at z = 0; and of their mirror images.

    Raises:
        DataError: no motion is that long, or one has no contacts or numbers that are not finite.
        ShapeError: a motion is not on the 22 joints.
    """
    states, contacts, offsets, begins, at = [], [], [], [], 0
    for motion in motions:
        if motion.frames < length:
            continue
        if motion.contacts is None:
            raise DataError("a motion without contacts", place=motion.name, remedy="contact.with_contacts labels it")
        for each in (motion, mirror(motion)) if mirrored else (motion,):
            x = from_motion(each).float()
            if not x.isfinite().all():
                raise DataError("numbers that are not finite", place=motion.name, remedy="leave this motion out")
            states.append(x)
            contacts.append(each.contacts.float())
            offsets.append(each.skeleton.offsets.float().expand(len(x), -1, -1))
            begins.append(at + torch.arange(len(x) - length + 1))
            at += len(x)
    if not states:
        raise DataError(f"no motion has {length} frames", remedy="give longer motions")
    if states[0].shape[-1] != 339:
        raise ShapeError("motions must be on the 22 joints: retarget first")
    return Examples(torch.cat(states), torch.cat(contacts), torch.cat(offsets), torch.cat(begins), length)
