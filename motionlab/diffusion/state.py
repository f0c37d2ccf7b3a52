"""What a network is shown of a motion: a redundant state, from which nobody has to learn forward kinematics.

A row per frame: the root's place; 6-D rotations; where the joints are in the frame's own heading frame, and how fast
they move there; how fast the root moves and turns there; contacts. What is made is the first two and the last.

Source: HuMoR (Rempe et al. 2021), HumanML3D (Guo et al. 2022), whose states are redundant, too. Thesis 4.1.2 has root,
6-D rotations and contacts alone.
"""

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError
from motionlab.heading import heading_frame
from motionlab.motion import Motion, backward_velocity
from motionlab.skeleton import STANDARD

_J, _C = len(STANDARD), len(STANDARD.contact_names)
_SIZES = {"root": 3, "rot": 6 * _J, "places": 3 * _J, "moves": 3 * _J, "root moves": 3, "turns": 1, "contacts": _C}
SIZE, MADE = sum(_SIZES.values()), 3 + 6 * _J + _C
MADE_AT = [*range(3 + 6 * _J), *range(SIZE - _C, SIZE)]  # where in a state what is made stands
UNITS = _J + 2  # of a frame: the joints' rotations, the root's place, contacts


def rows(motion: Motion) -> Tensor:
    """Computes the state (..., T, ``SIZE``) of a motion on the 22 joints, in the frame that it is in.

    Raises:
        DataError: a motion without contacts.
    """
    if motion.contacts is None:
        raise DataError("a motion without contacts", place=motion.name, remedy="contact.with_contacts labels it")
    frame = heading_frame(motion.root, motion.rot[..., 0, :, :])
    turn, places = frame.turn, motion.positions
    moves = backward_velocity(places, motion.fps, dim=-3)
    turned = backward_velocity(rotation.yaw(motion.rot[..., 0, :, :])[..., None], 1.0, dim=-2)
    parts = (
        motion.root, rotation.matrix_to_sixd(motion.rot).flatten(-2),
        ((places + frame.shift[..., None, :]) @ turn.mT).flatten(-2), (moves @ turn.mT).flatten(-2),
        (moves[..., :1, :] @ turn.mT)[..., 0, :], torch.atan2(turned.sin(), turned.cos()) * motion.fps,
        motion.contacts.to(motion.root),
    )  # fmt: skip
    return torch.cat(parts, -1)


def made(motion: Motion) -> Tensor:
    """Computes of a motion the numbers (..., T, ``MADE``) that a network makes: root, 6-D rotations, contacts."""
    return torch.cat((motion.root, rotation.matrix_to_sixd(motion.rot).flatten(-2), motion.contacts), -1)


def motion_of(numbers: Tensor, like: Motion) -> Motion:
    """Computes the motion of numbers (..., T, ``MADE``), on the body and at the rate of another; contacts as they are
    (0 to 1)."""
    root, sixd, contacts = numbers.split((3, 6 * _J, _C), -1)
    rot = rotation.sixd_to_matrix(sixd.unflatten(-1, (_J, 6)))
    return Motion(like.skeleton, root, rot, like.fps, contacts, like.name)


def owners() -> Tensor:
    """Computes the unit that each number made (``MADE``,) belongs to: a joint, ``_J`` the root, ``_J + 1`` contacts."""
    sizes = torch.tensor([6] * _J + [3, _C])
    every = torch.arange(UNITS).repeat_interleave(sizes)
    return torch.cat((every[6 * _J : 6 * _J + 3], every[: 6 * _J], every[6 * _J + 3 :]))


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
