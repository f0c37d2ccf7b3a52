"""The Gauss-Newton matrix of stage 3's energy: rows of every residual, and their factorisation by one Riccati sweep.

Rows say how each residual of a frame answers to a small change of it. A change of a frame has n = 210 + S numbers: xi
and gamma (``derivatives``), then S shared by all frames of a clip, 8 betas and, where the camera is unknown, its 3.
Rows carry the square root of their weight, so that H = R^T R is the Gauss-Newton matrix of the energy as it is. Robust
terms count with the weight that they have at the point; contact probabilities are constants. Contact heights, hinges
without curvature, count as the parabolas that touch them from above: without them a camera that nobody fixed and its
body would rise together at no cost. A term without rows is minimised all the same; the coordinates do not know of it.

The sweep goes from the last frame to the first. With y_t a small change of frame t, y_{t+1} = A_t y_t + B_t z_t, and an
energy 1/2 sum_t |R_t y_t|^2 + |N_t (y_t, z_t)|^2, the least that frames t.. can cost is 1/2 y_t^T P_t y_t,

    Q = [A B]^T P_{t+1} [A B] + N^T N,   L L^T = Q_zz,   K_t = -Q_zz^-1 Q_zy,   P_t = Q_yy + Q_yz K_t + R_t^T R_t,

and in nu, z_t = K_t y_t + L^-T nu_t, the energy is 1/2 |nu|^2. In these coordinates Newton's step is -gradient.

Source: HuMoR (Rempe et al. 2021), section 4 (the energies), derivatives by hand; the discrete Riccati equation, e.g.
Rao, Wright and Rawlings 1998.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab.humor import energies, state
from motionlab.humor.body_shape import BETAS, CARRIERS, GROUP_OF, ORDER, PLACE, SPREAD, offsets, scales
from motionlab.humor.evidence import Evidence, View
from motionlab.humor.shooting.derivatives import CHANGE, XI, columns
from motionlab.humor.state import ADDED
from motionlab.skeleton import STANDARD, fk

_J = state.JOINT_COUNT
_OWN = slice(9, 75)  # of the joints that the roll-out carries, in xi
_HANGS = STANDARD.ancestors().float().T.contiguous()  # [k, j]: the bone to k is on the way to j
_ABOVE = _HANGS - torch.eye(_J)  # [k, j]: joint k's rotation moves joint j, which lies below it
_IN_GROUP = F.one_hot(torch.tensor(GROUP_OF), BETAS).float()


class Body(NamedTuple):
    """N frames of a posed body in their own heading frames: points (N, P, 3) and how they move (N, P, 3, n)."""

    joints: Tensor
    slopes: Tensor


class Rows(NamedTuple):
    """of_frame (N, m, n): of single frames. before, after (N - B, k, n): of neighbours, either frame's part."""

    of_frame: Tensor
    before: Tensor
    after: Tensor


def _posed(x: Tensor, betas: Tensor, *, size: int, marks: bool = False) -> Body:
    """Computes the joints of N states (N, 339), own heading frames, or the 25 landmarks, and how they move. betas
    (N, 8). size: n."""
    rot = x[:, ADDED:].unflatten(1, (_J, 3, 3)).mT
    bones = offsets(betas)
    p, turns = fk(replace(STANDARD, offsets=bones), x[:, :3], rot)
    parents = torch.tensor([max(k, 0) for k in STANDARD.parents], device=x.device)
    axes = turns[:, parents].clone()
    axes[:, 0] = torch.eye(3, dtype=x.dtype, device=x.device)
    points, above, hangs = p, _ABOVE.to(x), _HANGS.to(x)
    stretch = SPREAD * (axes @ bones[..., None])[..., 0]  # (N, 22, 3): of the bone to each joint, per beta of its group
    if marks:
        place = scales(betas)[:, CARRIERS, None] * PLACE.to(x)
        way = (turns[:, CARRIERS] @ place[..., None])[..., 0]
        points = torch.cat((p, p[:, CARRIERS] + way), 1)
        above = torch.cat((above, hangs[:, CARRIERS]), 1)
        hangs = torch.cat((hangs, hangs[:, CARRIERS]), 1)
    out = x.new_zeros(len(x), points.shape[1], 3, size)
    out[..., :3] = torch.eye(3, dtype=x.dtype, device=x.device)
    lever = points[:, None] - p[:, :, None]  # (N, 22, P, 3)
    turned = torch.linalg.cross(axes.mT[:, :, None], lever[..., None, :].expand(-1, -1, -1, 3, -1))  # (N, 22, P, 3a, 3)
    turned = turned * above[:, :, None, None]
    out[..., ADDED:XI] = turned.permute(0, 2, 4, 1, 3).flatten(3)
    out[..., XI] = _about_z(points)
    out[..., 0, XI + 1] = out[..., 1, XI + 2] = 1.0
    longer = torch.einsum("nkc,kp,kg->npcg", stretch, hangs, _IN_GROUP.to(x))
    if marks:
        longer[:, _J:] += SPREAD * way[..., None] * _IN_GROUP.to(x)[CARRIERS][:, None]
        points, out, longer = points[:, ORDER], out[:, ORDER], longer[:, ORDER]
    out[..., CHANGE : CHANGE + BETAS] = longer
    return Body(points, out)


def _about_z(v: Tensor) -> Tensor:
    """e_z x v (..., 3)."""
    return torch.stack((-v[..., 1], v[..., 0], torch.zeros_like(v[..., 0])), -1)


def _own_joints(x: Tensor, size: int) -> Body:
    """Computes the joints that the roll-out carries beside the pose, as :func:`_posed`."""
    joints = x[:, _OWN].unflatten(1, (_J, 3))
    out = x.new_zeros(len(x), _J, 3, size)
    out[..., _OWN] = torch.eye(66, dtype=x.dtype, device=x.device).unflatten(0, (_J, 3))
    out[..., XI] = _about_z(joints)
    out[..., 0, XI + 1] = out[..., 1, XI + 2] = 1.0
    return Body(joints, out)


def residual_rows(
    x: Tensor, turn: Tensor, shift: Tensor, steps: Tensor, betas: Tensor, camera: Tensor | None, touching: Tensor,
    evidence: Evidence, weights: dict[str, float],
) -> Rows:  # fmt: skip
    """Computes all rows of B clips of T frames.

    x (B, T, 339): states in their own frames, order of ``state``. turn (B, T, 3, 3), shift (B, T, 3): world to own,
    own = turn (world + shift). steps (B, T - 1, 3, 3): from one frame's axes to the next one's, row vectors from the
    right. betas (B, 8); camera (B, 3). touching (B, T, 9): probabilities.
    """
    clips, frames = x.shape[:2]
    free = evidence.view is not None and evidence.view.free
    size = CHANGE + BETAS + (3 if free else 0)
    flat, shape = x.flatten(0, 1), betas.repeat_interleave(frames, 0)
    body, own = _posed(flat, shape, size=size), _own_joints(flat, size)
    found = [weights.get("joint_consistency", 0.0) ** 0.5 * (body.slopes - own.slopes).flatten(1, 2)]
    if evidence.view is None:
        seen = (evidence.weight * weights.get("joints3d", 0.0)).sqrt().flatten(0, 1)
        found.append((seen[..., None, None] * body.slopes).flatten(1, 2))
    else:
        marks = _posed(flat, shape, size=size, marks=True)
        found.append(_pixel_rows(marks, turn, shift, camera, evidence, weights.get("joints2d", 0.0), clips, free))
    feet = list(energies.CONTACT_JOINTS)
    high = body.joints[:, feet, 2].abs()
    pull = (
        weights.get("contact_height", 0.0) * touching.flatten(0, 1) * (high > energies.TOUCHING) / high.clamp(min=1e-6)
    )
    found.append(pull.nan_to_num().sqrt()[..., None] * body.slopes[:, feet, 2])
    of_frame = torch.cat(found, 1).unflatten(0, (clips, frames))

    lengths = _length_rows(own).mul_(weights.get("bone_length", 0.0) ** 0.5).unflatten(0, (clips, frames))
    where = body.slopes[:, feet].unflatten(0, (clips, frames))
    held = (touching[:, 1:] * weights.get("contact_vel", 0.0)).sqrt()[..., None, None]
    before = held * where[:, :-1]
    after = held * (steps[:, :, None] @ where[:, 1:])  # back into the axes of the former frame
    pairs = (
        torch.cat((-lengths[:, :-1], -before.flatten(2, 3)), 2),
        torch.cat((lengths[:, 1:], after.flatten(2, 3)), 2),
    )
    return Rows(of_frame, *pairs)


def _length_rows(own: Body) -> Tensor:
    """Lengths of the 21 bones between carried joints: (N, 21, n)."""
    parents = list(energies.BONE_PARENTS)
    bones = own.joints[:, 1:] - own.joints[:, parents]
    way = bones / bones.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return (way[..., None] * (own.slopes[:, 1:] - own.slopes[:, parents])).sum(-2)


def _pixel_rows(marks: Body, turn, shift, camera, evidence: Evidence, weight: float, clips: int, free: bool) -> Tensor:
    view: View = evidence.view
    frames = evidence.values.shape[1]
    points = marks.joints.unflatten(0, (clips, frames))
    world = points @ turn - shift[:, :, None]  # own = turn (world + shift)
    turned, centre = view.moved(camera)
    local = (world - centre[:, None, None]) @ turned[:, None].mT
    depth = local[..., 2:].clamp(min=0.05)
    plane = local[..., :2] / depth
    focal = torch.stack((view.intrinsics[:, 0, 0], view.intrinsics[:, 1, 1]), -1)[:, None, None]
    eye = torch.eye(2, dtype=points.dtype, device=points.device).expand(*plane.shape[:-1], 2, 2)
    project = torch.cat((eye, -plane[..., None]), -1) * (focal / depth)[..., None]  # (B, T, 25, 2, 3)
    project = torch.where((local[..., 2:] > 0.05)[..., None], project, 0.0)
    whole = project @ (turned[:, None] @ turn.mT)[:, :, None]
    pixels = view.pixels(world, camera)
    slopes = whole @ marks.slopes.unflatten(0, (clips, frames))
    if free:
        of_camera = columns(lambda more, camera: view.pixels(world, camera + more).flatten(1), 3, camera)
        slopes[..., -3:] = of_camera.unflatten(1, pixels.shape[1:])
    residual = (pixels - evidence.values).square()
    robust = (energies.SIGMA**2 / (energies.SIGMA**2 + residual)).square()
    root = (2 * weight * evidence.weight.square()[..., None] * robust).sqrt()
    return (root[..., None] * slopes).flatten(2, 3).flatten(0, 1)


# ------------------------------------------------------------------------------------------------------- the sweep
class Sweep(NamedTuple):
    """gains K (B, T - 1, Z, n), shapers L^-T (B, T - 1, Z, Z) and what the first change costs, P_0 (B, n, n)."""

    gains: Tensor
    whiteners: Tensor
    first: Tensor


def riccati_sweep(of_frame: Tensor, a: Tensor, b: Tensor, of_pair: Tensor, ridge: float = 1e-6) -> Sweep:
    """Computes gains and shapers from quadratic costs and linear dynamics, backwards through T frames.

    of_frame (B, T, n, n): R^T R. a (B, T - 1, n, n), b (B, T - 1, n, Z). of_pair (B, T - 1, n + Z, n + Z): N^T N.
    ridge: added to the diagonal of Q_zz.
    """
    n, size = b.shape[-2:]
    both = torch.cat((a, b), -1)
    cost = of_frame[:, -1]
    gains, whiteners = [], []
    eye = torch.eye(size, dtype=b.dtype, device=b.device)
    for t in reversed(range(b.shape[1])):
        step = both[:, t]
        q = step.mT @ (cost @ step) + of_pair[:, t]
        factor = factorised(q[:, n:, n:] + ridge * eye)
        back = torch.linalg.solve_triangular(
            factor, torch.cat((q[:, n:, :n], eye.expand(len(q), -1, -1)), -1), upper=False
        )
        half, inverse = back.split((n, size), -1)  # L^-1 Q_zy, L^-1
        gains.append(-inverse.mT @ half)
        whiteners.append(inverse.mT)
        cost = q[:, :n, :n] - half.mT @ half + of_frame[:, t]
        cost = (cost + cost.mT) / 2
    return Sweep(torch.stack(gains[::-1], 1), torch.stack(whiteners[::-1], 1), cost)


def factorised(h: Tensor) -> Tensor:
    """Computes Cholesky factors (B, m, m) from symmetric matrices.

    A matrix that rounding made indefinite gets more on its diagonal. One that is not finite gives the identity, so that
    one bad clip does not end the others.
    """
    factor, bad = torch.linalg.cholesky_ex(h)
    if not bad.any():
        return factor
    diagonal = h.diagonal(dim1=-2, dim2=-1)
    more = 1e-3 * diagonal.abs().amax(-1, keepdim=True) + 1e-3 * diagonal.abs()
    again, worse = torch.linalg.cholesky_ex(h + torch.diag_embed(more))
    factor = torch.where((bad > 0)[:, None, None], again, factor)
    eye = torch.eye(h.shape[-1], dtype=h.dtype, device=h.device)
    return torch.where(((worse > 0) & (bad > 0))[:, None, None], eye, factor)
