"""Motion: the value that travels; what can be done to any motion; frames of reference that move with the body."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import ShapeError, check_shape
from motionlab.skeleton import Skeleton, fk


@dataclass(frozen=True, eq=False)
class Motion:
    """A batch of skeletal motions. Metres, seconds, z up, right-handed; local rotation matrices, column vectors.

    root (..., T, 3): position of joint 0 (the pelvis), world.
    rot (..., T, J, 3, 3): each joint relative to its parent; joint 0 relative to the world.
    fps: frames per second.
    contacts (..., T, C) or None: 1 where the joint named in skeleton.contact_names touches the floor.
    name: where it came from, for tables and messages.
    notes: what a loader had to decide or guess (unit, up axis, dropped channels), one sentence each.

    It stores matrices because the rotation representation is an argument of an experiment, never a
    property of a container.

    Raises:
        ShapeError: the arrays do not fit each other or the skeleton, or fps is not positive.
    """

    skeleton: Skeleton
    root: Tensor
    rot: Tensor
    fps: float
    contacts: Tensor | None = None
    name: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_shape(self.rot, f"... T {len(self.skeleton)} 3 3", "rot")
        check_shape(self.root, "... T 3", "root")
        batch = self.rot.shape[:-3]
        if self.root.shape[:-1] != batch:
            raise ShapeError(f"root {tuple(self.root.shape)} and rot {tuple(self.rot.shape)}: leading axes differ")
        if self.contacts is not None and self.contacts.shape != (*batch, len(self.skeleton.contact_names)):
            expected = (*batch, len(self.skeleton.contact_names))
            raise ShapeError(f"contacts: expected shape {expected}, got {tuple(self.contacts.shape)}")
        if not 0 < self.fps < math.inf:
            raise ShapeError(f"fps: expected a positive number, got {self.fps}")

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return self.root.shape[-2]

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last, plus one frame."""
        return self.frames / self.fps

    @cached_property
    def world(self) -> tuple[Tensor, Tensor]:
        """Joint positions (..., T, J, 3) and orientations (..., T, J, 3, 3), world."""
        return fk(self.skeleton, self.root, self.rot)

    @property
    def positions(self) -> Tensor:
        """Joint positions (..., T, J, 3), metres, world."""
        return self.world[0]

    def cut(self, start: int | None = None, stop: int | None = None, step: int | None = None) -> Motion:
        """Frames start:stop:step; a step divides the frame rate."""
        pick = slice(start, stop, step)
        contacts = None if self.contacts is None else self.contacts[..., pick, :]
        return replace(
            self,
            root=self.root[..., pick, :],
            rot=self.rot[..., pick, :, :, :],
            contacts=contacts,
            fps=self.fps / (step or 1),
        )

    def clip(self, index) -> Motion:
        """One entry (or a slice) of the leading batch axis, with its own skeleton where each has one."""
        contacts = None if self.contacts is None else self.contacts[index]
        rot, offsets = self.rot[index], self.skeleton.offsets
        if offsets.ndim == self.rot.ndim - 1:  # (N or 1, ..., 1, J, 3)
            offsets = offsets.expand(len(self.rot), *offsets.shape[1:])[index]
            offsets = offsets[0] if rot.ndim == 4 and len(offsets) == 1 else offsets
        skeleton = replace(self.skeleton, offsets=offsets)
        return replace(self, skeleton=skeleton, root=self.root[index], rot=rot, contacts=contacts)

    def to(self, *args, **kwargs) -> Motion:
        """Every tensor on another device or of another dtype."""
        contacts = None if self.contacts is None else self.contacts.to(*args, **kwargs)
        return replace(
            self,
            skeleton=self.skeleton.to(*args, **kwargs),
            root=self.root.to(*args, **kwargs),
            rot=self.rot.to(*args, **kwargs),
            contacts=contacts,
        )


def velocity(x: Tensor, fps: float, dim: int) -> Tensor:
    """Computes rates of change per second by central differences, one-sided at the ends; one frame gives zeros.

    Source: HuMoR's state velocities (central inside, one-sided at the ends).
    """
    if x.shape[dim] < 2:
        return torch.zeros_like(x)
    return torch.gradient(x, spacing=1.0 / fps, dim=dim)[0]


def resample(motion: Motion, fps: float) -> Motion:
    """Computes a motion at another frame rate: positions linearly, rotations by slerp, contacts by the nearest frame.

    The first frame stays; the last sample is the last that lies inside the recording.

    Raises:
        ShapeError: fps is not a positive number.
    """
    if not 0 < fps < math.inf:
        raise ShapeError(f"fps: expected a positive number, got {fps}")
    if fps == motion.fps:
        return motion
    count = int((motion.frames - 1) / motion.fps * fps + 1e-6) + 1
    at = torch.arange(count, dtype=torch.float64) * (motion.fps / fps)
    low = at.floor().long().clamp(max=max(motion.frames - 2, 0))
    high = (low + 1).clamp(max=motion.frames - 1)
    weight = (at - low).to(motion.root)
    near = at.round().long().clamp(max=motion.frames - 1)
    return replace(
        motion,
        fps=float(fps),
        root=torch.lerp(motion.root[..., low, :], motion.root[..., high, :], weight[:, None]),
        rot=rotation.slerp(motion.rot[..., low, :, :, :], motion.rot[..., high, :, :, :], weight[:, None]),
        contacts=None if motion.contacts is None else motion.contacts[..., near, :],
    )


def windows(motion: Motion, length: int, stride: int) -> Motion:
    """Cuts a motion into all windows of ``length`` frames, ``stride`` apart, on a new leading axis (N, ..., length).

    Raises:
        ShapeError: the motion is shorter than one window, or length or stride is below 1.
    """
    if min(length, stride) < 1:
        raise ShapeError(f"windows: expected a length and a stride of at least 1, got {length} and {stride}")
    if motion.frames < length:
        raise ShapeError(f"{motion.name or 'motion'}: {motion.frames} frames are fewer than one window of {length}")

    def unfold(x: Tensor, rest: int) -> Tensor:  # (..., T, rest) -> (N, ..., length, rest)
        dim = x.ndim - 1 - rest
        return x.unfold(dim, length, stride).movedim(-1, dim + 1).movedim(dim, 0)

    return replace(
        motion,
        root=unfold(motion.root, 1),
        rot=unfold(motion.rot, 3),
        contacts=None if motion.contacts is None else unfold(motion.contacts, 1),
    )


def joined(motions: Iterable[Motion]) -> Motion:
    """Joins windows (N_i, T) on one body into one batch; contacts only where all have them.

    Raises:
        ShapeError: none, or other bodies, lengths or rates than the first one's.
    """
    motions = list(motions)
    if not motions:
        raise ShapeError("joined: none to join")
    first = motions[0]
    if first.root.ndim != 3 or first.skeleton.offsets.ndim != 2:
        raise ShapeError(f"joined: expected windows (N, T) on one body, got root {tuple(first.root.shape)}")
    for other in motions[1:]:
        here, there = first.skeleton.offsets, other.skeleton.offsets
        same_body = here.shape == there.shape and torch.allclose(here, there, atol=1e-6)
        if not same_body or other.frames != first.frames or other.fps != first.fps:
            raise ShapeError("joined: expected windows of one length and rate on one body")
    labelled = all(m.contacts is not None for m in motions)
    contacts = torch.cat([m.contacts for m in motions]) if labelled else None
    root, rot = (torch.cat([getattr(m, name) for m in motions]) for name in ("root", "rot"))
    return replace(first, root=root, rot=rot, contacts=contacts)


def mirror(motion: Motion) -> Motion:
    """Mirrors a motion in the world's plane x = 0: left becomes right.

    R'_j = M R_partner(j) M with M = diag(-1, 1, 1); root and contacts likewise; a skeleton that is not
    symmetric gets its partner's bone lengths.

    Raises:
        ShapeError: no two joints are named left_... and right_..., so that nothing says what changes places.
    """
    flip = motion.root.new_tensor([-1.0, 1.0, 1.0])
    partner = motion.skeleton.mirror_indices
    if partner == list(range(len(partner))):
        raise ShapeError(f"no left_ and right_ joints among {', '.join(motion.skeleton.names[:6])}: retarget first")
    names = motion.skeleton.contact_names
    swapped = [names.index(motion.skeleton.names[partner[j]]) for j in motion.skeleton.contact_indices]
    offsets = motion.skeleton.offsets[..., partner, :] * flip.to(motion.skeleton.offsets)
    return replace(
        motion,
        skeleton=replace(motion.skeleton, offsets=offsets),
        root=motion.root * flip,
        rot=flip[:, None] * motion.rot[..., partner, :, :] * flip,
        contacts=None if motion.contacts is None else motion.contacts[..., swapped],
    )


def fix_root_horizontally(motion: Motion) -> Motion:
    """Holds the root above (0, 0) at every frame, height and orientation as they were; contacts are dropped.

    Not invertible: the path over the floor is gone, and with it which foot stood still.

    Source: thesis 4.1.2, the first version of its data.
    """
    return replace(motion, root=motion.root * torch.tensor([0.0, 0.0, 1.0]).to(motion.root), contacts=None)


def stuck_root(motion: Motion, axes: str = "heading") -> tuple[Motion, Frame]:
    """Computes a motion relative to its first frame, and that frame (..., 1); ``local_to_world`` undoes it exactly.

    ``axes="heading"``: it starts above (0, 0) facing +y; z stays up and the floor stays the floor.
    ``axes="root"``: it starts in the origin with identity root orientation, and up is lost.

    Source: thesis 4.1.2, the "stuck root" state.
    """
    if axes not in ("heading", "root"):
        raise ValueError(f'axes: expected "heading" or "root", got {axes!r}')
    make = heading_frame if axes == "heading" else _root_frame
    frame = make(motion.root[..., :1, :], motion.rot[..., :1, 0, :, :])
    return world_to_local(frame, motion), frame


@dataclass(frozen=True, eq=False)
class Frame:
    """Local coordinates: local = turn (world + shift).

    turn (..., 3, 3): local from world. shift (..., 3): metres, world; minus the origin of the local frame.
    """

    turn: Tensor
    shift: Tensor

    def __post_init__(self) -> None:
        check_shape(self.turn, "... 3 3", "turn")
        check_shape(self.shift, "... 3", "shift")


def heading_frame(root: Tensor, orientation: Tensor) -> Frame:
    """Computes the heading frame from a root: on the floor below it, y where the body looks; heights stay heights.

    A = [[r_x, r_y], [-r_y, r_x]] / |r| takes the body's right axis on the floor, r = -orientation[:2, 0], to
    +x; shift = (-x, -y, 0). A body lying exactly on its side has no heading and keeps the world's axes.

    Args:
        root: (..., 3) position of the root, metres, world. orientation: (..., 3, 3) of the root, world.
    Source: HuMoR's canonical frame. Differs: exact, where HuMoR takes acos of a guarded cosine.
    """
    check_shape(root, "... 3", "root")
    check_shape(orientation, "... 3 3", "orientation")
    on_floor = torch.tensor([-1.0, -1.0, 0.0]).to(root)
    return Frame(rotation.rotation_about("z", -rotation.yaw(orientation)), root * on_floor)


def _root_frame(root: Tensor, orientation: Tensor) -> Frame:
    """The frame of the root itself: the root lies in the origin with identity orientation; up is not up there."""
    check_shape(root, "... 3", "root")
    check_shape(orientation, "... 3 3", "orientation")
    return Frame(orientation.mT, -root)


def world_to_local(frame: Frame, motion: Motion) -> Motion:
    """Turns and moves a motion into a frame's coordinates; the frame has the axes of ``motion.root`` (T may be 1)."""
    root_rot = world_to_local_orientations(frame, motion.rot[..., 0, :, :])
    rot = torch.cat((root_rot[..., None, :, :], motion.rot[..., 1:, :, :]), dim=-3)
    return replace(motion, root=world_to_local_positions(frame, motion.root), rot=rot)


def local_to_world(frame: Frame, motion: Motion) -> Motion:
    """The inverse of :func:`world_to_local`."""
    root_rot = local_to_world_orientations(frame, motion.rot[..., 0, :, :])
    rot = torch.cat((root_rot[..., None, :, :], motion.rot[..., 1:, :, :]), dim=-3)
    return replace(motion, root=local_to_world_positions(frame, motion.root), rot=rot)


def world_to_local_positions(frame: Frame, positions: Tensor) -> Tensor:
    """Turns and shifts points (..., 3) or (..., K, 3), metres, into a frame's coordinates; (...) are its axes."""
    turn, shift = _spread(frame, positions.ndim - 1)
    return ((positions + shift)[..., None, :] @ turn.mT)[..., 0, :]


def local_to_world_positions(frame: Frame, positions: Tensor) -> Tensor:
    """The inverse of :func:`world_to_local_positions`."""
    turn, shift = _spread(frame, positions.ndim - 1)
    return (positions[..., None, :] @ turn)[..., 0, :] - shift


def world_to_local_orientations(frame: Frame, orientations: Tensor) -> Tensor:
    """Turns world orientations (..., 3, 3) or (..., K, 3, 3) into a frame; rotations relative to a parent stay."""
    turn, _ = _spread(frame, orientations.ndim - 2)
    return turn @ orientations


def local_to_world_orientations(frame: Frame, orientations: Tensor) -> Tensor:
    """The inverse of :func:`world_to_local_orientations`."""
    turn, _ = _spread(frame, orientations.ndim - 2)
    return turn.mT @ orientations


def _spread(frame: Frame, axes: int) -> tuple[Tensor, Tensor]:
    """The frame's tensors with axes of size 1 behind its own, ``axes`` in all, to meet points per frame."""
    more = (1,) * (axes - frame.shift.ndim + 1)
    batch = frame.shift.shape[:-1]
    return frame.turn.reshape(*batch, *more, 3, 3), frame.shift.reshape(*batch, *more, 3)
