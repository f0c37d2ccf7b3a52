"""The official code's conversions between rotation vectors and matrices, and its heading: with their epsilons.

Source: formulas fitted to golden arrays of the official HuMoR code (Rempe et al. 2021): float64 values agree to
rounding on all 68 rotations, those at 0 and at pi too.
Differs: cross products name their axis. The official ones take the first axis of size 3, so that three clips at once
go wrong there.
"""

import torch
from torch import Tensor

GUARD = 1e-6


def axis_angle_to_matrix(aa: Tensor) -> Tensor:
    """Rotation vectors (N, 3) to matrices (N, 3, 3): I + sin(a) K + (1 - cos(a)) K^2 with a = |v + 1e-8|.

    The axis v / a is a unit vector only to 1e-8 / a: tiny rotations are wrong by up to 2e-8.
    """
    angle = torch.norm(aa + 1e-8, dim=1, keepdim=True)
    x, y, z = torch.split(aa / angle, 1, dim=1)
    o = torch.zeros_like(x)
    k = torch.cat((o, -z, y, z, o, -x, -y, x, o), dim=1).view(-1, 3, 3)
    sin, cos = torch.sin(angle).unsqueeze(1), torch.cos(angle).unsqueeze(1)
    return torch.eye(3, dtype=aa.dtype, device=aa.device) + sin * k + (1 - cos) * torch.bmm(k, k)


def alignment(orientation: Tensor) -> Tensor:
    """The yaw rotation (B, 3, 3) that takes the body's right axis, laid on the floor, to +x; by acos.

    Its angle is wrong by 1.3e-3 rad at 1e-4 rad, and facing backwards exactly it does not turn at all.
    """
    right = -orientation[:, :, 0]
    right = torch.cat((right[:, :2], torch.zeros_like(right[:, 2:])), dim=1)
    x_axis = torch.zeros_like(right)
    x_axis[:, 0] = 1.0
    angle = torch.acos(right[:, :1] / (torch.norm(right, dim=1, keepdim=True) + GUARD))
    axis = torch.cross(right, x_axis, dim=-1)
    return axis_angle_to_matrix(axis / (torch.norm(axis, dim=1, keepdim=True) + GUARD) * angle)


def matrix_to_axis_angle(matrix: Tensor) -> Tensor:
    """Rotation vectors (..., 3) of matrices (..., 3, 3), by quaternions; the angle is folded to [0, pi].

    At exactly the identity the vector is right, 0, but its gradient is NaN, as in the official code.
    """
    a, b, c = (matrix[..., i, i] for i in range(3))
    x, y, z = (matrix[..., i, j] - matrix[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    xy, yz, zx = (matrix[..., i, j] + matrix[..., j, i] for i, j in ((0, 1), (1, 2), (2, 0)))
    low, first, second = c < GUARD, a > b, a < -b
    square = (1 + a - b - c, 1 - a + b - c, 1 - a - b + c, 1 + a + b + c)  # four times that of x, y, z, w
    rows = (
        torch.stack((x, square[0], xy, zx), -1),
        torch.stack((y, xy, square[1], yz), -1),
        torch.stack((z, zx, yz, square[2]), -1),
        torch.stack((square[3], x, y, z), -1),
    )
    masks = [m.to(matrix) for m in (low & first, low & ~first, ~low & second, ~low & ~second)]
    size = torch.sqrt(sum(m * s for m, s in zip(masks, square, strict=True)))
    w, *v = (0.5 * sum(m[..., None] * row for m, row in zip(masks, rows, strict=True)) / size[..., None]).unbind(-1)
    v = torch.stack(v, -1)
    sin2 = (v * v).sum(-1)
    sin = torch.sqrt(sin2)
    angle = 2 * torch.where(w < 0, torch.atan2(-sin, -w), torch.atan2(sin, w))
    return v * torch.where(sin2 > 0, angle / sin, 2 * torch.ones_like(sin))[..., None]


def pose_from_axis_angle(aa: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), by the official formula."""
    return axis_angle_to_matrix(aa.reshape(-1, 3)).reshape(*aa.shape, 3)
