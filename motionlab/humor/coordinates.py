"""Whitens stage 3 around a roll-out: its energy becomes close to half the squared norm of the new variables.

    z_t = z^_t + K_t (x_t - x^_t) + L_t^-T nu_t,        first state and what is shared = L_0^-T nu_0

with gains K_t and factors L_t of the clip's Gauss-Newton matrix (``gauss_newton``). Any z has its nu, and what comes
out is an exact roll-out: what the matrix leaves out costs closures, not correctness. The networks' slopes change slowly
and may be taken at every few frames only, straight lines between.

Source: differential dynamic programming (Jacobson and Mayne 1970); thesis 3.3.4 asks for such a formulation.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple, Self

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.heading import Frame
from motionlab.humor import energies, gauss_newton, priors, state, unknowns
from motionlab.humor.body_shape import BETAS
from motionlab.humor.gauss_newton import CHANGE, GAMMA, LATENTS, XI, factorised, riccati_sweep
from motionlab.humor.priors import Gaussian
from motionlab.humor.rollout import steered_rollout
from motionlab.humor.stages import Problem
from motionlab.humor.state import ADDED
from motionlab.humor.unknowns import FIRST, Rolled, Unknowns

_FIRST = sum(FIRST.values())
#: Where the features of the initial-state mixture stand in xi: joints, joints_vel, trans_vel, root_orient_vel.
_FEATURES = [*range(9, 141), *range(3, 9)]
_INFORMATION = 0.25 * 0.5
_SHARPEST = 1e2  # 1 / sigma of the prior counts no more than this in the matrix


class Whitening(NamedTuple):
    """Coordinates around a roll-out in which the Gauss-Newton matrix is the identity.

    base (B, T - 1, 48): its z - K X. gains (T - 1, B, 48, 345), time first as roll-outs read them: on X of ``rollout``;
    shared (B, T - 1, 48, S): on what all frames share. whiteners (B, T - 1, 48, 48): L_t^-T; first (B, f, f): L_0^-T.
    Of the first state and what is shared, in these coordinates: rest (B, f, f), the matrix without the initial-state
    mixture, whose features move by (B, 138, f).
    """

    base: Tensor
    gains: Tensor
    shared: Tensor
    whiteners: Tensor
    first: Tensor
    rest: Tensor
    features: Tensor

    def rows(self, index: Tensor) -> Self:
        """Returns the coordinates of some clips, which may repeat."""
        return Whitening(*(x[:, index] if x is self.gains else x[index] for x in self))


def unwhiten(
    problem: Problem, unknown: Unknowns, white: Whitening, new: Mapping[str, Tensor]
) -> tuple[Unknowns, Rolled]:
    """Computes unknowns and their exact roll-out from whitened coordinates nu (B, T - 1, 48) and first (B, f)."""
    change = (white.first @ new["first"][..., None])[..., 0]
    at = apply_change(unknown, change)
    first = unknowns.first_state(at, problem.priors)
    shared = change[:, _FIRST:]
    u = white.base + (white.whiteners @ new["nu"][..., None])[..., 0]
    u = u + (white.shared @ shared[:, None, :, None])[..., 0]
    rollout, _ = steered_rollout(problem.priors.motion, first, u, white.gains.transpose(0, 1))
    return at, unknowns.rolled_from(first, rollout, at, problem.evidence)


def apply_change(unknown: Unknowns, change: Tensor) -> Unknowns:
    """Computes unknowns after a change (B, f) of the first state and of what is shared."""
    sizes = FIRST | {"betas": BETAS, "camera": change.shape[1] - _FIRST - BETAS}  # 0 where the camera is known
    parts = dict(zip(sizes, change.split(list(sizes.values()), -1), strict=True))
    new = {n: getattr(unknown, n) + part for n, part in parts.items() if n != "orient" and sizes[n]}
    new["orient"] = unknowns.from_matrix(rotation.exp(parts["orient"]) @ unknowns.to_matrix(unknown.orient), "lean")
    return replace(unknown, **new)


@torch.inference_mode(False)
@torch.no_grad()
def linearised(problem: Problem, unknown: Unknowns, *, ridge: float = 1e-6, stride: int = 1) -> Whitening:
    """Computes coordinates around the roll-out of unknowns (B, ...), networks differentiated at stride-th frames."""
    z, model = unknown.z, problem.priors.motion
    clips, frames = z.shape[0], z.shape[1] + 1
    first = unknowns.first_state(unknown, problem.priors)
    rollout, inputs = steered_rollout(model, first, z)
    states = torch.cat((first[:, None], rollout.states), 1)
    frame = state.heading(states)
    x = state.localise(states, frame)
    past, keys = x[:, :-1], torch.tensor([*range(0, frames - 2, stride), frames - 2], device=z.device)
    some, between = past[:, keys].flatten(0, 1), partial(between_keys, keys=keys, clips=clips)
    decoded = between(gauss_newton.decoder_slopes(model, some, z[:, keys].flatten(0, 1)))
    moves = gauss_newton.transition_slopes(model, past.flatten(0, 1), z.flatten(0, 1), decoded)
    of_change, of_z, turn = (each.unflatten(0, (clips, -1)) for each in moves)
    prior_slopes = between(gauss_newton.prior_slopes(model, some))
    weights = problem.weights.of(3, frames=frames)
    of_frame, before, after = gauss_newton.residual_rows(
        x, frame.turn, frame.shift, turn, unknown.betas, unknown.camera,
        energies.contact_probabilities(rollout.contact_logits), problem.evidence, weights,
    )  # fmt: skip
    more = of_frame.shape[-1] - CHANGE  # shape and camera, which stay
    a, b = F.pad(of_change, (0, more, 0, more)), F.pad(of_z, (0, 0, 0, more))
    a[..., CHANGE:, CHANGE:] = torch.eye(more).to(a)
    toward = prior_rows(z.flatten(0, 1), rollout.prior, prior_slopes, a.shape[-1], weights.get("motion_prior", 0.0))
    pairs = torch.cat((after @ a + before, after @ b), -1)
    both = torch.cat((pairs, toward.unflatten(0, (clips, -1))), -2)
    swept = riccati_sweep(of_frame.mT @ of_frame, a, b, both.mT @ both, ridge)
    gains, shared = _gains_on_states(swept.gains, past, frame)
    gains = gains.transpose(0, 1).contiguous()
    base = z - (gains.transpose(0, 1) @ inputs[..., None])[..., 0]
    return Whitening(base, gains, shared, swept.whiteners, *whiten_first_state(problem, unknown, swept.first, frames))


def prior_rows(z: Tensor, prior: Gaussian, slopes_: Tensor, n: int, weight: float) -> Tensor:
    """Computes Gauss-Newton rows (N, 96, n + 48) of the prior's negative log likelihood, w (-log N(z; mu(x),
    sigma(x))): of (z - mu) / sigma, and of log sigma^2 with a quarter of Fisher's information of it, tried by hand."""
    mean, log_var = (x.flatten(0, 1) for x in prior)
    of_mean, of_log_var = slopes_.chunk(2, 1)
    sharp = (-0.5 * log_var).exp().clamp(max=_SHARPEST) * weight**0.5
    rows = z.new_zeros(len(z), 2 * LATENTS, n + LATENTS)
    off = (z - mean) * sharp
    rows[:, :LATENTS, :XI] = -sharp[..., None] * of_mean - 0.5 * off[..., None] * of_log_var
    rows[:, :LATENTS, n:] = torch.diag_embed(sharp)
    rows[:, LATENTS:, :XI] = (_INFORMATION * weight) ** 0.5 * of_log_var
    return rows


def between_keys(x: Tensor, keys: Tensor, clips: int) -> Tensor:
    """Computes values at all frames (B frames, ...) from those at keys (B keys, ...), by linear interpolation."""
    count = int(keys[-1]) + 1
    if len(keys) == count:
        return x
    at = torch.arange(count, device=x.device)
    after = torch.searchsorted(keys, at).clamp(min=1)
    share = (at - keys[after - 1]) / (keys[after] - keys[after - 1])
    x = x.unflatten(0, (clips, -1))
    return torch.lerp(x[:, after - 1], x[:, after], share.to(x).reshape(-1, *(1,) * (x.ndim - 2))).flatten(0, 1)


def _gains_on_states(gains: Tensor, x: Tensor, frame: Frame) -> tuple[Tensor, Tensor]:
    """Gains on small changes (B, T - 1, 48, n) as gains on X (..., 345) and on what is shared (..., S)."""
    m = x[..., ADDED:].unflatten(-1, (22, 3, 3))
    omega = gains[..., ADDED:XI].unflatten(-1, (22, 3))
    # omega ~ half the vector of R R^^T - R^ R^T, linear in M = R^T: k . omega = -1/2 sum (M^ [k]) M
    turns = -0.5 * (m[:, :, None] @ rotation.skew(omega))
    cos, sin = frame.turn[:, :-1, 0, 0], frame.turn[:, :-1, 0, 1]
    angle, way = gains[..., XI], gains[..., XI + 1 : XI + GAMMA]
    place = gains.new_zeros(*gains.shape[:-1], 6)
    place[..., 0], place[..., 3] = -angle * sin[..., None], angle * cos[..., None]
    place[..., 2] = way[..., 0] * cos[..., None] - way[..., 1] * sin[..., None]
    place[..., 5] = way[..., 0] * sin[..., None] + way[..., 1] * cos[..., None]
    return torch.cat((gains[..., :ADDED], turns.flatten(-3), place), -1), gains[..., CHANGE:]


def whiten_first_state(problem: Problem, unknown: Unknowns, cost: Tensor, frames: int) -> tuple[Tensor, Tensor, Tensor]:
    """Computes ``first``, ``rest`` and ``features`` of a :class:`Whitening` from the Gauss-Newton matrix of the first
    state, shape and camera: their own terms, and ``cost``, P_0, through ``apply_change``."""
    weights, view = problem.weights.of(3, frames=frames), problem.evidence.view
    shared = cost.shape[-1] - CHANGE
    count = _FIRST + shared
    slope = first_slopes(problem, unknown, count)  # (B, n, f)
    h = slope.mT @ cost @ slope
    betas = slice(_FIRST, _FIRST + BETAS)
    h[:, betas, betas].diagonal(dim1=-2, dim2=-1).add_(2 * frames * weights.get("shape_prior", 0.0))
    if view is not None and view.free:
        moves = gauss_newton.columns(lambda more, camera: view.floor(camera + more), 3, unknown.camera)
        part = slice(_FIRST + BETAS, None)
        h[:, part, part] += frames * weights.get("floor_reg", 0.0) * moves.mT @ moves
    features = slope[:, _FEATURES]
    gmm = problem.priors.initial
    now = mixed_features(problem, unknown)
    share = gmm.each(now).softmax(-1)
    way = (share.sqrt()[..., None, None] * gmm.whitened(now, features)[1]).flatten(1, 2)  # (B, K D, f)
    whole = h + weights.get("init_motion_prior", 0.0) * (way.mT @ way).to(h)
    diagonal = whole.diagonal(dim1=-2, dim2=-1)
    ridge = 1e-4 * diagonal + 1e-5 * diagonal.mean(-1, keepdim=True) + 1e-8
    factor = factorised((whole + torch.diag_embed(ridge)).double())
    whitener = torch.linalg.solve_triangular(factor.mT, torch.eye(count).to(factor), upper=True).to(h)
    return whitener, whitener.mT @ h @ whitener, features @ whitener


def mixed_features(problem: Problem, unknown: Unknowns) -> Tensor:
    """Computes the features (B, 138) of the first state that the initial-state mixture is over."""
    first = unknowns.first_state(unknown, problem.priors)
    return priors.first_state_features(unknowns.first_state_in_heading_frame(first))


def first_slopes(problem: Problem, unknown: Unknowns, count: int) -> Tensor:
    """Computes the derivative (B, n, f) of the change of frame 0 in the first state's unknowns, shape and camera."""
    first = unknowns.first_state(unknown, problem.priors)

    def change(small: Tensor, first: Tensor) -> Tensor:
        moved = apply_change(replace(unknown, z=None), small)
        return gauss_newton.state_change(unknowns.first_state(moved, problem.priors), first)

    of_shared = torch.eye(count).to(first)[_FIRST:].expand(len(first), -1, -1)  # passed on
    return torch.cat((gauss_newton.columns(change, count, first), of_shared), 1)
