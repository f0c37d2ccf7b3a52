"""Motions as rows of numbers, one per frame: a denoiser's ``Layout``, in named groups; the ``states`` of a completer.

A state is redundant, so that nobody has to learn forward kinematics: the root's place; 6-D rotations; where the joints
are in the frame's own heading frame, and how fast they move there; how fast the root moves and turns there; contacts.
What a completer makes is the first two and the last.

Source: thesis 4.1.2 (state representation: root translation, 6-D rotations, optional contacts and velocities; world or
"stuck root" frame). HuMoR (Rempe et al. 2021), HumanML3D (Guo et al. 2022), whose states are redundant, too.
Differs: stuck to the first frame's heading, not to its whole orientation, so that up stays up; normalised per group,
not per number (half the held-out error after the same training).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Self

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.heading import heading_frame, stuck_root
from motionlab.motion import Motion, backward_velocity
from motionlab.skeleton import STANDARD, Skeleton

_J, _C = len(STANDARD), len(STANDARD.contact_names)
UNITS = _J + 2  # of a frame: the joints' rotations, the root's place, contacts


@dataclass(frozen=True)
class Layout:
    """Which numbers a frame has.

    frame: "stuck" (relative to the first frame's place and heading) or "world". velocities, contacts: with these.
    """

    frame: str = "stuck"
    velocities: bool = False
    contacts: bool = True

    def __post_init__(self) -> None:
        if self.frame not in ("stuck", "world"):
            raise ValueError(f'frame: expected "stuck" or "world", got {self.frame!r}')

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Columns of each group: root, orient, pose, root_vel, rot_vel, contacts, as far as a frame has them."""
        sizes = {"root": 3, "orient": 6, "pose": 6 * (_J - 1)}
        sizes |= {"root_vel": 3, "rot_vel": 6 * _J} if self.velocities else {}
        sizes |= {"contacts": _C} if self.contacts else {}
        stops = accumulate(sizes.values())
        return {name: slice(stop - size, stop) for (name, size), stop in zip(sizes.items(), stops, strict=True)}

    @property
    def size(self) -> int:
        """Numbers per frame."""
        return max(part.stop for part in self.slices.values())

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
                raise DataError("motion without contacts", place=motion.name, remedy="contact.with_contacts labels it")
            parts["contacts"] = motion.contacts.to(motion.root)
        return torch.cat(list(parts.values()), -1)

    def decode(self, rows: Tensor, fps: float, skeleton: Skeleton | None = None) -> Motion:
        """Computes the motion (..., T) of rows (..., T, size); velocities are not read, contacts: above a half."""
        check_shape(rows, f"... T {self.size}", "rows")
        sixd = torch.cat((rows[..., self.slices["orient"]], rows[..., self.slices["pose"]]), -1).unflatten(-1, (-1, 6))
        contacts = (rows[..., self.slices["contacts"]] > 0.5).to(rows) if self.contacts else None
        rot = rotation.sixd_to_matrix(sixd)
        return Motion(skeleton or STANDARD, rows[..., self.slices["root"]], rot, fps, contacts)


def _change(x: Tensor, fps: float) -> Tensor:
    """Forward differences per second (..., T, D); the last frame repeats the one before."""
    rate = backward_velocity(x, fps, dim=-2)
    return torch.cat((rate[..., 1:, :], rate[..., -1:, :]), -2)


@dataclass(frozen=True, eq=False)
class Normaliser:
    """rows <-> numbers of about unit size: one mean per column, one scale per group.

    mean (D,), scale (D,): equal within a group.
    """

    mean: Tensor
    scale: Tensor

    @classmethod
    def measure(cls, rows: Tensor, layout: Layout, *, root_unit: float = 0.0) -> Self:
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


def units(layout: Layout) -> Tensor:
    """Computes the joint that each number of a frame (D,) belongs to; J: the root's place, J + 1: contacts."""
    each, root = torch.arange(_J).repeat_interleave(6), torch.full((3,), _J)
    owners = {"root": root, "orient": each[:6], "pose": each[6:], "root_vel": root, "rot_vel": each}
    owners["contacts"] = torch.full((_C,), _J + 1)
    return torch.cat([owners[name] for name in layout.slices])


_MADE = Layout("world")
_SIZES = {"root": 3, "rot": 6 * _J, "places": 3 * _J, "moves": 3 * _J, "root moves": 3, "turns": 1, "contacts": _C}
SIZE, MADE = sum(_SIZES.values()), _MADE.size
MADE_AT = [*range(MADE - _C), *range(SIZE - _C, SIZE)]  # where in a state what is made stands
OWNERS = units(_MADE)  # the unit that each number made belongs to


def states(motion: Motion) -> Tensor:
    """Computes the states (..., T, ``SIZE``) of a motion on the 22 joints, in the frame that it is in.

    Raises:
        DataError: a motion without contacts.
    """
    frame, numbers = heading_frame(motion.root, motion.rot[..., 0, :, :]), made(motion)
    turn, places = frame.turn, motion.positions
    moves = backward_velocity(places, motion.fps, dim=-3)
    turned = backward_velocity(rotation.yaw(motion.rot[..., 0, :, :])[..., None], 1.0, dim=-2)
    parts = (
        numbers[..., :-_C], ((places + frame.shift[..., None, :]) @ turn.mT).flatten(-2), (moves @ turn.mT).flatten(-2),
        (moves[..., :1, :] @ turn.mT)[..., 0, :], torch.atan2(turned.sin(), turned.cos()) * motion.fps,
        numbers[..., -_C:],
    )  # fmt: skip
    return torch.cat(parts, -1)


def made(motion: Motion) -> Tensor:
    """Computes of a motion the numbers (..., T, ``MADE``) that a network makes: root, 6-D rotations, contacts."""
    return _MADE.encode(motion)


def motion_of(numbers: Tensor, like: Motion) -> Motion:
    """Computes the motion of numbers (..., T, ``MADE``), on the body and at the rate of another; contacts as they are
    (0 to 1)."""
    root, sixd, contacts = numbers.split((3, 6 * _J, _C), -1)
    rot = rotation.sixd_to_matrix(sixd.unflatten(-1, (_J, 6)))
    return Motion(like.skeleton, root, rot, like.fps, contacts, like.name)


def restore_known(made: Motion, given: Motion, known: Tensor) -> Motion:
    """Returns a motion with its known rotations and places (..., T, U) as they were given, without the rounding of a
    way there and back."""
    rot = torch.where(known[..., :_J, None, None], given.rot, made.rot)
    return replace(made, rot=rot, root=torch.where(known[..., _J, None], given.root, made.root))


def open_places(units: Tensor) -> Tensor:
    """Computes which joints' places (..., J) are open where these units (..., U) are known: an unknown root or an
    unknown rotation above them moves them, their own does not."""
    open_ = [~units[..., _J]]
    for parent in STANDARD.parents[1:]:
        open_.append(open_[parent] | ~units[..., parent])
    return torch.stack(open_, -1)


def sizes(states: Tensor) -> tuple[Tensor, Tensor]:
    """Computes from states (..., ``SIZE``) what makes them about unit size: a mean (``SIZE``,) per column, a scale
    (``SIZE``,) per group."""
    flat = states.reshape(-1, SIZE)
    mean = flat.mean(0)
    groups = (flat - mean).square().mean(0).split(list(_SIZES.values()))
    return mean, torch.cat([x.mean().sqrt().clamp(min=1e-3).expand(len(x)) for x in groups])
