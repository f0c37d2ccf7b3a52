"""The floor plane seen from a camera, and the world that it and the first frame define.

A plane (..., 3) is its unit normal times its signed offset, n d, camera coordinates, metres: points with n x = d.
The camera's y axis points down: the floor's normal is the one with n_y <= 0, and d < 0 for a floor below the camera.

Source: HuMoR (Rempe et al. 2021), supplement, and its official code: the floor is 3 numbers of stage 3's variables.
"""

import torch
from torch import Tensor

from motionlab.heading import Frame

#: Where the official code looks for a floor that nobody measured: 0.5 m below the camera.
INITIAL = (0.0, 0.5, 0.0)


def normal_and_offset(floor: Tensor) -> tuple[Tensor, Tensor]:
    """n (..., 3), n_y <= 0, and d (...) of planes (..., 3). A plane through the camera (d = 0) has none: n = 0."""
    size = torch.linalg.vector_norm(floor, dim=-1)
    offset = torch.where(floor[..., 1] > 0, -size, size)
    return floor / torch.where(offset == 0, 1.0, offset)[..., None], offset


def height(floor: Tensor, points: Tensor) -> Tensor:
    """Metres (...) of points (..., 3), camera coordinates, above the plane."""
    normal, offset = normal_and_offset(floor)
    return (normal * points).sum(-1) - offset


def world_frame(floor: Tensor, trans: Tensor, orientation: Tensor) -> Frame:
    """The world (...) in which the plane is z = 0 and the body of the first frame stands at x = y = 0, facing +y.

    x_world = turn (x_camera + shift). Rows of the turn: the body's right laid on the floor, forward, up.

    Args:
        floor: (..., 3). trans (..., 3), orientation (..., 3, 3): of the first frame's root, camera coordinates.
    Differs: none in value; the official code returns -trans and the pelvis's height apart, and shifts z later.
    """
    normal, _ = normal_and_offset(floor)
    right = -orientation[..., 0]
    right = right - (right * normal).sum(-1, keepdim=True) * normal
    right = right / torch.linalg.vector_norm(right, dim=-1, keepdim=True).clamp(min=1e-9)
    turn = torch.stack((right, torch.linalg.cross(normal, right, dim=-1), normal), dim=-2)
    return Frame(turn, height(floor, trans)[..., None] * normal - trans)
