"""How far human joints turn, by how much a motion exceeds it, and how thick the body is around them.

The ranges (degrees, for both sides alike) are our own choice: wider than what is usually tabulated (narrower only for
the bending of elbow and wrist), because a joint centre of a 22-joint skeleton stands for several real joints (ankle
and subtalar; scapula and collar; a handful of vertebrae) and because some people are more supple than the average.
Usual values: hip flexion 125, hyperextension 15, abduction 45, rotation 45 each way; knee flexion 130; ankle plantar
flexion 50, dorsiflexion 20, inversion 35; toe extension 80; shoulder extension 50; elbow flexion 160; pronation and
supination 90; wrist flexion 90, extension 70. Under load with the knee bent the ankle dorsiflexes by 39 in the mean.
Spine, neck, collar and the cross-body reach of the arm have no table behind them.
Source: Merck Manual, "Normal Values for Range of Motion of Joints" (2013); for the ankle under load "The influence
of knee position on ankle dorsiflexion", BMC Musculoskeletal Disorders 15:246, 2014 (95 % interval of the mean
36 - 42: ours is 42).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.skeleton import Skeleton


@dataclass(frozen=True)
class Range:
    """An angle of a joint: from low to high, in degrees."""

    joint: str
    angle: str
    low: float
    high: float


#: joint (left and right stand under one name), angle, degrees.
LIMITS = tuple(
    Range(*row)
    for row in (
        ("hip", "flexion", -32, 135),
        ("hip", "abduction", -40, 60),
        ("hip", "rotation", -55, 55),
        ("knee", "flexion", -2, 155),
        ("knee", "off hinge", 0, 1),
        ("ankle", "dorsiflexion", -65, 42),
        ("ankle", "inversion", -35, 40),
        ("ankle", "rotation", -40, 40),
        ("foot", "extension", -45, 80),
        ("spine1", "flexion", -20, 35),
        ("spine1", "bend", -20, 20),
        ("spine1", "twist", -20, 20),
        ("spine2", "flexion", -20, 35),
        ("spine2", "bend", -20, 20),
        ("spine2", "twist", -20, 20),
        ("spine3", "flexion", -20, 35),
        ("spine3", "bend", -20, 20),
        ("spine3", "twist", -20, 20),
        ("neck", "flexion", -35, 35),
        ("neck", "bend", -25, 25),
        ("neck", "twist", -40, 40),
        ("head", "flexion", -35, 35),
        ("head", "bend", -25, 25),
        ("head", "twist", -40, 40),
        ("collar", "elevation", -12, 45),
        ("collar", "protraction", -20, 30),
        ("shoulder", "extension", -180, 65),
        ("shoulder", "adduction", -180, 60),
        ("shoulder", "rotation", -100, 100),
        ("elbow", "flexion", -2, 155),
        ("elbow", "off hinge", 0, 1),
        ("wrist", "pronation", -90, 90),
        ("wrist", "flexion", -80, 80),
    )
)


#: Thickness of the body around joints that may lie on the floor, metres.
RADIUS = {
    "pelvis": 0.095, "left_hip": 0.085, "right_hip": 0.085, "spine1": 0.09, "spine2": 0.095, "spine3": 0.10,
    "neck": 0.06, "head": 0.085, "left_shoulder": 0.06, "right_shoulder": 0.06, "left_elbow": 0.04,
    "right_elbow": 0.04, "left_wrist": 0.03, "right_wrist": 0.03, "left_knee": 0.05, "right_knee": 0.05,
    "left_ankle": 0.04, "right_ankle": 0.04,
}  # fmt: skip


def height_at_rest(skeleton: Skeleton, name: str) -> float:
    """Height of a contact joint that bears on the floor, metres: feet and ankles flat, others their thickness."""
    if name.endswith("foot"):
        return skeleton.sole
    if name.endswith("ankle"):
        return skeleton.sole - float(skeleton.offsets[..., skeleton.index(name.replace("ankle", "foot")), 1])
    return RADIUS[name]


def angles(skeleton: Skeleton, rot: Tensor) -> dict[tuple[str, str], Tensor]:
    """Clinical angles (...) in degrees of local rotations (..., J, 3, 3): keys (joint name with side, angle).

    Hip and shoulder: direction of the bone, then the rotation about it against the least rotation that brings
    the hanging bone there. Knee and elbow: about the hinge, and how far the rotation is from any about it.
    """
    found = {}
    for joint in skeleton.names[1:]:
        part = joint.removeprefix("left_").removeprefix("right_")
        sign = -1.0 if joint.startswith("right_") else 1.0
        R = rot[..., skeleton.index(joint), :, :]
        for angle, value in _OF[part](R, sign).items():
            found[joint, angle] = torch.rad2deg(value)
    return found


def excess(skeleton: Skeleton, rot: Tensor) -> dict[tuple[str, str], Tensor]:
    """Degrees (...) by which each angle lies outside its range; 0 inside."""
    measured = angles(skeleton, rot)
    beyond = {}
    for limit in LIMITS:
        for joint in (limit.joint, f"left_{limit.joint}", f"right_{limit.joint}"):
            if (joint, limit.angle) in measured:
                value = measured[joint, limit.angle]
                beyond[joint, limit.angle] = torch.maximum(limit.low - value, value - limit.high).clamp(min=0)
    return beyond


def _xyz(R: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Angles of R = Rx(a) Ry(b) Rz(c)."""
    return (
        torch.atan2(-R[..., 1, 2], R[..., 2, 2]),
        torch.asin(R[..., 0, 2].clamp(-1, 1)),
        torch.atan2(-R[..., 0, 1], R[..., 0, 0]),
    )


def _twist(R: Tensor, hanging: Tensor) -> Tensor:
    """Rotation about the bone of R against the least rotation of the frame ``hanging`` (bone along -y) to it.

    hanging (3, 3): world from bone axes, of the limb that hangs; its columns permute the axes so that the
    bone's own direction is the image of -y.
    """
    down = torch.tensor([0.0, -1.0, 0.0], dtype=R.dtype)
    own = hanging.mT @ down
    way = (R @ own[:, None])[..., 0]
    cross = torch.linalg.cross(down.expand_as(way), way, dim=-1)
    dot = (way @ down)[..., None, None]
    zero = torch.zeros_like(cross[..., 0])
    x, y, z = cross.unbind(-1)
    skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(R.shape)
    swing = torch.eye(3, dtype=R.dtype) + skew + skew @ skew / (1 + dot).clamp(min=1e-6)
    rest = swing.mT @ R @ hanging.mT  # a rotation about -y
    return torch.atan2(rest[..., 0, 2], rest[..., 0, 0])


def _hip(R: Tensor, sign: float) -> dict[str, Tensor]:
    x, y, z = (-R[..., :, 1]).unbind(-1)
    rotation = -sign * _twist(R, torch.eye(3, dtype=R.dtype))
    return {"flexion": torch.atan2(z, -y), "abduction": torch.asin((sign * x).clamp(-1, 1)), "rotation": rotation}


def _knee(R: Tensor, sign: float) -> dict[str, Tensor]:
    off = R[..., 1:, 0].norm(dim=-1).clamp(max=1).asin()
    return {"flexion": torch.atan2(R[..., 2, 1], R[..., 1, 1]), "off hinge": off}


def _elbow(R: Tensor, sign: float) -> dict[str, Tensor]:
    off = R[..., ::2, 1].norm(dim=-1).clamp(max=1).asin()
    return {"flexion": -sign * torch.atan2(R[..., 0, 2], R[..., 0, 0]), "off hinge": off}


def _ankle(R: Tensor, sign: float) -> dict[str, Tensor]:
    a, b, c = _xyz(R)
    return {"dorsiflexion": -a, "inversion": sign * c, "rotation": sign * b}


def _toes(R: Tensor, sign: float) -> dict[str, Tensor]:
    return {"extension": -_xyz(R)[0]}


def _axial(R: Tensor, sign: float) -> dict[str, Tensor]:
    a, b, c = _xyz(R)
    return {"flexion": a, "bend": c, "twist": b}


def _collar(R: Tensor, sign: float) -> dict[str, Tensor]:
    x, y, z = (sign * R[..., :, 0]).unbind(-1)
    return {"elevation": torch.asin(y.clamp(-1, 1)), "protraction": torch.atan2(z, sign * x)}


def _shoulder(R: Tensor, sign: float) -> dict[str, Tensor]:
    x, _, z = (sign * R[..., :, 0]).unbind(-1)
    hanging = torch.tensor([[0.0, sign, 0.0], [-sign, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=R.dtype)
    return {
        "extension": torch.asin((-z).clamp(-1, 1)),
        "adduction": torch.asin((-sign * x).clamp(-1, 1)),
        "rotation": sign * _twist(R, hanging),
    }


def _wrist(R: Tensor, sign: float) -> dict[str, Tensor]:
    a, _, c = _xyz(R)
    return {"pronation": a, "flexion": c}


_OF = {
    "hip": _hip, "knee": _knee, "ankle": _ankle, "foot": _toes, "elbow": _elbow, "shoulder": _shoulder,
    "collar": _collar, "wrist": _wrist, **dict.fromkeys(("spine1", "spine2", "spine3", "neck", "head"), _axial),
}  # fmt: skip
