"""Contact labels: which joints touch the floor, from heights in metres and speeds in metres per second."""

from dataclasses import replace

import torch
from torch import Tensor

from motionlab.errors import ShapeError, check_shape
from motionlab.motion import Motion, velocity
from motionlab.skeleton import FEET, Skeleton

#: Metres from the joint's centre down to the skin when the body rests on it; the feet's come from the skeleton.
FLESH = {"pelvis": 0.11, "left_knee": 0.06, "right_knee": 0.06, "left_wrist": 0.04, "right_wrist": 0.04}


def resting_heights(skeleton: Skeleton) -> Tensor:
    """Computes from a skeleton how high each contact joint lies while it touches the floor: (..., C) metres.

    A joint of the foot: its height in the rest pose (ankle about 8 cm, ball 1 cm). Others: ``FLESH``.

    Raises:
        KeyError: a contact joint is neither a foot joint nor in ``FLESH``.
    """
    up = skeleton.rest_positions()[..., 1]
    above = up - up.amin(-1, keepdim=True) + skeleton.sole
    names = skeleton.contact_names
    columns = [above[..., skeleton.index(n)] if n in FEET else torch.full_like(above[..., 0], FLESH[n]) for n in names]
    return torch.stack(columns, -1) if names else above[..., :0]


def _hysteresis(on: Tensor, off: Tensor) -> Tensor:
    """Runs of not ``off`` in time that hold at least one ``on``: bool (..., T, C), as both."""
    run = off.long().cumsum(-2)  # which one a frame is in; one that is off begins the next
    held = run.new_zeros(*run.shape[:-2], run.shape[-2] + 1, run.shape[-1])
    held.scatter_reduce_(-2, run, (on & ~off).long(), "amax")
    return held.gather(-2, run).bool() & ~off


def contacts_from_positions(
    positions: Tensor, fps: float, resting: Tensor | float, *, height: tuple[float, float] = (0.03, 0.06),
    speed: tuple[float, float] = (0.25, 0.5),
) -> Tensor:  # fmt: skip
    """Computes contact labels (..., T, C), 0 or 1, from joint positions (..., T, C, 3) in metres, world, z up.

    A contact is a run of frames below both loose thresholds that goes below both strict ones at least once.

    Args:
        resting: (C,) or (..., 1, C) height in metres of each joint while it touches; see :func:`resting_heights`.
        height: strict and loose bound on the height above ``resting``, metres.
        speed: strict and loose bound on the speed (``motion.velocity``), metres per second.

    Raises:
        ShapeError: fewer than two frames, which have no speed.
    """
    if (frames := check_shape(positions, "... T C 3", "positions")["T"]) < 2:
        raise ShapeError(f"positions: {frames} frames have no speed; contacts need at least 2")
    above = positions[..., 2] - resting
    moving = torch.linalg.vector_norm(velocity(positions, fps, dim=-3), dim=-1)
    on = (above < height[0]) & (moving < speed[0])
    off = (above > height[1]) | (moving > speed[1])
    return _hysteresis(on, off).to(positions.dtype)


def with_contacts(motion: Motion) -> Motion:
    """Labels a motion's contacts from its own joint positions, by :func:`contacts_from_positions`."""
    positions = motion.positions[..., motion.skeleton.contact_indices, :]
    resting = resting_heights(motion.skeleton).to(positions)
    return replace(motion, contacts=contacts_from_positions(positions, motion.fps, resting))
