"""The state of one frame, 339 numbers, and the transition that turns one into the next.

    trans 3 | trans_vel 3 | root_orient_vel 3 | joints 66 | joints_vel 66 | root_orient 9 | pose_body 189

Metres, seconds, radians; world z up, floor at z = 0. ``joints`` are the network's own idea of where the joints are,
kept beside the pose that implies them. Rotations stand transposed, row by row. So the first 141 numbers are what a
transition adds to, the last 198 are the 22 matrices that it turns, and the first 150 are the 50 vectors that a new
heading turns. Official weights are put into this order where they are read (``priors.from_weights``).

Source: HuMoR (Rempe et al. 2021), section 3; thesis 3.1.1.
Differs: the official order is trans, trans_vel, root_orient, root_orient_vel, pose_body, joints, joints_vel, matrices
not transposed, and ``trans`` is SMPL's translation, here the pelvis itself (``pretrained`` moves official weights). The
heading is exact in two dimensions, where the official code takes acos of a guarded cosine.
"""

from collections.abc import Mapping
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import check_shape
from motionlab.heading import Frame, heading_frame
from motionlab.motion import FPS, Motion, backward_velocity, velocity
from motionlab.skeleton import STANDARD, Skeleton

CONTACTS = 9
#: Shapes of the parts of a state in their order.
SHAPES = {
    "trans": (3,), "trans_vel": (3,), "root_orient_vel": (3,), "joints": (22, 3), "joints_vel": (22, 3),
    "root_orient": (3, 3), "pose_body": (21, 3, 3),
}  # fmt: skip
#: The parts that are rotations; they stand transposed.
TURNED = ("root_orient", "pose_body")
#: The parts of the raw decoder's output: changes, rotations as vectors, and contact logits.
DELTA_SHAPES = SHAPES | {"root_orient": (3,), "pose_body": (21, 3), "contacts": (9,)}
#: Where the parts end: what is added to, the vectors that a heading turns; of raw outputs the changes.
ADDED, VECTORS, CHANGES = 141, 150, 207
#: Which of the 50 vectors are positions.
_PLACED = torch.zeros(VECTORS // 3, 1)
_PLACED[0] = _PLACED[3:25] = 1


def _slices(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, slice]:
    ends = accumulate((torch.Size(shape).numel() for shape in shapes.values()), initial=0)
    return {name: slice(*pair) for name, pair in zip(shapes, pairwise(ends), strict=True)}


SLICES, DELTA_SLICES = _slices(SHAPES), _slices(DELTA_SHAPES)
STATE, DELTA = SLICES["pose_body"].stop, DELTA_SLICES["contacts"].stop
_OFFICIAL = ("trans", "trans_vel", "root_orient", "root_orient_vel", "pose_body", "joints", "joints_vel")
#: Where the parts stand in an official state.
OFFICIAL_SLICES = _slices({name: SHAPES[name] for name in _OFFICIAL})


_OFFICIAL_RAW = _slices({name: DELTA_SHAPES[name] for name in (*_OFFICIAL, "contacts")})
_at = {name: torch.arange(STATE)[part].unflatten(0, SHAPES[name]) for name, part in OFFICIAL_SLICES.items()}
#: Official states ``x[..., OFFICIAL_ORDER]`` and raw outputs ``raw[..., OFFICIAL_DELTA_ORDER]`` are ours; by the
#: ``argsort`` of these ours are official.
OFFICIAL_ORDER = torch.cat([(_at[n].mT if n in TURNED else _at[n]).flatten() for n in SHAPES])
OFFICIAL_DELTA_ORDER = torch.cat([torch.arange(DELTA)[_OFFICIAL_RAW[n]] for n in DELTA_SHAPES])


#: (216, 339): takes a state to the raw changes of a body that goes on at its velocity for one frame.
ONWARD = torch.zeros(DELTA, STATE)
for _name in ("trans", "root_orient", "joints"):
    ONWARD[DELTA_SLICES[_name], SLICES[f"{_name}_vel"]] = torch.eye(torch.Size(DELTA_SHAPES[_name]).numel()) / FPS


def unpack(state: Tensor) -> dict[str, Tensor]:
    """Returns the parts of states (..., 339) by name, each (..., *SHAPES[name]); views, rotations upright again."""
    check_shape(state, f"... {STATE}", "state")
    parts = {name: state[..., SLICES[name]].unflatten(-1, shape) for name, shape in SHAPES.items()}
    return {name: part.mT if name in TURNED else part for name, part in parts.items()}


def pack(parts: Mapping[str, Tensor]) -> Tensor:
    """Computes states (..., 339) from their parts; rotations as they are, not transposed."""
    for name, shape in SHAPES.items():
        check_shape(parts[name], "... " + " ".join(map(str, shape)), name)
    upright = {**parts, **{name: parts[name].mT for name in TURNED}}
    return torch.cat([upright[name].flatten(-len(shape)) for name, shape in SHAPES.items()], dim=-1)


def from_motion(motion: Motion, *, causal: bool = False) -> Tensor:
    """Computes world states (..., T, 339) from a motion on the 22 joints.

    Velocities by central differences, as in HuMoR's states: they know the next frame. causal: by backward differences,
    which know the past only; the first frame has those of the second.
    """
    rate = backward_velocity if causal else velocity
    positions, _ = motion.world
    check_shape(positions, "... 22 3", "joints")
    root = motion.rot[..., 0, :, :]
    return pack({
        "trans": motion.root, "trans_vel": rate(motion.root, motion.fps, dim=-2),
        "root_orient": root,
        "root_orient_vel": _turning(root, motion.fps) if causal else angular_velocity(root, motion.fps),
        "pose_body": motion.rot[..., 1:, :, :],
        "joints": positions, "joints_vel": rate(positions, motion.fps, dim=-3),
    })  # fmt: skip


def _turning(orientation: Tensor, fps: float) -> Tensor:
    """The vector of R_t R_{t-1}^T, rad/s (..., T, 3); the first is the second's, of one frame 0."""
    turn = rotation.log(orientation[..., 1:, :, :] @ orientation[..., :-1, :, :].mT) * fps
    return torch.cat((turn[..., :1, :], turn), -2) if turn.shape[-2] else torch.zeros_like(orientation[..., 0])


def angular_velocity(orientation: Tensor, fps: float) -> Tensor:
    """Computes the vector of dR/dt R^T, rad/s (..., T, 3), world axes, from orientations (..., T, 3, 3)."""
    return rotation.unskew(velocity(orientation, fps, dim=-3) @ orientation.mT)


def to_motion(state: Tensor, skeleton: Skeleton, fps: float = 30.0) -> Motion:
    """Returns the motion that states (..., T, 339) describe by root and angles; their ``joints`` play no part."""
    parts = unpack(state)
    rot = torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), dim=-3)
    return Motion(skeleton, parts["trans"], rot, fps)


def heading(state: Tensor) -> Frame:
    """Computes the heading frame (...) of states (..., 339): on the floor below ``trans``, the body facing +y."""
    return heading_frame(state[..., SLICES["trans"]], state[..., SLICES["root_orient"]].unflatten(-1, (3, 3)).mT)


def localise(state: Tensor, frame: Frame) -> Tensor:
    """Computes states (..., 339) in the coordinates of a frame (...).

    trans -> A (t + s), joints -> A (j + s), velocities and root orientation are turned by A, the pose stays.
    """
    vectors, rest = _vectors(state)
    moved = (vectors + _PLACED.to(state) * frame.shift[..., None, :]) @ frame.turn.mT
    return torch.cat((moved.flatten(-2), rest), -1)


def globalise(state: Tensor, frame: Frame) -> Tensor:
    """Computes world states (..., 339) from those in a frame: the inverse of :func:`localise`."""
    vectors, rest = _vectors(state)
    moved = vectors @ frame.turn - _PLACED.to(state) * frame.shift[..., None, :]
    return torch.cat((moved.flatten(-2), rest), -1)


def _vectors(state: Tensor) -> tuple[Tensor, Tensor]:
    """The 50 vectors (..., 50, 3) that a heading turns, the rows of the transposed root orientation among them, and the
    rest (..., 189)."""
    check_shape(state, f"... {STATE}", "state")
    return state[..., :VECTORS].unflatten(-1, (-1, 3)), state[..., VECTORS:]


def transition_pairs(states: Tensor) -> tuple[Tensor, Tensor]:
    """Computes the states before and after all transitions of world states (..., T, 339): two (..., T - 1, 339), both
    in the frame of the one before."""
    past, now = states[..., :-1, :], states[..., 1:, :]
    frame = heading(past)
    return localise(past, frame), localise(now, frame)


def bone_lengths(state: Tensor) -> Tensor:
    """Computes the distances (..., 21) of the joints of states (..., 339) from their parents, metres."""
    joints = unpack(state)["joints"]
    return (joints[..., 1:, :] - joints[..., list(STANDARD.parents[1:]), :]).norm(dim=-1)


def apply(state: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
    """Computes one transition: the next states (..., 339) and contact logits (..., 9), from changes (..., 216).

    Additive, but for rotations: R' = exp(delta) R, multiplied from the left.
    """
    added, turns, logits = raw.split((ADDED, CHANGES - ADDED, CONTACTS), -1)
    matrices = state[..., ADDED:].unflatten(-1, (-1, 3, 3)) @ rotation.exp(turns.unflatten(-1, (-1, 3))).mT
    return torch.cat((state[..., :ADDED] + added, matrices.flatten(-3)), -1), logits
