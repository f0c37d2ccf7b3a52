"""The Gauss-Newton matrix of stage 3's energy: derivatives of transitions and of the prior, rows of every residual, and
their factorisation by one Riccati sweep.

A small change of a frame is 210 numbers: its state's in its own heading frame,

    xi 207 = trans | trans_vel | root_orient_vel | joints 66 | joints_vel 66 | omega 66

where omega turns the 22 rotations from the left, R -> exp(omega) R, and gamma = (turn, x, y), how its heading frame
itself turns about z and moves on the floor, in its own axes.

Rows say how each residual of a frame answers to a small change of it, of n = 210 + S numbers: xi, gamma, then S shared
by all frames of a clip, 8 betas and, where the camera is unknown, its 3. Rows carry the square root of their weight,
so that H = R^T R is the Gauss-Newton matrix of the energy as it is. Robust terms count with the weight that they have
at the point; contact probabilities are constants. Contact heights, hinges without curvature, count as the parabolas
that touch them from above: without them a camera that nobody fixed and its body would rise together at no cost.

The sweep goes from the last frame to the first. With y_t a small change of frame t, y_{t+1} = A_t y_t + B_t z_t, and an
energy 1/2 sum_t |R_t y_t|^2 + |N_t (y_t, z_t)|^2, the least that frames t.. can cost is 1/2 y_t^T P_t y_t,

    Q = [A B]^T P_{t+1} [A B] + N^T N,   L L^T = Q_zz,   K_t = -Q_zz^-1 Q_zy,   P_t = Q_yy + Q_yz K_t + R_t^T R_t,

and in nu, z_t = K_t y_t + L^-T nu_t, the energy is 1/2 |nu|^2. In these coordinates Newton's step is -gradient.

Source: HuMoR (Rempe et al. 2021), section 4 (the energies), rows by hand; the discrete Riccati equation, e.g.
Rao, Wright and Rawlings 1998.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.heading import Frame
from motionlab.humor import energies, state
from motionlab.humor.body_shape import BETAS, CARRIERS, GROUP_OF, ORDER, PLACE, SPREAD, offsets, scales
from motionlab.humor.evidence import Evidence
from motionlab.humor.priors import Cvae
from motionlab.humor.state import ADDED, CHANGES
from motionlab.skeleton import STANDARD, fk

XI, GAMMA, LATENTS = 207, 3, 48
CHANGE = XI + GAMMA
_ROOT = [0, 1, 2, ADDED, ADDED + 1, ADDED + 2, XI, XI + 1, XI + 2]  # of a change: trans, the root's omega, gamma
_PIECE = 16  # frames at a time, for the cache
_J = 22
_OWN = slice(9, 75)  # of the joints that the roll-out carries, in xi
_BELOW = STANDARD.ancestors().float().T  # [k, j]: joint j is k, or lies below it
_HANGS = torch.cat((_BELOW, _BELOW[:, CARRIERS]), 1)  # [k, p]: the bone to k is on the way to point p
_ABOVE = torch.cat((_BELOW - torch.eye(_J), _BELOW[:, CARRIERS]), 1)  # [k, p]: joint k's rotation moves point p
_IN_GROUP = F.one_hot(torch.tensor(GROUP_OF), BETAS).float()


def decoder_slopes(model: Cvae, x: Tensor, z: Tensor) -> Tensor:
    """Computes the derivatives (N, 207, 255) of the raw changes in xi and z, of states (N, 339), latents z (N, 48)."""

    def raw(both: Tensor, x: Tensor, z: Tensor) -> Tensor:
        return model.decode(_changed(x, both), z + both[:, XI:])[:, :CHANGES]

    return _rows(raw, XI + LATENTS, x, z)


def prior_slopes(model: Cvae, x: Tensor) -> Tensor:
    """Computes the derivatives (N, 96, 207) in xi of mean and log variance of p(z | x), from states (N, 339)."""
    return _rows(lambda xi, x: torch.cat(model.prior(_changed(x, xi)), -1), XI, x)


def _rows(of: Callable[..., Tensor], count: int, *rows: Tensor) -> Tensor:
    """Jacobians (N, out, count) of what comes of N rows and of small changes of each, (N, count) and nought here."""
    found = []
    for piece in zip(*(x.split(_PIECE) for x in rows), strict=True):
        change, out = _traced(of, count, piece)
        unit = torch.eye(out.shape[1]).to(out)[:, None].expand(-1, *out.shape)
        found.append(torch.autograd.grad(out, change, unit, is_grads_batched=True)[0].transpose(0, 1))
    return torch.cat(found)


def columns(of: Callable[..., Tensor], count: int, *rows: Tensor) -> Tensor:
    """Computes the Jacobians (N, out, count) of few causes: N rows and small changes (N, count) of each -> (N, out), by
    going back twice: J^T c is linear in c."""
    change, out = _traced(of, count, rows)
    with torch.enable_grad():
        c = torch.zeros_like(out, requires_grad=True)
        (pulled,) = torch.autograd.grad(out, change, c, create_graph=True)
    unit = torch.eye(count).to(out)[:, None].expand(-1, *pulled.shape)
    return torch.autograd.grad(pulled, c, unit, is_grads_batched=True)[0].permute(1, 2, 0)


def _traced(of: Callable[..., Tensor], count: int, rows: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Changes of nought (N, count), and what comes of them."""
    with torch.enable_grad():
        change = rows[0].new_zeros(len(rows[0]), count, requires_grad=True)
        return change, of(change, *rows)


def _changed(x: Tensor, xi: Tensor) -> Tensor:
    """States (..., 339), own frames, after small changes (..., 207 or more), of first order in rotations."""
    m, omega = x[..., ADDED:].unflatten(-1, (22, 3, 3)), xi[..., ADDED:XI].unflatten(-1, (22, 3))
    return torch.cat((x[..., :ADDED] + xi[..., :ADDED], (m - m @ rotation.skew(omega)).flatten(-3)), -1)


def transition_slopes(model: Cvae, x: Tensor, z: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Computes the derivatives of N transitions in state and z from states (N, 339), own frames, and latents z (N, 48).

    slopes: of the decoder (``decoder_slopes``), or what shall stand for them; changed in place.

    Returns:
        of frame t + 1, columns are causes: in a small change of frame t (N, 210, 210) and in z (N, 210, 48). And the
        turn (N, 3, 3) from the axes of frame t to those of frame t + 1, as row vectors from the right.
    """
    raw = model.decode(x, z)
    after, _ = state.apply(x, raw)
    v, bent = raw[:, ADDED:CHANGES].unflatten(1, (22, 3)), slopes[:, ADDED:].unflatten(1, (22, 3))
    bent.copy_(rotation.left_jacobian(v) @ bent)
    slopes[:, :ADDED, :ADDED].diagonal(dim1=-2, dim2=-1).add_(1.0)
    _blocks(slopes[:, ADDED:, ADDED:XI]).add_(rotation.exp(v))  # what turns a joint before the step turns it after

    # and into the frame of the new state, which its root moves; all else is turned with that frame, or stays
    turn, few = state.heading(after).turn, torch.tensor(_ROOT, device=x.device)
    own = x.new_zeros(len(x), CHANGE, CHANGE)
    _blocks(own[:, :ADDED, :ADDED]).copy_(turn[:, None])
    own[:, ADDED:XI, ADDED:XI].diagonal(dim1=-2, dim2=-1).fill_(1.0)

    def change(part: Tensor, after: Tensor) -> Tensor:
        whole = part.new_zeros(len(part), CHANGE).index_copy(1, few, part)
        frame = Frame(rotation.rotation_about("z", -whole[:, XI]), -F.pad(whole[:, XI + 1 :], (0, 1)))
        return state_change(state.globalise(_changed(after, whole), frame), after)

    own[..., few] = columns(change, len(few), after)
    out = own[..., :XI] @ slopes
    return torch.cat((out[..., :XI], own[..., XI:]), -1), out[..., XI:], turn.mT


def _blocks(x: Tensor) -> Tensor:
    """The 3 x 3 blocks on the diagonal of matrices (N, 3 k, 3 k): a view (N, k, 3, 3)."""
    return x.unflatten(2, (-1, 3)).unflatten(1, (-1, 3)).diagonal(dim1=1, dim2=3).movedim(-1, 1)


def state_change(states: Tensor, others: Tensor) -> Tensor:
    """Computes the change (..., 210) that takes others to states (..., 339), world; of first order in rotations."""
    ours, theirs = state.heading(states), state.heading(others)
    x, y = state.localise(states, ours), state.localise(others, theirs)
    # of R_x R_y^T
    omega = rotation.unskew(x[..., ADDED:].unflatten(-1, (22, 3, 3)).mT @ y[..., ADDED:].unflatten(-1, (22, 3, 3)))
    cross = theirs.turn @ ours.turn.mT
    angle = torch.atan2(cross[..., 1, 0], cross[..., 0, 0])
    way = (theirs.turn @ (theirs.shift - ours.shift)[..., None])[..., :2, 0]
    return torch.cat((x[..., :ADDED] - y[..., :ADDED], omega.flatten(-2), angle[..., None], way), -1)


def _posed(x: Tensor, betas: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The 22 joints and 11 surface points (N, 33, 3) of states (N, 339) in their own heading frames, with betas (N, 8),
    and how they move (N, 33, 3, n). size: n."""
    rot = x[:, ADDED:].unflatten(1, (_J, 3, 3)).mT
    bones = offsets(betas)
    p, turns = fk(replace(STANDARD, offsets=bones), x[:, :3], rot)
    parents = torch.tensor([max(k, 0) for k in STANDARD.parents], device=x.device)
    axes = turns[:, parents].clone()
    axes[:, 0] = torch.eye(3, dtype=x.dtype, device=x.device)
    stretch = SPREAD * (axes @ bones[..., None])[..., 0]  # (N, 22, 3): of the bone to each joint, per beta of its group
    place = scales(betas)[:, CARRIERS, None] * PLACE.to(x)
    way = (turns[:, CARRIERS] @ place[..., None])[..., 0]
    points = torch.cat((p, p[:, CARRIERS] + way), 1)
    out = _carried(points, size)
    out[..., :3] = torch.eye(3, dtype=x.dtype, device=x.device)
    lever = points[:, None] - p[:, :, None]  # (N, 22, P, 3)
    turned = torch.linalg.cross(axes.mT[:, :, None], lever[..., None, :].expand(-1, -1, -1, 3, -1))  # (N, 22, P, 3a, 3)
    turned = turned * _ABOVE.to(x)[:, :, None, None]
    out[..., ADDED:XI] = turned.permute(0, 2, 4, 1, 3).flatten(3)
    longer = torch.einsum("nkc,kp,kg->npcg", stretch, _HANGS.to(x), _IN_GROUP.to(x))
    longer[:, _J:] += SPREAD * way[..., None] * _IN_GROUP.to(x)[CARRIERS][:, None]
    out[..., CHANGE : CHANGE + BETAS] = longer
    return points, out


def _carried(points: Tensor, size: int) -> Tensor:
    """How points (N, P, 3) move with their heading frame, as it turns and moves on the floor: (N, P, 3, n)."""
    out = points.new_zeros(*points.shape, size)
    out[..., 0, XI], out[..., 1, XI] = -points[..., 1], points[..., 0]
    out[..., 0, XI + 1] = out[..., 1, XI + 2] = 1.0
    return out


def residual_rows(
    x: Tensor, turn: Tensor, shift: Tensor, steps: Tensor, betas: Tensor, camera: Tensor | None, touching: Tensor,
    evidence: Evidence, weights: dict[str, float],
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Computes all rows of B clips of T frames: of single frames (B, T, m, n), and of neighbours either frame's part,
    the former's and the latter's (B, T - 1, k, n).

    x (B, T, 339): states in their own frames, order of ``state``. turn (B, T, 3, 3), shift (B, T, 3): world to own,
    own = turn (world + shift). steps (B, T - 1, 3, 3): from one frame's axes to the next one's, row vectors from the
    right. betas (B, 8); camera (B, 3). touching (B, T, 9): probabilities.
    """
    clips, frames = x.shape[:2]
    free = evidence.view is not None and evidence.view.free
    size = CHANGE + BETAS + (3 if free else 0)
    flat, weigh = x.flatten(0, 1), defaultdict(float, weights)
    points, every = _posed(flat, betas.repeat_interleave(frames, 0), size)
    joints, slopes = flat[:, _OWN].unflatten(1, (_J, 3)), every[:, :_J]  # those that the roll-out carries; the body's
    own = _carried(joints, size)
    own[..., _OWN] = torch.eye(66).to(own).unflatten(0, (_J, 3))
    found = [weigh["joint_consistency"] ** 0.5 * (slopes - own).flatten(1, 2)]
    if evidence.view is None:
        seen = (evidence.weight * weigh["joints3d"]).sqrt().flatten(0, 1)
        found.append((seen[..., None, None] * slopes).flatten(1, 2))
    else:
        marks = (each[:, ORDER].unflatten(0, (clips, frames)) for each in (points, every))
        found.append(_pixel_rows(*marks, turn, shift, camera, evidence, weigh["joints2d"], free))
    feet = list(energies.CONTACT_JOINTS)
    high = points[:, feet, 2].abs()
    pull = weigh["contact_height"] * touching.flatten(0, 1) * (high > energies.TOUCHING) / high.clamp(min=1e-6)
    found.append(pull.nan_to_num().sqrt()[..., None] * slopes[:, feet, 2])
    of_frame = torch.cat(found, 1).unflatten(0, (clips, frames))

    parents = list(energies.BONE_PARENTS)
    bones = joints[:, 1:] - joints[:, parents]
    way = bones / bones.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    lengths = (way[..., None] * (own[:, 1:] - own[:, parents])).sum(-2)
    lengths = lengths.mul_(weigh["bone_length"] ** 0.5).unflatten(0, (clips, frames))
    where = slopes[:, feet].unflatten(0, (clips, frames))
    held = (touching[:, 1:] * weigh["contact_vel"]).sqrt()[..., None, None]
    before = held * where[:, :-1]
    after = held * (steps[:, :, None] @ where[:, 1:])  # back into the axes of the former frame
    before = torch.cat((-lengths[:, :-1], -before.flatten(2, 3)), 2)
    return of_frame, before, torch.cat((lengths[:, 1:], after.flatten(2, 3)), 2)


def _pixel_rows(points: Tensor, slopes: Tensor, turn, shift, camera, evidence: Evidence, weight, free: bool) -> Tensor:
    """Rows (B T, 50, n) of the pixels of landmarks (B, T, 25, 3), own frames, that move so (B, T, 25, 3, n)."""
    view = evidence.view
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
    slopes = whole @ slopes
    if free:
        of_camera = columns(lambda more, camera: view.pixels(world, camera + more).flatten(1), 3, camera)
        slopes[..., -3:] = of_camera.unflatten(1, pixels.shape[1:])
    residual = (pixels - evidence.values).square()
    robust = (energies.SIGMA**2 / (energies.SIGMA**2 + residual)).square()
    root = (2 * weight * evidence.weight.square()[..., None] * robust).sqrt()
    return (root[..., None] * slopes).flatten(2, 3).flatten(0, 1)


class Sweep(NamedTuple):
    """gains K (B, T - 1, Z, n), whiteners L^-T (B, T - 1, Z, Z) and what the first change costs, P_0 (B, n, n)."""

    gains: Tensor
    whiteners: Tensor
    first: Tensor


def riccati_sweep(of_frame: Tensor, a: Tensor, b: Tensor, of_pair: Tensor, ridge: float = 1e-6) -> Sweep:
    """Computes gains and whiteners from quadratic costs and linear dynamics, backwards through T frames.

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
    """Computes Cholesky factors (B, m, m) from symmetric matrices. One that rounding made indefinite gets more on its
    diagonal; one that is not finite gives the identity, so that one bad clip does not end the others."""
    factor, bad = torch.linalg.cholesky_ex(h)
    if not bad.any():
        return factor
    diagonal = h.diagonal(dim1=-2, dim2=-1)
    more = 1e-3 * diagonal.abs().amax(-1, keepdim=True) + 1e-3 * diagonal.abs()
    again, worse = torch.linalg.cholesky_ex(h + torch.diag_embed(more))
    factor = torch.where((bad > 0)[:, None, None], again, factor)
    eye = torch.eye(h.shape[-1], dtype=h.dtype, device=h.device)
    return torch.where(((worse > 0) & (bad > 0))[:, None, None], eye, factor)
