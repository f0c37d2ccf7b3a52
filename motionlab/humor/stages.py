"""The three stages of the test-time optimisation: what each minimises, and the original search for its minimum.

Source: HuMoR (Rempe et al. 2021), section 4 and its official code; thesis 3.1.2.
Differs: in lean mode L-BFGS moves preconditioned coordinates (last section).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import torch
from torch import Tensor

from motionlab.baselines import cosine_transform
from motionlab.humor import energies, state, unknowns
from motionlab.humor.energies import SIGMA, Weights
from motionlab.humor.evidence import Evidence
from motionlab.humor.priors import Priors, first_state_features
from motionlab.humor.unknowns import FIRST, Posed, Rolled, Unknowns
from motionlab.optimise import BatchFit, minimise_batch

Terms = dict[str, Tensor]
#: From the numbers that a search moves, by name, and the recordings that they are of, to the unknowns.
Back = Callable[[Mapping[str, Tensor], Tensor | slice], Unknowns]


@dataclass(frozen=True, eq=False)
class Problem:
    """What does not change while a fit looks for its unknowns.

    evidence: of B recordings. mode: "lean" or "official".
    pose, roll: how unknowns become bodies in stages 1 and 2, and in stage 3.
    """

    evidence: Evidence
    priors: Priors
    weights: Weights
    mode: str = "lean"
    pose: Callable[[Unknowns, Priors, Evidence], Posed] = unknowns.pose
    roll: Callable[[Unknowns, Priors, Evidence], Rolled] = unknowns.roll

    def rows(self, index: Tensor) -> Self:
        """Returns the same for some recordings alone."""
        return replace(self, evidence=self.evidence.rows(index))


def pose_terms(problem: Problem, unknown: Unknowns, stage: int) -> Terms:
    """Computes the weighted terms (B,) of stage 1 or 2 by name. Lean mode is smooth in stage 1 already."""
    evidence = problem.evidence
    body = problem.pose(unknown, problem.priors, evidence)
    terms = _data(body, evidence) | {
        "joints3d_smooth": energies.joints3d_smooth(body.joints),
        "pose_prior": energies.pose_prior(unknown.latent),
        "shape_prior": energies.shape_prior(body.betas, evidence.values.shape[1]),
    }
    return _weighted(terms, problem.weights.of(stage, listed=problem.mode == "lean"))


def motion_terms(problem: Problem, unknown: Unknowns, *, grown: bool = True, contacts: bool = True) -> Terms:
    """Computes the weighted terms (B,) of stage 3 by name, over as many frames as z has transitions, and one.

    grown: the first state's weight times frames / 15, as from the second sub-stage on. contacts: with those terms.
    """
    evidence = problem.evidence.first_frames(unknown.z.shape[1] + 1)
    rolled = problem.roll(unknown, problem.priors, evidence)
    return rolled_terms(problem, rolled, grown=grown, contacts=contacts)


def rolled_terms(problem: Problem, rolled: Rolled, *, grown: bool = True, contacts: bool = True) -> Terms:
    """Computes :func:`motion_terms` of a roll-out that is there already."""
    frames = rolled.states.shape[1]
    evidence = problem.evidence.first_frames(frames)
    body, own = rolled.body, state.unpack(rolled.states)["joints"]
    touching = energies.contact_probabilities(rolled.rollout.contact_logits)
    first = first_state_features(unknowns.first_state_in_heading_frame(rolled.states[:, 0]))
    terms = _data(body, evidence) | {
        "shape_prior": energies.shape_prior(body.betas, frames),
        "motion_prior": energies.motion_prior(rolled.rollout.z, rolled.rollout.prior),
        "init_motion_prior": energies.init_motion_prior(first, problem.priors.initial),
        "joint_consistency": energies.joint_consistency(body.joints, own),
        "bone_length": energies.bone_length(own),
    }
    if contacts:
        terms["contact_vel"] = energies.contact_vel(body.joints, touching)
        terms["contact_height"] = energies.contact_height(body.joints, touching)
    if evidence.view is not None and evidence.view.free:
        still = torch.zeros_like(body.camera)
        terms["floor_reg"] = energies.floor_reg(evidence.view.floor(body.camera), evidence.view.floor(still), frames)
    return _weighted(terms, problem.weights.of(3, frames=frames if grown else None))


def _data(body: Posed, evidence: Evidence) -> Terms:
    if evidence.view is None:
        return {"joints3d": energies.joints3d(body.observed, evidence.values, evidence.weight > 0)}
    return {"joints2d": energies.joints2d(body.observed, evidence.values, evidence.weight)}


def _weighted(terms: Terms, weights: Mapping[str, float]) -> Terms:
    return {n: weights[n] * terms[n] for n in terms if n in weights}


def stage_1_and_2(problem: Problem, unknown: Unknowns, stage: int, **budget) -> tuple[Unknowns, BatchFit]:
    """Runs stage 1, a search for the root alone, or stage 2, for root, pose and shape."""
    moving = ("trans", "orient") if stage == 1 else ("trans", "orient", "latent", "betas")
    if problem.mode != "lean":
        start = _as_they_are(unknown, moving)
    else:
        weights = problem.weights.of(stage, listed=True)
        unknown = replace(unknown, orient=unknowns.reorthogonalised(unknown.orient))
        start = _preconditioned(unknown, moving, problem.priors, problem.evidence, weights)
    return _search(partial(pose_terms, stage=stage), problem, *start, **budget)


def stage_3(
    problem: Problem, unknown: Unknowns, factors: Tensor | None = None, *, steps: int, short: int,
    refine: tuple[int, int], **budget,
) -> tuple[Unknowns, list[BatchFit]]:  # fmt: skip
    """Runs stage 3: the first ``short`` frames; then all, x0 frozen and without contact terms; then everything.

    factors: of ``start.start_stage_3``, or None. refine: the steps at which the second and third sub-stage begin.
    """
    camera = ("camera",) if unknown.camera is not None and problem.evidence.view.free else ()
    everything = (*FIRST, "z", "betas", *camera)
    fits: list[BatchFit] = []

    def part(unknown: Unknowns, moving: tuple[str, ...], steps: int, **how) -> Unknowns:
        if steps <= 0 or (fits and interrupted(fits[-1])):
            return unknown
        start = _as_they_are(unknown, moving) if factors is None else preconditioned_motion(unknown, moving, factors)
        found, fit = _search(partial(motion_terms, **how), problem, *start, steps=steps, **budget)
        fits.append(fit)
        return found

    frames, plan = unknown.z.shape[1] + 1, (min(refine[0], steps), min(refine[1], steps))
    if frames <= short:
        return part(unknown, everything, steps), fits
    head = part(replace(unknown, z=unknown.z[:, : short - 1]), everything, plan[0], grown=False)
    unknown = replace(head, z=torch.cat((head.z, unknown.z[:, short - 1 :]), 1))
    unknown = part(unknown, tuple(n for n in everything if n not in FIRST), plan[1] - plan[0], contacts=False)
    return part(unknown, everything, steps - plan[1]), fits


def _search(
    terms: Callable[[Problem, Unknowns], Terms], problem: Problem, start: Mapping[str, Tensor], back: Back, *,
    steps: int, inner: int, tolerance: float = 0.0, progress: bool | str = False,
    watch: Callable[[Terms], None] | None = None,
) -> tuple[Unknowns, BatchFit]:  # fmt: skip
    """All unknowns where the sum of some terms is lowest, and the optimiser's report; each recording for itself.

    start: tensors (B, ...) by name, which move. back: from such tensors to the unknowns that the terms are functions
    of. tolerance: share of its own first energy that a recording must gain in an iteration. watch: called with the
    terms of every evaluation.
    """
    with torch.no_grad():
        first = sum(terms(problem, back(start, slice(None))).values()).abs().nan_to_num(0.0, 0.0, 0.0)

    def energy(at: Mapping[str, Tensor], rows: Tensor) -> Tensor:
        found = terms(problem.rows(rows), back(at, rows))
        if watch:
            watch({n: x.detach() for n, x in found.items()})
        return sum(found.values())

    fit = minimise_batch(energy, start, steps=steps, inner=inner, tolerance_change=tolerance * first, progress=progress)
    return back(fit.variables, slice(None)).detached(), fit


def interrupted(fit) -> bool:
    """Returns whether a person stopped a search."""
    return "interrupted" in fit.reasons


# A sequence's Gauss-Newton matrix is nearly the same block H_d (data) for every frame, joined by the smoothness of its
# neighbours, H_s. The cosine transform of time makes that diagonal: for frequency k of T frames
#
#     H_k = H_d + 4 sin^2(pi k / 2T) H_s + H_p = L_k L_k^T,      x = x_0 + C^T (L_k^-T u_k)
#
# with H_p of the priors, C the orthonormal transform and u the new unknowns. Stage 3 has a factor for every latent
# (``start.start_stage_3``), and the other unknowns have the lengths over which they matter.
_OF_FRAMES = ("trans", "orient", "latent")
_SAMPLES, _STEP, _RIDGE = 8, 1e-3, 1e-3
#: Square metres, summed over the joints of a frame, that a unit of each unknown of stage 3 moves; orders of magnitude.
_REACH = {
    "trans": 22.0, "orient": 2.0, "latent": 0.1, "trans_vel": 100.0, "root_orient_vel": 10.0, "joints_vel": 10.0,
    "betas": 0.02,
}  # fmt: skip
_REACH_CAMERA = (400.0, 400.0, 25.0)  # tilt, roll, rise


def _as_they_are(unknown: Unknowns, moving: tuple[str, ...]) -> tuple[dict[str, Tensor], Back]:
    """The unknowns that move, and the way from them to all: the official search."""
    moved = {n: x.detach() for n, x in unknown.named().items() if n in moving and x.numel()}
    return moved, lambda new, rows: replace(unknown.rows(rows), **new)


def preconditioned_motion(
    unknown: Unknowns, moving: tuple[str, ...], factors: Tensor
) -> tuple[dict[str, Tensor], Back]:
    """Computes what :func:`_preconditioned` does, for stage 3; factors (B, T - 1 or more, 48, 48)."""
    frames, named = unknown.z.shape[1] + 1, unknown.named()
    scale = {n: (reach * frames) ** -0.5 for n, reach in _REACH.items()}
    scale["camera"] = (frames * unknown.trans.new_tensor(_REACH_CAMERA)).rsqrt()

    def back(new: Mapping[str, Tensor], rows: Tensor | slice) -> Unknowns:
        start = unknown.rows(rows)
        found = {n: getattr(start, n) + scale[n] * x for n, x in new.items() if n != "z"}
        if "z" in new:
            found["z"] = start.z + (factors[rows, : frames - 1] @ new["z"][..., None])[..., 0]
        return replace(start, **found)

    return {n: torch.zeros_like(named[n]) for n in moving if named[n].numel()}, back


def _preconditioned(
    unknown: Unknowns, moving: tuple[str, ...], priors: Priors, evidence: Evidence, weights: dict[str, float]
) -> tuple[dict[str, Tensor], Back]:
    """Computes new numbers to move, zeros at the start, and the way from them to the unknowns, of stages 1 and 2.
    moving: those that may change."""
    named = unknown.named()
    names = [n for n in _OF_FRAMES if n in moving]
    frames, sizes = unknown.trans.shape[1], [named[n].shape[-1] for n in names]
    data, smooth, shape = _curvature(unknown, names, priors, evidence, weights)
    prior = torch.cat([named[n].new_full((s,), 2 * weights.get("pose_prior", 0.0) * (n == "latent"))
                       for n, s in zip(names, sizes, strict=True)])  # fmt: skip
    stiff = 4 * (math.pi * torch.arange(frames) / (2 * frames)).sin().square().to(data)
    h = data[:, None] + stiff[:, None, None] * smooth[:, None]
    diagonal = h.diagonal(dim1=-2, dim2=-1)
    ridge = _RIDGE * diagonal + prior + 1e-6 + _RIDGE * diagonal.mean(-1, keepdim=True)
    factor = torch.linalg.cholesky((h + torch.diag_embed(ridge)).double())
    inverse = torch.linalg.solve_triangular(factor.mT, torch.eye(sum(sizes)).to(factor), upper=True).to(data)
    cosine = cosine_transform(frames, torch.float32).to(data)
    scale = (frames * (shape + 2 * weights.get("shape_prior", 0.0)) + 1e-3).rsqrt()

    def back(new: Mapping[str, Tensor], rows: Tensor | slice) -> Unknowns:
        start = unknown.rows(rows)
        change = cosine.mT @ (inverse[rows] @ new["frames"][..., None])[..., 0]
        parts = dict(zip(names, change.split(sizes, -1), strict=True))
        found = {n: getattr(start, n) + parts[n] for n in names}
        if "betas" in new:
            found["betas"] = start.betas + scale[rows] * new["betas"]
        return replace(start, **found)

    zeros = {"frames": data.new_zeros(len(data), frames, sum(sizes))}
    return zeros | ({"betas": torch.zeros_like(unknown.betas)} if "betas" in moving else {}), back


def _curvature(unknown: Unknowns, names, priors, evidence, weights) -> tuple[Tensor, Tensor, Tensor]:
    """H_d and H_s (B, n, n), means over some frames, and the diagonal (B, 8) for the shape; by finite differences."""
    groups, frames = unknown.trans.shape[:2]
    pick = torch.linspace(0, frames - 1, min(_SAMPLES, frames)).round().long()
    some = {n: x[:, pick] if n in _OF_FRAMES else x for n, x in unknown.named().items()}
    sizes = [some[n].shape[-1] for n in names] + [unknown.betas.shape[-1]]
    count = sum(sizes)
    shifts = dict(zip([*names, "betas"], (_STEP * torch.eye(count)).split(sizes, 1), strict=True))
    many = {}
    for n, x in some.items():  # (count + 1) copies of every recording, the first unchanged
        more = x[None].expand(count + 1, *x.shape).clone()
        if n in shifts:
            more[1:] += shifts[n].to(x).reshape(count, 1, *(1,) * (x.ndim - 2), -1)
        many[n] = more.flatten(0, 1)
    seen = evidence.rows(torch.arange(groups).repeat(count + 1))
    seen = replace(seen, values=seen.values[:, pick], weight=seen.weight[:, pick])
    with torch.no_grad():
        body = unknowns.pose(Unknowns(**many), priors, seen)
    observed, joints = (x.unflatten(0, (count + 1, groups)) for x in (body.observed, body.joints))
    now, trust = seen.values[:groups], seen.weight[:groups]
    if seen.view is None:
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
