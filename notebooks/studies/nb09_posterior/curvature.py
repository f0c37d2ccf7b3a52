"""The curvature of stage 3's energy in nats, and the directions in which what was hidden moves while it hardly rises.

Every term is half a sum of squares near a fit, E/w = 1/2 |R(q)|^2, with w the motion prior's weight, so that a nat is a
nat of that prior. With R' by finite differences of the whole roll-out,

    H = R'^T R' + ridge,      q ~ N(q*, H^-1)   (Laplace's posterior)

and hidden joints x = x* + A (q - q*) have the covariance A H^-1 A^T. Its eigenvectors are the ways in which they may
still move, and H^-1 A^T of each says how all unknowns go along. ``directions`` takes any H and A: of a solver, say.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.errors import check_shape
from motionlab.humor import energies, priors, state, unknowns
from motionlab.humor.energies import SIGMA
from motionlab.humor.stages import Problem
from motionlab.humor.unknowns import Rolled, Unknowns


class Directions(NamedTuple):
    """The k ways in which hidden joints may move most, by size.

    vectors (N, k): in the unknowns, one posterior standard deviation each, v^T H v = 1. spread (k,): how far each moves
    the joints, the root of the sum of squares over all their coordinates. shapes (M, k): orthonormal, how. share: of
    the hidden joints' variance in these k. rest (N, m): what is left, as so many independent vectors of unit size.
    """

    vectors: Tensor
    spread: Tensor
    shapes: Tensor
    share: float
    rest: Tensor


def directions(hessian: Tensor, slopes: Tensor, count: int) -> Directions:
    """The directions of q ~ N(0, H^-1) that move x = A q most.

    hessian (N, N): symmetric, positive definite. slopes (M, N): A.
    """
    check_shape(hessian, "N N", "hessian")
    check_shape(slopes, f"M {len(hessian)}", "slopes")
    factor = torch.linalg.cholesky(hessian.double())
    white = torch.linalg.solve_triangular(factor, slopes.double().mT, upper=False)  # (N, M)
    u, spread, v = torch.linalg.svd(white, full_matrices=False)
    sign = v.gather(1, v.abs().argmax(1, keepdim=True)).sign()  # what moves most moves up the axis: rounding has no say
    u, v = u * sign[:, 0], v * sign
    vectors = torch.linalg.solve_triangular(factor.mT, u, upper=True)
    variance = spread.square()
    share = float(variance[:count].sum() / variance.sum())
    return Directions(vectors[:, :count], spread[:count], v[:count].mT, share, vectors[:, count:])


def slopes_of(
    function: Callable[[Tensor], tuple[Tensor, ...]], size: int, *, step: float, chunk: int = 128
) -> list[Tensor]:
    """Derivatives (M_i, N) at 0 of functions of q (B, N) by forward differences, ``chunk`` points at a time.

    function: (B, N) -> one (B, M_i) for each.
    """
    with torch.no_grad():
        base = function(torch.zeros(1, size))
        found = [[] for _ in base]
        for part in (step * torch.eye(size)).split(chunk):
            for kept, now, zero in zip(found, function(part), base, strict=True):
                kept.append((now - zero) / step)
    return [torch.cat(parts).mT.double() for parts in found]


def residuals(problem: Problem, unknown: Unknowns, rolled: Rolled, like: Rolled) -> Tensor:
    """R (B, M) whose half square is, to second order at the roll-out ``like``, the energy in nats; weights that depend
    on the point (robust ones, the mixture's) are frozen there. The floor's one-sided term has no curvature and is out.

    Differs: the normaliser of the prior's variances, which are functions of the state, is left out.
    """
    seen, frames = problem.evidence, rolled.states.shape[1]
    weight = problem.weights.of(3, frames=frames)
    scale = {name: (value / weight["motion_prior"]) ** 0.5 for name, value in weight.items()}
    body, own = rolled.body, state.unpack(rolled.states)["joints"]
    z, prior = rolled.rollout.z, rolled.rollout.prior
    parts = [
        _seen(seen.short(frames), body.observed, like.body.observed, scale),
        scale["shape_prior"] * (2 * frames) ** 0.5 * body.betas,
        (z - prior.mean) * (-0.5 * prior.log_var).exp(),
        scale["joint_consistency"] * (body.joints - own),
        scale["bone_length"] * _lengths(own).diff(dim=1),
    ]
    if "init_motion_prior" in scale:
        parts.append(scale["init_motion_prior"] * _first(problem.priors.initial, rolled, like))
    if "contact_vel" in scale:
        touching = energies.contact_probabilities(rolled.rollout.contact_logits).sqrt()
        steps = body.joints[:, :, energies.CONTACT_JOINTS].diff(dim=1)
        parts.append(scale["contact_vel"] * touching[:, 1:, :, None] * steps)
    return torch.cat([part.flatten(1) for part in parts], 1)


def _seen(seen, points: Tensor, at: Tensor, scale: dict[str, float]) -> Tensor:
    away = points - seen.values
    if seen.view is None:
        return scale["joints3d"] * (seen.weight > 0)[..., None] * away
    robust = SIGMA**2 / (SIGMA**2 + (at - seen.values).square())
    return scale["joints2d"] * math.sqrt(2.0) * seen.weight[..., None] * robust * away


def _first(mixture: priors.InitGmm, rolled: Rolled, like: Rolled) -> Tensor:
    """Of the first state, (B, K D): each component's own, by the root of its share at ``like``."""
    here, there = (
        priors.first_state_features(unknowns.local_first(each.states[:, 0])).double() for each in (rolled, like)
    )
    share = mixture.each(there).softmax(-1).sqrt()
    rows = torch.linalg.inv(torch.linalg.cholesky(mixture.covariances.double()))
    white = (rows @ (here[:, None, :] - mixture.means.double())[..., None])[..., 0]
    return (share[..., None] * white).to(rolled.states)


def _lengths(joints: Tensor) -> Tensor:
    return torch.linalg.vector_norm(joints[..., 1:, :] - joints[..., energies.BONE_PARENTS, :], dim=-1)
