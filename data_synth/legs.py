"""Two-bone inverse kinematics in closed form, and the foot that rolls over heel and ball."""

from functools import partial

import torch
from torch import Tensor
from torch.nn import functional

from data_synth.anatomy import HEEL
from data_synth.curves import soft_clip
from motionlab.rotation import rotation_about
from motionlab.skeleton import UPRIGHT

unit = partial(functional.normalize, dim=-1)  # x over its length


def two_bone(
    start: Tensor, target: Tensor, hinge: Tensor, upper: float, lower: float, ease: float | Tensor = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Middle and end joint of a two-bone limb that reaches for a target.

    The limb lies in the plane through start and target across ``hinge``; the middle joint lies towards
    u x hinge, u the direction to the target: forward for a leg whose hinge points left. A target beyond
    99.8 % of the limb's length is approached smoothly, and one nearer than the most bent limb likewise. The hinge
    (..., 3) need not be unit nor orthogonal.

    Returns:
        directions of the upper and of the lower bone (..., 3), unit hinge (..., 3).
    Source: law of cosines.
    """
    line = target - start
    u = unit(line)
    longest, shortest = upper + lower, (upper**2 + lower**2 - 2 * upper * lower * 0.82) ** 0.5
    reach = torch.linalg.vector_norm(line, dim=-1)
    reach = soft_clip(reach, shortest, 0.9995 * longest, (0.0015 + ease) * longest)
    axis = unit(hinge - (hinge * u).sum(-1, keepdim=True) * u)
    cos = (upper**2 + reach**2 - lower**2) / (2 * upper * reach)
    sin = (1 - cos**2).clamp(min=0).sqrt()
    upper_way = cos[..., None] * u + sin[..., None] * torch.linalg.cross(u, axis, dim=-1)
    lower_way = (reach[..., None] * u - upper * upper_way) / lower
    return upper_way, lower_way, axis


def heading_rotation(yaw: Tensor) -> Tensor:
    """World orientation (..., 3, 3) of an upright body that has turned ``yaw`` radians to its left from +y."""
    return rotation_about("z", yaw) @ UPRIGHT.to(yaw)


def foot_pose(c: dict[str, Tensor], offset: Tensor, sole: float) -> tuple[Tensor, Tensor]:
    """Where a foot is, from its channels (...): the ankle (..., 3), and the orientation of the foot (..., 3, 3).

    Of the flat foot, the floor point under the ankle, its lift and its yaw are given; then the radians by which the
    heel is raised about the ball, and the toes about the heel. Both can be on only in the air; on the floor one of the
    pivots stands still, and nothing goes below it.
    offset (3,): ankle to ball in the rest pose. sole: height of the ball joint over the floor.
    """
    flat, place = heading_rotation(c["foot_yaw"]), torch.stack([c[part] for part in ("foot_x", "foot_y", "lift")], -1)
    toes_up, heel_up = rotation_about("x", -c["toe"]), rotation_about("x", c["heel"])
    up = offset.new_tensor([0.0, 1.0, 0.0])
    height = sole - float(offset[1])
    back = offset.new_tensor([0.0, -height, -HEEL])  # ankle to heel
    heel_point = place + (flat @ (back + height * up)[:, None])[..., 0]
    ball = heel_point + (flat @ toes_up @ (offset - back)[:, None])[..., 0]
    orientation = flat @ toes_up @ heel_up
    return ball - (orientation @ offset[:, None])[..., 0], orientation


def hanging(foot_rot: Tensor, shin_rot: Tensor, free: Tensor) -> Tensor:
    """Orientation (..., 3, 3) of a foot that, where ``free`` is 1, gives way at the ankle before 38 degrees up."""
    local = shin_rot.mT @ foot_rot
    up = torch.atan2(local[..., 1, 2], local[..., 2, 2])
    return foot_rot @ rotation_about("x", free * (up - soft_clip(up, -2.0, 0.66, 0.1)))
