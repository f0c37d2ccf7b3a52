"""The stages in coordinates in which their energy is nearly round, so that L-BFGS needs few steps.

A sequence's Gauss-Newton matrix is nearly the same block H_d (data) for every frame, joined by the smoothness of its
neighbours, H_s. The cosine transform of time makes that diagonal: for frequency k of T frames

    H_k = H_d + 4 sin^2(pi k / 2T) H_s + H_p = L_k L_k^T,      x = x_0 + C^T (L_k^-T u_k)

with H_p of the priors, C the orthonormal transform and u the new unknowns. H_d and H_s are means over a few frames, by
finite differences at the start. Stage 3 has a factor for every latent (``transitions.start``), and the other unknowns
have the lengths over which they matter. The minimum stays what it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from motionlab.humor import variables
from motionlab.humor.energies import SIGMA
from motionlab.humor.observed import Evidence
from motionlab.humor.priors import Priors
from motionlab.humor.variables import Variables

Back = Callable[..., dict[str, Tensor]]
FRAMES = ("trans", "orient", "latent")
_SAMPLES, _STEP, _RIDGE = 8, 1e-3, 1e-3

#: Square metres, summed over the joints of a frame, that a unit of each unknown of stage 3 moves; orders of magnitude.
_REACH = {
    "trans": 22.0, "orient": 2.0, "latent": 0.1, "trans_vel": 100.0, "root_orient_vel": 10.0, "joints_vel": 10.0,
    "betas": 0.02,
}  # fmt: skip
_REACH_CAMERA = (400.0, 400.0, 25.0)  # tilt, roll, rise


def rounded_motion(unknown: Variables, moving: tuple[str, ...], factors: Tensor) -> tuple[dict[str, Tensor], Back]:
    """As :func:`rounded`, for stage 3; factors (G, W, L - 1, 48, 48), of which as many count as z has transitions."""
    frames = unknown["z"].shape[2] + 1
    factors = factors[:, :, : frames - 1]
    scale = {n: (reach * frames) ** -0.5 for n, reach in _REACH.items()}
    scale["camera"] = (frames * unknown["trans"].new_tensor(_REACH_CAMERA)).rsqrt()

    def old(new: Variables, rows: Tensor | slice = slice(None)) -> dict[str, Tensor]:
        start = {n: x[rows] for n, x in unknown.items()}
        found = {n: start[n] + scale[n] * x for n, x in new.items() if n != "z"}
        if "z" in new:
            found["z"] = start["z"] + (factors[rows] @ new["z"][..., None])[..., 0]
        return {**start, **found}

    return {n: torch.zeros_like(unknown[n]) for n in moving if unknown[n].numel()}, old


def rounded(
    unknown: Variables, moving: tuple[str, ...], priors: Priors, evidence: Evidence, weights: dict[str, float]
) -> tuple[dict[str, Tensor], Back]:
    """New unknowns, zeros at the start, and the way from them to the old ones, of all recordings or of some rows.

    unknown: of stages 1 and 2 with one window each, (G, 1, T, ...). moving: those that may change.
    """
    names = [n for n in FRAMES if n in moving]
    frames, sizes = unknown["trans"].shape[2], [unknown[n].shape[-1] for n in names]
    data, smooth, shape = _curvature(unknown, names, priors, evidence, weights)
    prior = torch.cat([unknown[n].new_full((s,), 2 * weights.get("pose_prior", 0.0) * (n == "latent"))
                       for n, s in zip(names, sizes, strict=True)])  # fmt: skip
    stiff = 4 * (math.pi * torch.arange(frames) / (2 * frames)).sin().square().to(data)
    h = data[:, None] + stiff[:, None, None] * smooth[:, None]
    diagonal = h.diagonal(dim1=-2, dim2=-1)
    ridge = _RIDGE * diagonal + prior + 1e-6 + _RIDGE * diagonal.mean(-1, keepdim=True)
    factor = torch.linalg.cholesky((h + torch.diag_embed(ridge)).double())
    unit = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    back = torch.linalg.solve_triangular(factor.mT, unit.expand_as(factor), upper=True).to(data)
    cosine = _cosine(frames).to(data)
    scale = (frames * (shape + 2 * weights.get("shape_prior", 0.0)) + 1e-3).rsqrt()

    def old(new: Variables, rows: Tensor | slice = slice(None)) -> dict[str, Tensor]:
        start = {n: x[rows] for n, x in unknown.items()}
        change = cosine.mT @ (back[rows] @ new["frames"][..., None])[..., 0]
        parts = dict(zip(names, change.split(sizes, -1), strict=True))
        found = {n: start[n] + parts[n][:, None] for n in names}
        if "betas" in new:
            found["betas"] = start["betas"] + scale[rows] * new["betas"]
        return {**start, **found}

    zeros = {"frames": data.new_zeros(len(data), frames, sum(sizes))}
    return zeros | ({"betas": torch.zeros_like(unknown["betas"])} if "betas" in moving else {}), old


def _curvature(unknown, names, priors, evidence, weights) -> tuple[Tensor, Tensor, Tensor]:
    """H_d and H_s (G, n, n), means over some frames, and the diagonal (G, 8) for the shape; by finite differences."""
    groups, _, frames = unknown["trans"].shape[:3]
    pick = torch.linspace(0, frames - 1, min(_SAMPLES, frames)).round().long()
    some = {n: x[:, :, pick] if n in FRAMES else x for n, x in unknown.items()}
    sizes = [some[n].shape[-1] for n in names] + [unknown["betas"].shape[-1]]
    count = sum(sizes)
    shifts = dict(zip([*names, "betas"], (_STEP * torch.eye(count)).split(sizes, 1), strict=True))
    many = {}
    for n, x in some.items():  # (count + 1) copies of every recording, the first unchanged
        more = x[None].expand(count + 1, *x.shape).clone()
        if n in shifts:
            more[1:] += shifts[n].to(x).reshape(count, 1, *(1,) * (x.ndim - 2), -1)
        many[n] = more.flatten(0, 1)
    rows = torch.arange(groups).repeat(count + 1)
    seen = evidence.pieces(torch.tensor([0]), frames)
    values, weight = seen.values[rows][:, pick], seen.weight[rows][:, pick]
    view = None if seen.view is None else seen.view.rows(rows)
    with torch.no_grad():
        body = variables.pose(many, priors, Evidence(values, weight, seen.fps, view))
    observed, joints = (x.unflatten(0, (count + 1, groups)) for x in (body.observed, body.joints))
    now, trust = values[:groups], weight[:groups]
    if view is None:
        importance = weights.get("joints3d", 0.0) * trust[..., None].expand_as(now)
    else:
        robust = (SIGMA**2 / (SIGMA**2 + (observed[0] - now).square())).square()
        importance = 2 * weights.get("joints2d", 0.0) * trust.square()[..., None] * robust
    scaled = (importance.sqrt() * (observed[1:] - observed[0]) / _STEP).flatten(3)  # (n + 8, G, S, .)
    moved = ((joints[1:] - joints[0]) / _STEP).flatten(3)
    data = torch.einsum("igsk,jgsk->gij", scaled, scaled) / len(pick)
    smooth = weights.get("joints3d_smooth", 0.0) * torch.einsum("igsk,jgsk->gij", moved, moved) / len(pick)
    n = count - sizes[-1]
    return data[:, :n, :n], smooth[:, :n, :n], data.diagonal(dim1=-2, dim2=-1)[:, n:]


def _cosine(frames: int) -> Tensor:
    """The orthonormal cosine transform (T, T) of type II: C x are the coefficients of x (T, ...)."""
    k, t = torch.arange(frames)[:, None], torch.arange(frames)
    c = (math.pi * k * (t + 0.5) / frames).cos() * (2 / frames) ** 0.5
    c[0] /= 2**0.5
    return c
