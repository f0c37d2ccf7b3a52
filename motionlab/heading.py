"""Moves motions into the heading frame, which turns with where a body faces, or into another frame, and back."""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import check_shape
from motionlab.motion import Motion


class Frame(NamedTuple):
    """Local coordinates: local = turn (world + shift).

    turn (..., 3, 3): local from world. shift (..., 3): metres, world; minus the origin of the local frame.
    """

    turn: Tensor
    shift: Tensor


def heading_frame(root: Tensor, orientation: Tensor) -> Frame:
    """Computes the heading frame from a root: on the floor below it, y where the body looks; heights stay heights.

    A = [[r_x, r_y], [-r_y, r_x]] / |r| takes the body's right axis on the floor, r = -orientation[:2, 0], to
    +x; shift = (-x, -y, 0). A body lying exactly on its side has no heading and keeps the world's axes.

    root (..., 3): metres, world. orientation (..., 3, 3): of the root, world.
    Source: HuMoR's canonical frame, see ``rotation.yaw``.
    """
    check_shape(root, "... 3", "root")
    check_shape(orientation, "... 3 3", "orientation")
    on_floor = torch.tensor([-1.0, -1.0, 0.0]).to(root)
    return Frame(rotation.rotation_about("z", -rotation.yaw(orientation)), root * on_floor)


def stuck_root(motion: Motion) -> tuple[Motion, Frame]:
    """Computes a motion relative to its first frame, and that frame (..., 1); ``local_to_world`` undoes it exactly.

    It starts above (0, 0) facing +y; z stays up and the floor stays the floor.

    Source: thesis 4.1.2, the "stuck root" state.
    """
    frame = heading_frame(motion.root[..., :1, :], motion.rot[..., :1, 0, :, :])
    return world_to_local(frame, motion), frame


def world_to_local(frame: Frame, motion: Motion) -> Motion:
    """Turns and moves a motion into a frame's coordinates; the frame has the axes of ``motion.root`` (T may be 1)."""
    return _with_root(motion, frame, world_to_local_positions, world_to_local_orientations)


def local_to_world(frame: Frame, motion: Motion) -> Motion:
    """Turns and moves a motion out of a frame's coordinates: the inverse of :func:`world_to_local`."""
    return _with_root(motion, frame, local_to_world_positions, local_to_world_orientations)


def _with_root(motion: Motion, frame: Frame, positions, orientations) -> Motion:
    turned = orientations(frame, motion.rot[..., :1, :, :])
    return replace(motion, root=positions(frame, motion.root), rot=torch.cat((turned, motion.rot[..., 1:, :, :]), -3))


def world_to_local_positions(frame: Frame, positions: Tensor) -> Tensor:
    """Turns and shifts points (..., 3) or (..., K, 3), metres, into a frame's coordinates; (...) are its axes."""
    turn, shift = _spread(frame, positions.ndim - 1)
    return ((positions + shift)[..., None, :] @ turn.mT)[..., 0, :]


def local_to_world_positions(frame: Frame, positions: Tensor) -> Tensor:
    """Turns and shifts points out of a frame's coordinates: the inverse of :func:`world_to_local_positions`."""
    turn, shift = _spread(frame, positions.ndim - 1)
    return (positions[..., None, :] @ turn)[..., 0, :] - shift


def world_to_local_orientations(frame: Frame, orientations: Tensor) -> Tensor:
    """Turns world orientations (..., 3, 3) or (..., K, 3, 3) into a frame; rotations relative to a parent stay."""
    turn, _ = _spread(frame, orientations.ndim - 2)
    return turn @ orientations


def local_to_world_orientations(frame: Frame, orientations: Tensor) -> Tensor:
    """Turns orientations out of a frame: the inverse of :func:`world_to_local_orientations`."""
    turn, _ = _spread(frame, orientations.ndim - 2)
    return turn.mT @ orientations


def _spread(frame: Frame, axes: int) -> tuple[Tensor, Tensor]:
    """The frame's tensors with axes of size 1 behind its own, ``axes`` in all, to meet points per frame."""
    more = (None,) * (axes - frame.shift.ndim + 1)
    return frame.turn[..., *more, :, :], frame.shift[..., *more, :]
