"""Rotations: conversions, log/exp, distance, interpolation, averages, and continuity in time.

Convention: active rotations of column vectors, R = R_parent_from_child; radians; quaternions are (w, x, y, z).
kornia does what kornia has. exp and log are our own: the second derivatives of kornia's are off near 0 in float32. Here
both are series in the squared angle where it is small, good to rounding in value and both derivatives.
"""

import math
import warnings

import torch
from kornia.geometry import conversions as kc
from torch import Tensor

from motionlab.errors import check_shape

_SINC = [(-1) ** n / math.factorial(2 * n + 1) for n in range(8)]  # sin(t)/t in powers of t^2
_COSC = [(-1) ** n / math.factorial(2 * n + 2) for n in range(8)]  # (1 - cos t)/t^2
_ASIN = [math.comb(2 * n, n) / (4**n * (2 * n + 1)) for n in range(12)]  # asin(s)/s in powers of s^2


def skew(v: Tensor) -> Tensor:
    """Computes the cross-product matrix (..., 3, 3) of a vector (..., 3): skew(v) u = v x u."""
    check_shape(v, "... 3", "v")
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), dim=-1).unflatten(-1, (3, 3))


def unskew(m: Tensor) -> Tensor:
    """Computes the vector (..., 3) whose ``skew`` is the antisymmetric part of matrices (..., 3, 3)."""
    part = (m - m.mT) / 2
    return torch.stack((part[..., 2, 1], part[..., 0, 2], part[..., 1, 0]), -1)


def exp(tangent: Tensor) -> Tensor:
    """Converts rotation vectors (..., 3) in radians to matrices (..., 3, 3), by Rodrigues' formula.

    R = cos(t) I + sin(t)/t [v]x + (1 - cos(t))/t^2 v v^T,  t = |v|
    """
    check_shape(tangent, "... 3", "tangent")
    t2 = (tangent * tangent).sum(-1)
    small = t2 < 0.25
    inside, t = torch.where(small, t2, 0.0), torch.where(small, 1.0, t2).sqrt()
    a = torch.where(small, _series(_SINC, inside), t.sin() / t)[..., None, None]
    b = torch.where(small, _series(_COSC, inside), (1 - t.cos()) / (t * t))[..., None, None]
    outer = tangent[..., :, None] * tangent[..., None, :]
    eye = torch.eye(3, dtype=tangent.dtype, device=tangent.device)
    return eye + a * skew(tangent) + b * (outer - t2[..., None, None] * eye)


def log(matrix: Tensor) -> Tensor:
    """Converts matrices (..., 3, 3) to rotation vectors (..., 3) with angle in [0, pi]: the inverse of :func:`exp`.

    Derivatives are exact for changes that stay a rotation. At a half turn the vector jumps to its opposite (no
    logarithm is continuous there); the derivative is that of the branch returned.
    """
    q = torch.nn.functional.normalize(matrix_to_quaternion(matrix), dim=-1)
    w, v = q[..., :1], q[..., 1:]  # w >= 0: the vector is 2 atan2(|v|, w) v / |v|
    s2 = _square(v)
    small = s2 < 0.04
    inside, s = torch.where(small, s2, 0.0), torch.where(small, 1.0, s2).sqrt()
    return 2 * v * torch.where(small, _series(_ASIN, inside), torch.atan2(s, w) / s)


def left_jacobian(v: Tensor) -> Tensor:
    """Computes the left Jacobian J (..., 3, 3) of rotation vectors (..., 3): exp(v + dv) = exp(J dv) exp(v).

    J = I + b [v] + c [v]^2, b = (1 - cos t) / t^2, c = (t - sin t) / t^3, t = |v|; where t^2 < 0.01 series.
    """
    squared = v.square().sum(-1)[..., None, None]
    small = squared < 0.01
    s = torch.where(small, 1.0, squared)
    t = s.sqrt()
    b = torch.where(small, 1 / 2 - squared / 24 * (1 - squared / 30 * (1 - squared / 56)), (1 - t.cos()) / s)
    c = torch.where(small, 1 / 6 - squared / 120 * (1 - squared / 42 * (1 - squared / 72)), (t - t.sin()) / (s * t))
    eye = torch.eye(3, dtype=v.dtype, device=v.device)
    return eye + b * skew(v) + c * (v[..., :, None] * v[..., None, :] - squared * eye)


#: The names of the conversions, for readers who do not think of a Lie group.
axis_angle_to_matrix, matrix_to_axis_angle = exp, log


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Converts quaternions (..., 4), w first, any length but zero, to matrices (..., 3, 3)."""
    check_shape(quaternion, "... 4", "quaternion")
    return kc.quaternion_to_rotation_matrix(quaternion)


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Converts matrices (..., 3, 3) to unit quaternions (..., 4), w first, w >= 0."""
    check_shape(matrix, "... 3 3", "matrix")
    q = kc.rotation_matrix_to_quaternion(matrix)
    return torch.where(q[..., :1] < 0, -q, q)


def sixd_to_matrix(sixd: Tensor) -> Tensor:
    """Converts six numbers (..., 6), the first two columns in turn, to matrices (..., 3, 3) by Gram-Schmidt.

    So write Zhou et al. 2019 and HumanML3D. pytorch3d and MDM write the first two rows: of their six numbers the
    transpose of what comes out is the rotation.

    Six numbers that span no plane still give a rotation, without gradient in what is undefined: a zero first vector
    counts as the first axis, a second one that is zero or parallel to it (to 1e-6 rad) as some direction across.
    """
    check_shape(sixd, "... 6", "sixd")
    a, b = sixd[..., :3], sixd[..., 3:]
    a = torch.where(_square(a) == 0, a.new_tensor([1.0, 0.0, 0.0]), a)
    x = a * _square(a).rsqrt()
    z = torch.linalg.cross(x, b, dim=-1)
    z = torch.where(_square(z) <= 1e-12 * _square(b), _perpendicular(x.detach()), z)
    z = z * _square(z).rsqrt()
    y = torch.linalg.cross(z, x, dim=-1)
    return torch.stack((x, y, z), dim=-1)


def matrix_to_sixd(matrix: Tensor) -> Tensor:
    """Converts matrices (..., 3, 3) to their first two columns (..., 6); see :func:`sixd_to_matrix`."""
    check_shape(matrix, "... 3 3", "matrix")
    return matrix.mT[..., :2, :].flatten(-2)


def rotation_about(axis: str, angle: Tensor) -> Tensor:
    """Computes rotations by ``angle`` (...) radians about one coordinate axis "x", "y" or "z": (..., 3, 3)."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    cos, sin, o = angle.cos(), angle.sin(), torch.zeros_like(angle)
    entries = {(i, i): o + 1, (j, j): cos, (k, k): cos, (j, k): -sin, (k, j): sin}
    rows = [entries.get((row, column), o) for row in range(3) for column in range(3)]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def euler_to_matrix(angles: Tensor, order: str) -> Tensor:
    """Converts intrinsic angles (..., n) in radians about the axes of ``order``, as "ZXY", to matrices (..., 3, 3).

    R = R_order[0](angles[0]) R_order[1](angles[1]) ..., the order of BVH channels. Any number of axes.
    """
    check_shape(angles, f"... {len(order)}", "angles")
    matrix = torch.eye(3, dtype=angles.dtype, device=angles.device).expand(*angles.shape[:-1], 3, 3)
    for axis, angle in zip(order, angles.unbind(-1), strict=True):
        matrix = matrix @ rotation_about(axis.lower(), angle)
    return matrix


def matrix_to_euler(matrix: Tensor, order: str) -> Tensor:
    """Converts matrices (..., 3, 3) to intrinsic angles (..., 3) in radians; see :func:`euler_to_matrix`.

    The middle angle lies in [-pi/2, pi/2] for three different axes ("ZXY") and in [0, pi] where the first
    returns ("ZXZ"); the others in [-pi, pi]. In gimbal lock (to 1e-7) only the sum or difference of the outer two is
    defined: the third is then 0. Without gradient.

    Raises:
        ValueError: not one of the twelve orders.
    """
    from scipy.spatial.transform import Rotation

    check_shape(matrix, "... 3 3", "matrix")
    turns = Rotation.from_quat(matrix_to_quaternion(matrix).reshape(-1, 4).numpy(force=True), scalar_first=True)
    with warnings.catch_warnings(action="ignore"):  # of gimbal lock
        angles = torch.from_numpy(turns.as_euler(order.upper())).to(matrix)
    return angles.reshape(*matrix.shape[:-2], 3) + 0.0  # no -0


def geodesic(a: Tensor, b: Tensor) -> Tensor:
    """Computes the angle (...) in [0, pi] between two rotations (..., 3, 3); where they are equal its gradient is 0.

    Good to rounding at tiny angles and near pi, where acos of the trace loses half the digits.
    """
    return torch.linalg.vector_norm(log(a.mT @ b), dim=-1)


def slerp(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """Interpolates a fraction ``weight`` (...) of the way along the shortest path from a to b (..., 3, 3)."""
    return a @ exp(weight[..., None] * log(a.mT @ b))


def nearest(matrix: Tensor) -> Tensor:
    """Computes the rotation (..., 3, 3) nearest to any matrix in the Frobenius norm, U diag(1, 1, det(U V^T)) V^T.

    Where the two smallest singular values cancel, one of the nearest, and its gradient is not finite.
    """
    check_shape(matrix, "... 3 3", "matrix")
    u, _, vt = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vt).sign()
    return torch.cat((u[..., :2], u[..., 2:] * sign[..., None, None]), -1) @ vt


def mean(rotations: Tensor) -> Tensor:
    """Computes the chordal mean (..., 3, 3) of N rotations (..., N, 3, 3): the minimiser of sum |R - R_n|_F^2.

    Of two it is the middle of the shortest path. Where none is best (as of two a half turn apart), one of the best.
    """
    check_shape(rotations, "... N 3 3", "rotations")
    return nearest(rotations.sum(-3))


def rotation_between(a: Tensor, b: Tensor) -> Tensor:
    """Computes the smallest rotation (..., 3, 3) that turns the direction a (..., 3) into b (..., 3).

    Opposite directions have no unique one: then a half turn about some axis at right angles to a.
    """
    a, b = (torch.nn.functional.normalize(x, dim=-1) for x in torch.broadcast_tensors(a, b))
    behind = (a * b).sum(-1, keepdim=True) < 0
    axis = torch.linalg.cross(a, b, dim=-1)
    parallel = _square(axis) < (8 * torch.finfo(a.dtype).eps) ** 2
    axis = torch.nn.functional.normalize(torch.where(parallel, _perpendicular(a.detach()), axis), dim=-1)
    axis = torch.nn.functional.normalize(axis - (axis * a).sum(-1, keepdim=True) * a, dim=-1)
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    half_turn = torch.where(behind[..., None], 2 * axis[..., :, None] * axis[..., None, :] - eye, eye)
    a = torch.where(behind, -a, a)
    cross = skew(torch.linalg.cross(a, b, dim=-1))
    rest = cross @ cross / (1 + (a * b).sum(-1))[..., None, None]
    return (eye + cross + rest) @ half_turn


def yaw(matrix: Tensor) -> Tensor:
    """Computes the heading (...) in (-pi, pi] of a root orientation (..., 3, 3): its angle about z from facing +y.

    The angle from +x to the body's right axis, -R[:, 0], on the floor: 0 for ``skeleton.UPRIGHT``, growing to
    the left. A body whose right axis is vertical (lying on its side) has none: 0, with zero gradient.

    Source: HuMoR's canonical frame. Differs: HuMoR takes acos of a clamped cosine.
    """
    check_shape(matrix, "... 3 3", "matrix")
    right_x, right_y = -matrix[..., 0, 0], -matrix[..., 1, 0]
    none = (right_x == 0) & (right_y == 0)
    return torch.atan2(torch.where(none, 0.0, right_y), torch.where(none, 1.0, right_x))


def random(shape: tuple[int, ...], generator: torch.Generator, *, dtype: torch.dtype = torch.float32) -> Tensor:
    """Draws rotations (*shape, 3, 3) uniformly (Haar measure)."""
    q = torch.randn(*shape, 4, generator=generator, dtype=dtype, device=generator.device)
    return quaternion_to_matrix(q)


def unroll_quaternion(quaternion: Tensor, dim: int = -2) -> Tensor:
    """Chooses signs along the time axis ``dim`` so that each quaternion (..., T, 4) is the nearer one to the last."""
    check_shape(quaternion, "... 4", "quaternion")
    q = quaternion.movedim(dim, 0)
    turn = torch.where((q[1:] * q[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(q)
    return torch.cat((q[:1], q[1:] * turn.cumprod(0))).movedim(0, dim).contiguous()


def unroll_axis_angle(aa: Tensor, dim: int = -2) -> Tensor:
    """Chooses of all vectors of each rotation, (|a| + 2 pi k) a/|a|, the one nearest to the frame before, (..., T, 3).

    The first frame stays. No choice is continuous everywhere: when a path that has left the ball of radius pi passes
    near the zero rotation, its axis may swing round in one frame and the vector jump with it. A zero rotation (to
    rounding) takes the axis of the frame before. A cumulative sum unwraps the angles along a sign-continuous axis, then
    k is corrected until no frame has a nearer choice.
    """
    check_shape(aa, "... 3", "axis_angle")
    x = aa.movedim(dim, 0)
    angle = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    known = angle > 8 * torch.finfo(x.dtype).eps
    unit = torch.where(known, x / torch.where(known, angle, 1.0), 0.0)
    sign = torch.where((unit[1:] * unit[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(x).cumprod(0)
    jump = torch.diff(sign * angle[1:], dim=0, prepend=angle[:1]) / math.tau
    signed = angle[1:] - sign * math.tau * jump.round().cumsum(0)
    unrolled = torch.cat((x[:1], unit[1:] * signed))
    for _ in range(len(x)):
        before = unrolled[:-1]
        axis = torch.where(known[1:], unit[1:], torch.nn.functional.normalize(before, dim=-1))
        turns = (((axis * before).sum(-1, keepdim=True) - angle[1:]) / math.tau).round()
        update = torch.cat((x[:1], axis * (angle[1:] + math.tau * turns)))
        if torch.equal(update, unrolled):
            break
        unrolled = update
    return unrolled.movedim(0, dim).contiguous()


def _series(coefficients: list[float], x: Tensor) -> Tensor:
    total = torch.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total


def _square(x: Tensor) -> Tensor:
    return (x * x).sum(-1, keepdim=True)


def _perpendicular(x: Tensor) -> Tensor:
    """Some vector (..., 3) at right angles to a unit vector, not short: y or z axis crossed with it."""
    u, v, w = x.unbind(-1)
    o = torch.zeros_like(u)
    return torch.where((v.abs() < 0.8)[..., None], torch.stack((w, o, -u), -1), torch.stack((-v, u, o), -1))
