"""The state of one frame, 339 numbers, and the transition that turns one into the next.

    trans 3 | trans_vel 3 | root_orient 9 | root_orient_vel 3 | pose_body 189 | joints 66 | joints_vel 66

Metres, seconds, radians; world z up, floor at z = 0; matrices row-major. ``joints`` are the network's own idea of where
the joints are, kept beside the pose that implies them.

Source: HuMoR (Rempe et al. 2021), section 3; thesis 3.1.1.
Differs: ``trans`` is the pelvis itself, unless ``offset`` says where the pelvis lies from it (SMPL's translation is not
its pelvis). The heading is exact in two dimensions, where the official code takes acos of a guarded cosine.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import check_shape
from motionlab.frames import (
    Frame,
    heading_frame,
    local_to_world_orientations,
    local_to_world_positions,
    world_to_local_orientations,
    world_to_local_positions,
)
from motionlab.motion import Motion, velocity
from motionlab.skeleton import Skeleton

JOINTS, CONTACTS = 22, 9
#: Frames per second that the prior knows: a transition takes a thirtieth of a second.
FPS = 30.0
#: The parts of a state and their shapes.
SHAPES = {
    "trans": (3,), "trans_vel": (3,), "root_orient": (3, 3), "root_orient_vel": (3,),
    "pose_body": (21, 3, 3), "joints": (22, 3), "joints_vel": (22, 3),
}  # fmt: skip
#: The parts of the raw decoder's output: changes, rotations as vectors, and contact logits.
DELTA_SHAPES = SHAPES | {"root_orient": (3,), "pose_body": (21, 3), "contacts": (9,)}


def _slices(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, slice]:
    ends = accumulate((torch.Size(shape).numel() for shape in shapes.values()), initial=0)
    return {name: slice(*pair) for name, pair in zip(shapes, pairwise(ends), strict=True)}


SLICES, DELTA_SLICES = _slices(SHAPES), _slices(DELTA_SHAPES)
STATE, DELTA = SLICES["joints_vel"].stop, DELTA_SLICES["contacts"].stop


def unpack(state: Tensor) -> dict[str, Tensor]:
    """The parts of states (..., 339) by name, each (..., *SHAPES[name]); views."""
    check_shape(state, f"... {STATE}", "state")
    return {name: state[..., SLICES[name]].unflatten(-1, shape) for name, shape in SHAPES.items()}


def pack(parts: Mapping[str, Tensor]) -> Tensor:
    """States (..., 339) from their parts."""
    for name, shape in SHAPES.items():
        check_shape(parts[name], "... " + " ".join(map(str, shape)), name)
    return torch.cat([parts[name].flatten(-len(shape)) for name, shape in SHAPES.items()], dim=-1)


def unpack_delta(raw: Tensor) -> dict[str, Tensor]:
    """The parts of raw decoder outputs (..., 216) by name; views."""
    check_shape(raw, f"... {DELTA}", "raw")
    return {name: raw[..., DELTA_SLICES[name]].unflatten(-1, shape) for name, shape in DELTA_SHAPES.items()}


def from_motion(motion: Motion) -> Tensor:
    """World states (..., T, 339) of a motion on the 22 joints; velocities by central differences.

    Root angular velocity: the vector of dR/dt R^T, world axes.
    """
    positions, _ = motion.world
    check_shape(positions, f"... {JOINTS} 3", "joints")
    root = motion.rot[..., 0, :, :]
    return pack(
        {
            "trans": motion.root,
            "trans_vel": velocity(motion.root, motion.fps, dim=-2),
            "root_orient": root,
            "root_orient_vel": angular_velocity(root, motion.fps),
            "pose_body": motion.rot[..., 1:, :, :],
            "joints": positions,
            "joints_vel": velocity(positions, motion.fps, dim=-3),
        }
    )


def angular_velocity(orientation: Tensor, fps: float) -> Tensor:
    """Radians per second (..., T, 3), world axes, of orientations (..., T, 3, 3): the vector of dR/dt R^T."""
    spin = velocity(orientation, fps, dim=-3) @ orientation.mT
    skew = (spin - spin.mT) / 2
    return torch.stack((skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]), -1)


def to_motion(state: Tensor, skeleton: Skeleton, fps: float = 30.0, contacts: Tensor | None = None) -> Motion:
    """The motion that states (..., T, 339) describe by root and angles; their ``joints`` play no part."""
    parts = unpack(state)
    rot = torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), dim=-3)
    return Motion(skeleton, parts["trans"], rot, fps, contacts)


def heading(state: Tensor) -> Frame:
    """The canonical frame (...) of states (..., 339): on the floor below ``trans``, the body facing +y."""
    return heading_frame(state[..., SLICES["trans"]], state[..., SLICES["root_orient"]].unflatten(-1, (3, 3)))


def localise(state: Tensor, frame: Frame, offset: Tensor | None = None) -> Tensor:
    """World states (..., 339) in the coordinates of a frame (...).

    trans -> A (t + s), joints -> A (j + s + c) - c, velocities and root orientation are turned by A, the pose stays.
    offset (..., 3): c, minus the horizontal way from ``trans`` to the pelvis at the first frame; None: 0.
    """
    return _moved(state, frame, offset, world_to_local_positions, world_to_local_orientations)


def globalise(state: Tensor, frame: Frame, offset: Tensor | None = None) -> Tensor:
    """The inverse of :func:`localise`."""
    return _moved(state, frame, offset, local_to_world_positions, local_to_world_orientations)


def _moved(state, frame, offset, positions, orientations) -> Tensor:
    parts = unpack(state)
    turned = Frame(frame.turn, torch.zeros_like(frame.shift))
    c = 0.0 if offset is None else offset[..., None, :]
    return pack(
        {
            "trans": positions(frame, parts["trans"]),
            "trans_vel": positions(turned, parts["trans_vel"]),
            "root_orient": orientations(frame, parts["root_orient"]),
            "root_orient_vel": positions(turned, parts["root_orient_vel"]),
            "pose_body": parts["pose_body"],
            "joints": positions(frame, parts["joints"] + c) - c,
            "joints_vel": positions(turned, parts["joints_vel"]),
        }
    )


def pelvis_offset(state: Tensor) -> Tensor:
    """c (..., 3) of states (..., 339): minus the horizontal way from ``trans`` to the pelvis."""
    parts = unpack(state)
    return (parts["trans"] - parts["joints"][..., 0, :]) * torch.tensor([1.0, 1.0, 0.0]).to(state)


def apply(state: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
    """One transition: the next states (..., 339) and contact logits (..., 9), from changes (..., 216).

    Additive, but for rotations: R' = exp(delta) R, multiplied from the left.
    """
    parts, delta = unpack(state), unpack_delta(raw)
    turn = {"root_orient", "pose_body"}
    after = {n: rotation.exp(delta[n]) @ parts[n] if n in turn else parts[n] + delta[n] for n in SHAPES}
    return pack(after), delta["contacts"]
