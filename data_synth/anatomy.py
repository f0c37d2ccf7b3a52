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

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.skeleton import Skeleton

#: joint (left and right stand under one name) -> angle -> from low to high, degrees.
LIMITS: dict[str, dict[str, tuple[float, float]]] = {
    "hip": {"flexion": (-32, 135), "abduction": (-40, 60), "rotation": (-55, 55)},
    "knee": {"flexion": (-2, 155), "off hinge": (0, 1)},
    "ankle": {"dorsiflexion": (-65, 42), "inversion": (-35, 40), "rotation": (-40, 40)},
    "foot": {"extension": (-45, 80)},
    **{f"spine{k}": {"flexion": (-20, 35), "bend": (-20, 20), "twist": (-20, 20)} for k in (1, 2, 3)},
    **{name: {"flexion": (-35, 35), "bend": (-25, 25), "twist": (-40, 40)} for name in ("neck", "head")},
    "collar": {"elevation": (-12, 45), "protraction": (-20, 30)},
    "shoulder": {"extension": (-180, 65), "adduction": (-180, 60), "rotation": (-100, 100)},
    "elbow": {"flexion": (-2, 155), "off hinge": (0, 1)},
    "wrist": {"pronation": (-90, 90), "flexion": (-80, 80)},
}
#: How far the heel lies behind the ankle, and the tip of the toes in front of the ball joint, metres.
HEEL, TOES = 0.05, 0.06
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


def clearance(skeleton: Skeleton, positions: Tensor, orientations: Tensor) -> Tensor:
    """Metres (..., points) above the floor, of the body around the joints of RADIUS, and of each heel, toe and ball.

    positions (..., J, 3), orientations (..., J, 3, 3): of the joints, world.
    """
    heights = positions[..., 2]
    above = list((heights[..., skeleton.indices(list(RADIUS))] - heights.new_tensor(list(RADIUS.values()))).unbind(-1))
    for side in ("left", "right"):
        ankle, ball = skeleton.index(f"{side}_ankle"), skeleton.index(f"{side}_foot")
        heel = heights.new_tensor([0.0, float(skeleton.offsets[..., ball, 1]) - skeleton.sole, -HEEL])
        toes = heights.new_tensor([0.0, -skeleton.sole, TOES])
        above.append(heights[..., ankle] + orientations[..., ankle, 2, :] @ heel)
        above.append(heights[..., ball] + orientations[..., ball, 2, :] @ toes)
        above.append(heights[..., ball] - skeleton.sole)
    return torch.stack(above, -1)


def angles(skeleton: Skeleton, rot: Tensor) -> dict[tuple[str, str], Tensor]:
    """Clinical angles (...) in degrees of local rotations (..., J, 3, 3): keys (joint name with side, angle).

    Hip and shoulder: direction of the bone, then the rotation about it against the least rotation that brings
    the hanging bone there. Knee and elbow: about the hinge, and how far the rotation is from any about it.
    """
    found = {}
    for joint in skeleton.names[1:]:
        sign = -1.0 if joint.startswith("right_") else 1.0
        measured = _angles(joint.rpartition("_")[2], rot[..., skeleton.index(joint), :, :], sign)
        found |= {(joint, angle): torch.rad2deg(value) for angle, value in measured.items()}
    return found


def excess(skeleton: Skeleton, rot: Tensor) -> dict[tuple[str, str], Tensor]:
    """Degrees (...) by which each angle lies outside its range; 0 inside."""
    measured, beyond = angles(skeleton, rot), {}
    for part, ranges in LIMITS.items():
        for angle, (low, high) in ranges.items():
            for key in ((joint, angle) for joint in (part, f"left_{part}", f"right_{part}")):
                if key in measured:
                    beyond[key] = torch.maximum(low - measured[key], measured[key] - high).clamp(min=0)
    return beyond


def _twist(R: Tensor, hanging: Tensor) -> Tensor:
    """Rotation about the bone of R against the least rotation of the frame ``hanging`` (bone along -y) to it.

    hanging (3, 3): world from bone axes, of the limb that hangs; its columns permute the axes so that the
    bone's own direction is the image of -y.
    """
    down = torch.tensor([0.0, -1.0, 0.0], dtype=R.dtype)
    own = hanging.mT @ down
    way = (R @ own[:, None])[..., 0]
    skew = rotation.skew(torch.linalg.cross(down.expand_as(way), way, dim=-1))
    dot = (way @ down)[..., None, None]
    swing = torch.eye(3, dtype=R.dtype) + skew + skew @ skew / (1 + dot).clamp(min=1e-6)
    rest = swing.mT @ R @ hanging.mT  # a rotation about -y
    return torch.atan2(rest[..., 0, 2], rest[..., 0, 0])


def _angles(part: str, R: Tensor, sign: float) -> dict[str, Tensor]:
    """Angles (...), radians, of the local rotations of a joint; sign: -1 on the right side."""
    if part in ("hip", "collar", "shoulder"):  # by the direction of the bone
        x, y, z = (-R[..., :, 1] if part == "hip" else sign * R[..., :, 0]).unbind(-1)
        if part == "hip":
            twist = -sign * _twist(R, torch.eye(3, dtype=R.dtype))
            return {"flexion": torch.atan2(z, -y), "abduction": (sign * x).clamp(-1, 1).asin(), "rotation": twist}
        if part == "collar":
            return {"elevation": y.clamp(-1, 1).asin(), "protraction": torch.atan2(z, sign * x)}
        hanging = torch.tensor([[0.0, sign, 0.0], [-sign, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=R.dtype)
        extension, adduction = (way.clamp(-1, 1).asin() for way in (-z, -sign * x))
        return {"extension": extension, "adduction": adduction, "rotation": sign * _twist(R, hanging)}
    if part == "knee":
        off = R[..., 1:, 0].norm(dim=-1).clamp(max=1).asin()
        return {"flexion": torch.atan2(R[..., 2, 1], R[..., 1, 1]), "off hinge": off}
    if part == "elbow":
        off = R[..., ::2, 1].norm(dim=-1).clamp(max=1).asin()
        return {"flexion": -sign * torch.atan2(R[..., 0, 2], R[..., 0, 0]), "off hinge": off}
    a, b = torch.atan2(-R[..., 1, 2], R[..., 2, 2]), R[..., 0, 2].clamp(-1, 1).asin()  # R = Rx(a) Ry(b) Rz(c)
    c = torch.atan2(-R[..., 0, 1], R[..., 0, 0])
    return {
        "ankle": {"dorsiflexion": -a, "inversion": sign * c, "rotation": sign * b},
        "foot": {"extension": -a},
        "wrist": {"pronation": a, "flexion": c},
    }.get(part, {"flexion": a, "bend": c, "twist": b})  # the spine's, neck and head with it
