"""Euler angles and turns about one coordinate axis; ``motionlab.rotation`` offers them too."""

from __future__ import annotations

import math

import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from torch import Tensor

from motionlab.errors import check_shape


def rotation_about(axis: str, angle: Tensor) -> Tensor:
    """Rotation by ``angle`` (...) radians about one coordinate axis "x", "y" or "z": (..., 3, 3)."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    cos, sin, o = angle.cos(), angle.sin(), torch.zeros_like(angle)
    entries = {(i, i): o + 1, (j, j): cos, (k, k): cos, (j, k): -sin, (k, j): sin}
    rows = [entries.get((row, column), o) for row in range(3) for column in range(3)]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def euler_to_matrix(angles: Tensor, order: str) -> Tensor:
    """Intrinsic angles (..., n) in radians about the axes named in ``order``, as "ZXY": matrix (..., 3, 3).

    R = R_order[0](angles[0]) R_order[1](angles[1]) ..., the order of BVH channels. Any number of axes.
    """
    check_shape(angles, f"... {len(order)}", "angles")
    matrix = torch.eye(3, dtype=angles.dtype, device=angles.device).expand(*angles.shape[:-1], 3, 3)
    for axis, angle in zip(order, angles.unbind(-1), strict=True):
        matrix = matrix @ rotation_about(axis.lower(), angle)
    return matrix


def matrix_to_euler(matrix: Tensor, order: str) -> Tensor:
    """Matrix (..., 3, 3) to intrinsic angles (..., 3) in radians; see :func:`euler_to_matrix`.

    The middle angle lies in [-pi/2, pi/2] for three different axes ("ZXY") and in [0, pi] where the first
    returns ("ZXZ"); the others in [-pi, pi]. In gimbal lock only the sum or difference of the outer two is
    defined: the third is then 0.

    Source: Bernardes & Viollet 2022, "Quaternion to Euler angles conversion".
    Raises:
        ValueError: not one of the twelve orders.
    """
    check_shape(matrix, "... 3 3", "matrix")
    order = order.lower()
    if len(order) != 3 or set(order) - set("xyz") or order[1] in (order[0], order[2]):
        raise ValueError(f"order: expected three axes, neighbours different, as ZXY; got {order!r}")
    k, j, i = ("xyz".index(axis) for axis in order)
    proper = i == k
    k = 3 - i - j if proper else k
    sign = (i - j) * (j - k) * (k - i) // 2
    w, *xyz = rotation_matrix_to_quaternion(matrix).unbind(-1)
    a, b, c, d = w, xyz[i], xyz[j], xyz[k] * sign
    if not proper:
        a, b, c, d = a - c, b + d, c + a, d - b
    middle = 2 * torch.atan2(torch.hypot(c, d), torch.hypot(a, b))
    half_sum, half_difference = torch.atan2(b, a), torch.atan2(d, c)
    near = 8 * torch.finfo(matrix.dtype).eps
    low, high = torch.hypot(c, d) < near, torch.hypot(a, b) < near
    first = torch.where(high, half_difference, half_sum) + torch.where(low, half_sum, half_difference)
    third = torch.where(low | high, 0.0, half_sum - half_difference)
    if not proper:
        first, middle = first * sign, middle - math.pi / 2
    first, third = (x - math.tau * (x / math.tau).round() for x in (first, third))
    return torch.stack((first, middle, third), -1)
