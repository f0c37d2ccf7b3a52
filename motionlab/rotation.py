"""Rotations: conversions, log/exp, distance, interpolation, continuity in time, and averages.

Convention: active rotations of column vectors, R = R_parent_from_child; angles in radians; quaternions
are (w, x, y, z). kornia does what kornia has; what is written here is what it lacks.
"""

from __future__ import annotations

import torch
from kornia.geometry import conversions as kc
from torch import Tensor

from motionlab.errors import check_shape


def axis_angle_to_matrix(aa: Tensor) -> Tensor:
    """Rotation vector (..., 3) in radians to matrix (..., 3, 3)."""
    check_shape(aa, "... 3", "axis_angle")
    return kc.axis_angle_to_rotation_matrix(aa)


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Matrix (..., 3, 3) to unit quaternion (..., 4), w first, w >= 0."""
    check_shape(matrix, "... 3 3", "matrix")
    q = kc.rotation_matrix_to_quaternion(matrix)
    return torch.where(q[..., :1] < 0, -q, q)


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Quaternion (..., 4), w first, any length but zero, to matrix (..., 3, 3)."""
    check_shape(quaternion, "... 4", "quaternion")
    return kc.quaternion_to_rotation_matrix(quaternion)


def matrix_to_axis_angle(matrix: Tensor) -> Tensor:
    """Matrix (..., 3, 3) to rotation vector (..., 3) with angle in [0, pi]."""
    return quaternion_to_axis_angle(matrix_to_quaternion(matrix))


def quaternion_to_axis_angle(quaternion: Tensor) -> Tensor:
    """Unit quaternion (..., 4), w first, to rotation vector (..., 3)."""
    check_shape(quaternion, "... 4", "quaternion")
    return kc.quaternion_to_axis_angle(quaternion)


def axis_angle_to_quaternion(aa: Tensor) -> Tensor:
    """Rotation vector (..., 3) to unit quaternion (..., 4), w first."""
    check_shape(aa, "... 3", "axis_angle")
    return kc.axis_angle_to_quaternion(aa)


def sixd_to_matrix(sixd: Tensor, layout: str = "columns") -> Tensor:
    """Six numbers (..., 6) to the matrix (..., 3, 3) by Gram-Schmidt.

    ``layout="columns"``: the first two columns, one after the other (Zhou et al. 2019; HumanML3D);
    ``"rows"``: the first two rows (pytorch3d, MDM).
    """
    check_shape(sixd, "... 6", "sixd")
    a, b = sixd[..., :3], sixd[..., 3:]
    x = torch.nn.functional.normalize(a, dim=-1)
    y = torch.nn.functional.normalize(b - (x * b).sum(-1, keepdim=True) * x, dim=-1)
    z = torch.linalg.cross(x, y, dim=-1)
    return torch.stack((x, y, z), dim={"columns": -1, "rows": -2}[layout])


def matrix_to_sixd(matrix: Tensor, layout: str = "columns") -> Tensor:
    """Matrix (..., 3, 3) to its first two columns or rows (..., 6); see :func:`sixd_to_matrix`."""
    check_shape(matrix, "... 3 3", "matrix")
    two = {"columns": matrix.mT[..., :2, :], "rows": matrix[..., :2, :]}[layout]
    return two.reshape(*matrix.shape[:-2], 6)


def rotation_about(axis: str, angle: Tensor) -> Tensor:
    """Rotation by ``angle`` (...) radians about one coordinate axis "x", "y" or "z": (..., 3, 3)."""
    i = "xyz".index(axis)
    unit = torch.zeros(3, dtype=angle.dtype, device=angle.device)
    unit[i] = 1
    return axis_angle_to_matrix(angle[..., None] * unit)


def geodesic(a: Tensor, b: Tensor) -> Tensor:
    """Angle (...) in [0, pi] between two rotations (..., 3, 3)."""
    return torch.linalg.vector_norm(matrix_to_axis_angle(a.mT @ b), dim=-1)


def slerp(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """The rotation a fraction ``weight`` (...) of the way along the shortest path from a to b (..., 3, 3)."""
    return a @ axis_angle_to_matrix(weight[..., None] * matrix_to_axis_angle(a.mT @ b))
