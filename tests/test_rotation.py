import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import roma
import torch
import twins
from kornia.geometry import conversions as kc
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck, gradgradcheck

from motionlab import rotation
from motionlab.errors import ShapeError

GOLDEN = np.load(Path(__file__).parent / "golden" / "humor_rotations.npz")
F64 = torch.float64
ANGLES = (0.0, 1e-12, 1e-6, 1e-3, 0.4, 0.5, 0.6, 2.0, math.pi - 1e-2, math.pi - 1e-6)


def golden(name: str) -> torch.Tensor:
    return torch.as_tensor(GOLDEN[name], dtype=F64)


def directions(count: int, generator: torch.Generator, dtype=F64) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=dtype), dim=-1)


def scipy_matrix(aa: torch.Tensor) -> torch.Tensor:
    return torch.as_tensor(Rotation.from_rotvec(aa.double().numpy()).as_matrix())


def assert_rotations(matrix: torch.Tensor, tolerance: float = 1e-12) -> None:
    eye = torch.eye(3, dtype=matrix.dtype).expand_as(matrix)
    torch.testing.assert_close(matrix @ matrix.mT, eye, atol=tolerance, rtol=0)
    assert (torch.linalg.det(matrix) > 0).all()


@pytest.mark.parametrize("angle", [*ANGLES, math.pi, 4.0, 6.28, 20.0])
def test_exp_agrees_with_scipy_and_roma(generator, angle):
    aa = directions(20, generator) * angle
    torch.testing.assert_close(rotation.exp(aa), scipy_matrix(aa), atol=1e-14, rtol=0)
    torch.testing.assert_close(rotation.exp(aa), roma.rotvec_to_rotmat(aa), atol=1e-12, rtol=0)  # roma: 5e-13 at 1e-6
    torch.testing.assert_close(rotation.exp(aa.float()).double(), scipy_matrix(aa.float()), atol=1e-6, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_log_inverts_exp(generator, angle, dtype):
    aa = directions(20, generator, dtype) * angle
    torch.testing.assert_close(rotation.log(rotation.exp(aa)), aa, atol=20 * torch.finfo(dtype).eps, rtol=0)


@pytest.mark.parametrize("angle", [*ANGLES, math.pi, 4.0, 6.28])
def test_exp_has_two_exact_derivatives(generator, angle):
    aa = (directions(3, generator) * angle).requires_grad_()
    assert gradcheck(rotation.exp, aa)
    assert gradgradcheck(rotation.exp, aa)


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_log_has_two_exact_derivatives_along_rotations(generator, angle):
    start = rotation.exp(directions(3, generator) * angle)
    step = torch.zeros(3, 3, dtype=F64, requires_grad=True)
    assert gradcheck(lambda x: rotation.log(start @ rotation.exp(x)), step)
    assert gradgradcheck(lambda x: rotation.log(start @ rotation.exp(x)), step)


@pytest.mark.parametrize("angle", [math.pi - 1e-6, math.pi])
def test_log_at_pi_has_the_derivative_of_its_branch(generator, angle):
    """Against the closed form of the inverse right Jacobian; Hessian finite and bounded."""
    start = rotation.exp(torch.cat((directions(5, generator), torch.eye(3, dtype=F64))) * angle)
    zero = torch.zeros(8, 3, dtype=F64)
    found = torch.func.jacrev(lambda x: rotation.log(start @ rotation.exp(x)).sum(0))(zero).movedim(1, 0)
    aa = rotation.log(start)
    t, k = aa.norm(dim=-1)[:, None, None], rotation.skew(aa)
    expected = torch.eye(3, dtype=F64) + k / 2 + (1 / t**2 - (1 + t.cos()) / (2 * t * t.sin())) * k @ k
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=0)
    hessian = torch.autograd.functional.hessian(lambda x: rotation.log(start @ rotation.exp(x)).sum(), zero)
    assert hessian.isfinite().all() and hessian.abs().max() < 10


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-8, 1e-4, 0.05, 0.0999, 0.1001, 1.0, 3.1, torch.pi, 5.0])
def test_the_left_jacobian_at_any_angle(generator, size):
    """dR = [J dv] R; by autograd through ours, and by scipy's rotations."""
    v = size * torch.nn.functional.normalize(torch.randn(5, 3, generator=generator, dtype=F64), dim=-1)
    ours = rotation.left_jacobian(v)
    slope = torch.func.jacrev(lambda d: rotation.exp(v + d))(torch.zeros(3, dtype=F64))  # (5, 3, 3, 3 causes)
    claimed = rotation.skew(ours.mT) @ rotation.exp(v)[:, None]  # (5, 3 causes, 3, 3)
    torch.testing.assert_close(claimed, slope.movedim(-1, 1), atol=1e-10, rtol=0)
    way = np.array([0.3, -0.5, 0.8])
    turns = [Rotation.from_rotvec(v.numpy() + s * way) for s in (1e-6, -1e-6)]
    measured = torch.from_numpy((turns[0] * turns[1].inv()).as_rotvec() / 2e-6)
    torch.testing.assert_close(ours @ torch.from_numpy(way), measured, atol=1e-8, rtol=0)
    if size > 0.04:  # control: the right one is its transpose
        assert (ours.mT @ torch.from_numpy(way) - measured).abs().max() > 1e-2


def test_second_derivatives_survive_float32_where_kornia_loses_them(generator):
    """Why exp is not kornia's: if the control fails, kornia has improved and our own may go."""
    weight = torch.randn(3, 3, generator=generator, dtype=F64)
    aa = directions(1, generator)[0] * 1.1e-3

    def hessian(f, x):
        return torch.autograd.functional.hessian(lambda v: (weight.to(x) * f(v)).sum(), x).double()

    exact = hessian(rotation.exp, aa)
    torch.testing.assert_close(hessian(rotation.exp, aa.float()), exact, atol=1e-5, rtol=0)
    assert (hessian(kc.axis_angle_to_rotation_matrix, aa.float()) - exact).abs().max() > 1e-3


def test_golden_humor_axis_angle():
    """HuMoR takes the angle as |aa + 1e-8|, which its results carry: 3e-8 where the angle is not tiny."""
    aa, matrix = golden("rot_aa_in"), golden("rot_mat_from_aa")
    torch.testing.assert_close(rotation.exp(aa), matrix, atol=5e-8, rtol=0)
    near_pi = (rotation.geodesic(matrix, torch.eye(3, dtype=F64)) - math.pi).abs() < 1e-6
    torch.testing.assert_close(rotation.log(matrix)[~near_pi], golden("rot_aa_from_mat")[~near_pi], atol=1e-7, rtol=0)
    back = rotation.exp(golden("rot_aa_from_mat"))
    torch.testing.assert_close(rotation.exp(rotation.log(matrix)), back, atol=1e-7, rtol=0)
    q, expected = rotation.matrix_to_quaternion(matrix), golden("rot_quat_wxyz_from_mat")
    torch.testing.assert_close((q * expected).sum(-1).abs(), torch.ones(68, dtype=F64), atol=1e-7, rtol=0)


def test_golden_humor_axis_angle_gradient():
    aa = golden("rot_aa_in").requires_grad_()
    (golden("rot_grad_weight_mat") * rotation.exp(aa)).sum().backward()
    regular = golden("rot_aa_in").norm(dim=-1) > 1e-3  # the 1e-8 inside HuMoR's norm bends the gradient near zero
    torch.testing.assert_close(aa.grad[regular], golden("rot_grad_aa")[regular], atol=1e-4, rtol=0)
    assert regular.sum() >= 50


def test_golden_humor_sixd_ninedim_and_heading():
    interleaved = golden("rot6d_in").reshape(-1, 3, 2)
    torch.testing.assert_close(rotation.sixd_to_matrix(interleaved.mT.flatten(-2)), golden("rot6d_mat"))
    torch.testing.assert_close(rotation.nearest(golden("rot9d_in").reshape(-1, 3, 3)), golden("rot9d_mat"))
    root, align = golden("rot_mat_from_aa"), golden("w2a_from_root_mat")
    floor, turn = root[:, :2, 0].norm(dim=-1), rotation.yaw(root)
    error = (rotation.rotation_about("z", -turn) - align).abs().amax((-1, -2))
    guard = 5e-6 / (floor * turn.sin().abs())  # HuMoR adds 1e-6 here and there inside its acos
    regular = (floor > 0.1) & (turn.sin().abs() > 0.01)
    assert regular.sum() >= 50 and (error < guard)[regular].all()


def test_quaternions_agree_with_scipy_and_keep_their_sign(generator):
    matrix = rotation.random((200,), generator, dtype=F64)
    q = rotation.matrix_to_quaternion(matrix)
    expected = torch.as_tensor(Rotation.from_matrix(matrix.numpy()).as_quat(canonical=True, scalar_first=True))
    torch.testing.assert_close(q, expected)
    assert (q[:, 0] >= 0).all()
    torch.testing.assert_close(rotation.quaternion_to_matrix(-3 * q), matrix)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 1.0, math.pi])
def test_quaternion_gradients_are_finite(generator, angle):
    aa = (directions(4, generator) * angle).requires_grad_()
    q = rotation.matrix_to_quaternion(rotation.exp(aa))
    for out in (q.sum(), rotation.quaternion_to_matrix(q).sum()):
        (gradient,) = torch.autograd.grad(out, aa, retain_graph=True)
        assert gradient.isfinite().all()


def test_sixd_round_trip(generator):
    matrix = rotation.random((50,), generator, dtype=F64)
    torch.testing.assert_close(rotation.sixd_to_matrix(rotation.matrix_to_sixd(matrix)), matrix)
    rows = matrix[..., :2, :].flatten(-2)  # as pytorch3d writes them
    torch.testing.assert_close(rotation.sixd_to_matrix(rows).mT, matrix)
    assert gradcheck(rotation.sixd_to_matrix, torch.randn(3, 6, generator=generator, dtype=F64).requires_grad_())


@pytest.mark.parametrize(
    "sixd",
    [[0.0] * 6, [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 2, 0], [1, 2, 3, 2, 4, 6], [0, 1, 0, 0, 1, 0], [1, 1, 1, 0, 0, 0],
     [0, 0, 1, 0, 0, -1], [1e-30, 0, 0, 0, 1e-30, 0]],
)  # fmt: skip
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_degenerate_sixd_is_still_a_rotation(sixd, dtype):
    x = torch.tensor(sixd, dtype=dtype, requires_grad=True)
    matrix = rotation.sixd_to_matrix(x)
    assert_rotations(matrix.detach(), 1e-6)
    matrix.sum().backward()
    assert x.grad.isfinite().all()


def test_other_shapes_are_refused():
    with pytest.raises(ShapeError, match="tangent"):
        rotation.axis_angle_to_matrix(torch.zeros(4))


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("angle", [1e-6, 1e-3, 1.0, math.pi - 1e-3, math.pi - 1e-6, math.pi])
def test_geodesic_is_accurate_at_both_ends(generator, angle, dtype):
    a = rotation.random((30,), generator, dtype=dtype)
    b = a @ rotation.exp(directions(30, generator, dtype) * angle)
    error = (rotation.geodesic(a, b) - angle).abs().max()
    assert error < 10 * torch.finfo(dtype).eps
    naive = torch.acos((((a.mT @ b).diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    if dtype == torch.float32 and angle < 1e-2:
        assert (naive - angle).abs().max() > 10 * error  # what the half angle buys
    if angle < 3:  # roma's asin loses digits near pi
        torch.testing.assert_close(rotation.geodesic(a, b), roma.rotmat_geodesic_distance(a, b), atol=2e-6, rtol=0)


def test_geodesic_of_equal_rotations_is_zero_with_zero_gradient(generator):
    a = rotation.random((5,), generator, dtype=F64)
    aa = rotation.log(a).requires_grad_()
    distance = rotation.geodesic(rotation.exp(aa), rotation.exp(aa.detach()))
    distance.sum().backward()
    assert distance.max() < 1e-15 and aa.grad.isfinite().all()


def test_slerp_agrees_with_scipy_and_roma(generator):
    a, b = rotation.random((2, 40), generator, dtype=F64)
    w = torch.rand(40, generator=generator, dtype=F64)
    expected = torch.stack([roma.rotmat_slerp(*pair, one) for *pair, one in zip(a, b, w, strict=True)])
    torch.testing.assert_close(rotation.slerp(a, b, w), expected)
    torch.testing.assert_close(rotation.slerp(a, b, torch.ones(40, dtype=F64)), b)
    torch.testing.assert_close(rotation.geodesic(a, rotation.slerp(a, b, w)), w * rotation.geodesic(a, b))


def test_nearest_projects_as_roma_does(generator):
    matrix = torch.randn(60, 3, 3, generator=generator, dtype=F64)
    assert (torch.linalg.det(matrix) < 0).any()
    torch.testing.assert_close(rotation.nearest(matrix), roma.special_procrustes(matrix))
    assert_rotations(rotation.nearest(torch.zeros(3, 3, dtype=F64)))


def test_mean_agrees_with_scipy_and_roma(generator):
    matrix = rotation.random((6, 9), generator, dtype=F64)
    for row, m in zip(matrix, rotation.mean(matrix), strict=True):
        expected = Rotation.from_matrix(row.numpy()).mean().as_matrix()
        torch.testing.assert_close(m, torch.as_tensor(expected))
    pair = rotation.exp(directions(2, generator))
    torch.testing.assert_close(rotation.mean(pair), rotation.slerp(*pair, torch.tensor(0.5, dtype=F64)))


ORDERS = ["".join(o) for o in itertools.product("XYZ", repeat=3) if o[1] not in (o[0], o[2])]


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_and_back(generator, order):
    matrix = rotation.random((4, 25), generator, dtype=F64)
    angles = rotation.matrix_to_euler(matrix, order)
    torch.testing.assert_close(rotation.euler_to_matrix(angles, order), matrix)
    expected = torch.as_tensor(Rotation.from_euler(order, angles.flatten(0, 1).numpy()).as_matrix())
    torch.testing.assert_close(rotation.euler_to_matrix(angles, order).flatten(0, 1), expected)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("offset", [0.0, 1e-9, 1e-5, 1e-3])
def test_euler_in_gimbal_lock_keeps_the_rotation(generator, order, offset):
    angles = torch.rand(40, 3, generator=generator, dtype=F64) * 6 - 3
    for middle in (0, math.pi) if order[0] == order[2] else (-math.pi / 2, math.pi / 2):
        angles[:, 1] = middle + offset
        matrix = rotation.euler_to_matrix(angles, order)
        found = rotation.matrix_to_euler(matrix, order)
        torch.testing.assert_close(
            rotation.euler_to_matrix(found, order), matrix, atol=1e-14 + 2 * offset * (offset < 1e-7), rtol=0
        )
        if offset == 0:
            assert (found[:, 2] == 0).all()
        single = rotation.euler_to_matrix(rotation.matrix_to_euler(matrix.float(), order), order)
        torch.testing.assert_close(single.double(), matrix, atol=2e-6, rtol=0)


def test_euler_takes_any_number_of_axes_and_refuses_nonsense(generator):
    angle = torch.rand(5, 1, generator=generator, dtype=F64)
    torch.testing.assert_close(rotation.euler_to_matrix(angle, "Y"), rotation.rotation_about("y", angle[:, 0]))
    torch.testing.assert_close(rotation.euler_to_matrix(torch.zeros(5, 0), ""), torch.eye(3).expand(5, 3, 3))
    for order in ("XXY", "XY", "XYW"):
        with pytest.raises(ValueError, match="axes"):
            rotation.matrix_to_euler(torch.eye(3), order)
    with pytest.raises(ShapeError, match="angles"):
        rotation.euler_to_matrix(angle, "XYZ")


def test_random_is_uniform_and_repeats_with_its_seed():
    def draw(seed):
        return rotation.random((20_000,), torch.Generator().manual_seed(seed), dtype=F64)

    matrix = draw(0)
    assert torch.equal(matrix, draw(0)) and not torch.equal(matrix, draw(1))
    assert_rotations(matrix[:100])
    # Haar: every entry has mean 0 and variance 1/3; the angle has density (1 - cos t)/pi. Five standard errors.
    assert matrix.mean(0).abs().max() < 5 / math.sqrt(3 * 20_000)
    assert (matrix.square().mean(0) - 1 / 3).abs().max() < 5 * math.sqrt(4 / 45 / 20_000)
    angle = rotation.geodesic(matrix, torch.eye(3, dtype=F64)).sort().values
    ranks = torch.arange(20_000, dtype=F64) / 20_000
    assert ((angle - angle.sin()) / math.pi - ranks).abs().max() < 1.95 / math.sqrt(20_000)  # Kolmogorov, p = 0.001
    control = rotation.exp(torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0), dtype=F64))
    angle = rotation.geodesic(control, torch.eye(3, dtype=F64)).sort().values
    assert ((angle - angle.sin()) / math.pi - ranks).abs().max() > 0.1


def test_yaw_is_equivariant_and_zero_upright(generator):
    from motionlab.skeleton import UPRIGHT

    assert rotation.yaw(UPRIGHT) == 0
    turn = torch.rand(20, generator=generator, dtype=F64) * 6 - 3
    root = rotation.random((20,), generator, dtype=F64)
    change = rotation.yaw(rotation.rotation_about("z", turn) @ root) - rotation.yaw(root) - turn
    torch.testing.assert_close((change + 0.5).remainder(math.tau), torch.full((20,), 0.5, dtype=F64))
    on_its_side = rotation.rotation_between(torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1])).requires_grad_()
    rotation.yaw(on_its_side.round()).sum().backward()
    assert rotation.yaw(on_its_side.round()) == 0 and on_its_side.grad.isfinite().all()


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1.0, math.pi / 2, math.pi - 1e-3, math.pi - 1e-7, math.pi])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_between_is_the_shortest_rotation(generator, angle, dtype):
    a = directions(30, generator, dtype)
    side = torch.nn.functional.normalize(torch.linalg.cross(a, directions(30, generator, dtype)), dim=-1)
    b = 3 * (a * math.cos(angle) + side * math.sin(angle))
    matrix = rotation.rotation_between(2 * a, b)
    eps = torch.finfo(dtype).eps
    assert_rotations(matrix, 20 * eps)
    torch.testing.assert_close((matrix @ a[..., None])[..., 0], b / 3, atol=20 * eps, rtol=0)
    turned = rotation.geodesic(matrix, torch.eye(3, dtype=dtype))
    assert (turned - angle).abs().max() < 20 * eps


def test_between_opposite_coordinate_axes_is_a_half_turn():
    axes = torch.cat((torch.eye(3), -torch.eye(3)))
    matrix = rotation.rotation_between(axes, -axes)
    assert_rotations(matrix, 1e-6)
    torch.testing.assert_close((matrix @ axes[..., None])[..., 0], -axes)


def spin(turns: float, frames: int, generator: torch.Generator) -> torch.Tensor:
    """A rotation that spins about a slowly drifting axis: (T, 3, 3)."""
    angle = torch.linspace(0.3, turns * math.tau, frames, dtype=F64)[:, None]
    axis = torch.nn.functional.normalize(
        torch.tensor([0.2, 0.1, 1.0], dtype=F64)
        + 0.1 * torch.sin(angle / 5 + torch.randn(3, generator=generator, dtype=F64)),
        dim=-1,
    )
    return rotation.exp(axis * angle)


def test_unroll_axis_angle_agrees_with_its_twin():
    """Also on pure noise, where the cumulative sum alone is wrong and the sweeps must repair it."""
    for seed in range(5):
        generator = torch.Generator().manual_seed(seed)
        for matrix in (spin(4.1, 200, generator), rotation.random((60,), generator, dtype=F64)):
            aa = rotation.log(matrix)
            aa[10] = 0
            unrolled = rotation.unroll_axis_angle(aa)
            torch.testing.assert_close(unrolled, torch.as_tensor(twins.unroll_axis_angle(aa)))
            torch.testing.assert_close(rotation.exp(unrolled), rotation.exp(aa))


def test_unroll_axis_angle_follows_a_spin_and_batches(generator):
    matrix = torch.stack([spin(4.1, 300, generator), spin(-2.4, 300, generator)])
    aa = rotation.log(matrix)
    unrolled = rotation.unroll_axis_angle(aa)
    torch.testing.assert_close(unrolled[..., -1, :].norm(dim=-1) / math.tau, torch.tensor([4.1, 2.4], dtype=F64))
    by_clip = torch.stack([rotation.unroll_axis_angle(x) for x in aa])
    torch.testing.assert_close(unrolled, by_clip)
    joints = aa.movedim(0, -2)  # (T, 2, 3)
    torch.testing.assert_close(rotation.unroll_axis_angle(joints, dim=-3), unrolled.movedim(0, -2))


def test_unroll_keeps_short_and_still_sequences():
    for frames in (0, 1):
        assert rotation.unroll_axis_angle(torch.ones(frames, 3)).shape == (frames, 3)
        assert rotation.unroll_quaternion(torch.ones(frames, 4)).shape == (frames, 4)
    assert torch.equal(rotation.unroll_axis_angle(torch.zeros(5, 3)), torch.zeros(5, 3))


def test_unroll_through_the_zero_rotation_goes_straight():
    """From +a to -a about one axis: no turn may be added; starting one turn up, it stays one turn up."""
    swing = torch.linspace(1, -1, 21, dtype=F64)[:, None] * torch.tensor([0.0, 0.6, 0.8], dtype=F64)
    torch.testing.assert_close(rotation.unroll_axis_angle(swing), swing)
    up = swing[:1] * (1 + math.tau)
    torch.testing.assert_close(
        rotation.unroll_axis_angle(torch.cat((up, swing[1:]))), swing + up - swing[:1], atol=1e-12, rtol=0
    )


def test_unroll_quaternion_follows_a_spin(generator):
    q = rotation.matrix_to_quaternion(spin(3, 200, generator))
    flipped = q * torch.where(torch.rand(200, 1, generator=generator) < 0.5, -1.0, 1.0)
    unrolled = rotation.unroll_quaternion(flipped)
    assert torch.diff(flipped, dim=0).norm(dim=-1).max() > 1.9
    assert torch.diff(unrolled, dim=0).norm(dim=-1).max() < 0.3
    assert (unrolled.abs() == q.abs()).all() and torch.equal(unrolled[0], flipped[0])
    torch.testing.assert_close(rotation.unroll_quaternion(flipped[:, None], dim=0)[:, 0], unrolled)
