"""Motions as rows of numbers for the denoiser: one row per frame, in named groups, of about unit size.

Source: thesis 4.1.2 (state representation: root translation, 6-D rotations, optional contacts and velocities; world or
"stuck root" frame).
Differs: stuck to the first frame's heading, not to its whole orientation, so that up stays up; normalised per group,
not per number (half the held-out error after the same training).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.heading import stuck_root
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, Skeleton

_FRAMES = ("stuck", "world")


@dataclass(frozen=True)
class Layout:
    """Which numbers a frame has.

    frame: "stuck" (relative to the first frame's place and heading) or "world". velocities, contacts: with these.
    """

    frame: str = "stuck"
    velocities: bool = False
    contacts: bool = True

    def __post_init__(self) -> None:
        if self.frame not in _FRAMES:
            raise ValueError(f"frame: expected one of {', '.join(_FRAMES)}, got {self.frame!r}")

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Columns of each group: root, orient, pose, root_vel, rot_vel, contacts, as far as a frame has them."""
        joints, found, at = len(STANDARD), {}, 0
        sizes = {"root": 3, "orient": 6, "pose": 6 * (joints - 1)}
        sizes |= {"root_vel": 3, "rot_vel": 6 * joints} if self.velocities else {}
        sizes |= {"contacts": len(STANDARD.contact_names)} if self.contacts else {}
        for name, size in sizes.items():
            found[name], at = slice(at, at + size), at + size
        return found

    @property
    def size(self) -> int:
        """Numbers per frame."""
        return max(part.stop for part in self.slices.values())

    # ------------------------------------------------------------------------------------------ there and back
    def encode(self, motion: Motion) -> Tensor:
        """Computes rows (..., T, size) of a motion on the 22 joints, not yet normalised.

        Raises:
            DataError: contacts are asked for and the motion has none.
            ShapeError: other joints.
        """
        if motion.skeleton.names != STANDARD.names:
            raise ShapeError("motion: expected the 22 joints; retarget first")
        if self.frame == "stuck":
            motion, _ = stuck_root(motion)
        sixd = rotation.matrix_to_sixd(motion.rot)
        parts = {"root": motion.root, "orient": sixd[..., 0, :], "pose": sixd[..., 1:, :].flatten(-2)}
        if self.velocities:
            parts |= {"root_vel": _change(motion.root, motion.fps), "rot_vel": _change(sixd.flatten(-2), motion.fps)}
        if self.contacts:
            if motion.contacts is None:
                remedy = "contact.with_contacts labels it"
                raise DataError("a motion without contacts", place=motion.name, remedy=remedy)
            parts["contacts"] = motion.contacts.to(motion.root)
        return torch.cat([parts[name] for name in self.slices], -1)

    def decode(self, rows: Tensor, fps: float, skeleton: Skeleton | None = None) -> Motion:
        """Computes the motion (..., T) of rows (..., T, size); velocities are not read, contacts: above a half."""
        check_shape(rows, f"... T {self.size}", "rows")
        sixd = torch.cat((rows[..., self.slices["orient"]], rows[..., self.slices["pose"]]), -1).unflatten(-1, (-1, 6))
        contacts = (rows[..., self.slices["contacts"]] > 0.5).to(rows) if self.contacts else None
        rot = rotation.sixd_to_matrix(sixd)
        return Motion(skeleton or STANDARD, rows[..., self.slices["root"]], rot, fps, contacts)


def _change(x: Tensor, fps: float) -> Tensor:
    """Forward differences per second (..., T, D); the last frame repeats the one before."""
    if x.shape[-2] < 2:
        return torch.zeros_like(x)
    moved = x.diff(dim=-2) * fps
    return torch.cat((moved, moved[..., -1:, :]), -2)


@dataclass(frozen=True, eq=False)
class Normaliser:
    """rows <-> numbers of about unit size: one mean per column, one scale per group.

    mean (D,), scale (D,): equal within a group.
    """

    mean: Tensor
    scale: Tensor

    @classmethod
    def measure(cls, rows: Tensor, layout: Layout, *, root_unit: float = 0.0) -> Normaliser:
        """Measures mean and scale on training rows (..., D). A group that never changes keeps its size.

        root_unit: metres that are one unit of the root's place; 0: its deviation, which is mostly how far people walk,
        so that noise of a tenth hides centimetres of a step while it moves a hand by millimetres.
        """
        flat = rows.reshape(-1, rows.shape[-1])
        mean, scale = flat.mean(0), torch.ones_like(flat[0])
        for part in layout.slices.values():
            spread = (flat[:, part] - mean[part]).square().mean().sqrt()
            scale[part] = spread if spread > 1e-6 else 1.0
        if root_unit:
            scale[layout.slices["root"]] = root_unit
        return cls(mean, scale)

    def apply(self, rows: Tensor) -> Tensor:
        """Converts rows to numbers of about unit size."""
        return (rows - self.mean.to(rows)) / self.scale.to(rows)

    def undo(self, x: Tensor) -> Tensor:
        """Converts numbers of about unit size back to rows."""
        return x * self.scale.to(x) + self.mean.to(x)
