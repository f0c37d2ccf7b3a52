"""The three stages of the test-time optimisation: what each minimises, and how stage 3 begins.

Source: HuMoR (Rempe et al. 2021), section 4 and its official code; thesis 3.1.2.
Differs: see :mod:`motionlab.humor.testops`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor

from motionlab.humor import energies, faithful_variables, init_gmm, preconditioned, state, variables
from motionlab.humor.observed import Evidence
from motionlab.humor.priors import Priors
from motionlab.humor.variables import Posed, Variables
from motionlab.humor.weights import Weights
from motionlab.optimise_batch import BatchFit, minimise_batch

#: x0, the first state's unknowns.
FIRST = ("trans", "orient", "latent", "trans_vel", "root_orient_vel", "joints_vel")
CONTACT_TERMS = ("contact_vel", "contact_height")
OVERLAP = 2.0  # of the weight of joint_consistency: the official 200 beside 100


@dataclass(frozen=True, eq=False)
class Problem:
    """What does not change while a fit looks for its unknowns.

    evidence: of B = G W rows. starts (W,): first frame of each window in its recording. mode: "lean" or "faithful".
    """

    evidence: Evidence
    priors: Priors
    weights: Weights
    mode: str = "lean"
    starts: tuple[int, ...] = (0,)

    @property
    def form(self):
        """What turns unknowns into bodies: ``variables``, or at the official price ``faithful_variables``."""
        return faithful_variables if self.mode == "faithful" else variables

    @property
    def rolled_windows(self) -> int:
        """Windows W per recording."""
        return len(self.starts)

    def rows(self, index: Tensor) -> Problem:
        """The same for some recordings alone."""
        every = index[:, None] * len(self.starts) + torch.arange(len(self.starts), device=index.device)
        return replace(self, evidence=self.evidence.rows(every.flatten()))


Terms = dict[str, Tensor]


def _data(problem: Problem, body: Posed, evidence: Evidence) -> Terms:
    if evidence.view is None:
        return {"joints3d": energies.joints3d(body.observed, evidence.values, evidence.weight > 0)}
    return {"joints2d": energies.joints2d(body.observed, evidence.values, evidence.weight)}


def pose_terms(problem: Problem, unknown: Variables, stage: int) -> Terms:
    """Weighted terms (G,) of stage 1 or 2, by name. Lean mode is smooth in stage 1 already, where that is listed."""
    evidence = problem.evidence
    body = problem.form.pose(unknown, problem.priors, evidence)
    terms = _data(problem, body, evidence) | {
        "joints3d_smooth": energies.joints3d_smooth(body.joints),
        "pose_prior": energies.pose_prior(variables.rows(unknown, "latent")),
        "shape_prior": energies.shape_prior(body.betas, evidence.values.shape[1]),
    }
    return _weighted(terms, problem.weights.of(stage, listed=problem.mode == "lean"), unknown)


def motion_terms(problem: Problem, unknown: Variables, *, grown: bool = True, contacts: bool = True) -> Terms:
    """Weighted terms (G,) of stage 3, by name.

    The roll-out has as many frames as z has transitions, and one.

    Args:
        grown: the first state's weight times frames / 15, as from the second sub-stage on.
        contacts: with the contact terms.
    """
    evidence = problem.evidence.short(unknown["z"].shape[2] + 1)
    rolled = problem.form.roll(unknown, problem.priors, evidence)
    return rolled_terms(problem, unknown, rolled, grown=grown, contacts=contacts)


def rolled_terms(
    problem: Problem, unknown: Variables, rolled: variables.Rolled, *, grown: bool = True, contacts: bool = True
) -> Terms:
    """:func:`motion_terms` of a roll-out that is there already."""
    frames = rolled.states.shape[1]
    evidence = problem.evidence.short(frames)
    body, own = rolled.body, state.unpack(rolled.states)["joints"]
    touching = energies.contact_probabilities(rolled.rollout.contact_logits)
    first = init_gmm.features(variables.local_first(rolled.states[:, 0]))
    terms = _data(problem, body, evidence) | {
        "shape_prior": energies.shape_prior(body.betas, frames),
        "motion_prior": energies.motion_prior(rolled.rollout.z, rolled.rollout.prior),
        "init_motion_prior": energies.init_motion_prior(first, problem.priors.initial),
        "joint_consistency": energies.joint_consistency(body.joints, own),
        "bone_length": energies.bone_length(own),
    }
    if contacts:
        terms |= {name: getattr(energies, name)(body.joints, touching) for name in CONTACT_TERMS}
    if evidence.view is not None and evidence.view.free:
        still = torch.zeros_like(body.camera)
        terms["floor_reg"] = energies.floor_reg(evidence.view.floor(body.camera), evidence.view.floor(still), frames)
    weight = problem.weights.of(3, frames=frames if grown else None)
    found = _weighted(terms, weight, unknown)
    if len(problem.starts) > 1 and grown:
        together = OVERLAP * problem.weights.joint_consistency[2]
        found["overlap"] = together * _overlap(body.joints, problem.starts)
    return found


def _weighted(terms: Terms, weights: Mapping[str, float], unknown: Variables) -> Terms:
    groups = unknown["trans"].shape[:2]
    return {n: weights[n] * terms[n].unflatten(0, groups).sum(1) for n in terms if n in weights}


def _overlap(joints: Tensor, starts: tuple[int, ...]) -> Tensor:
    """1/2 sum |J - J'|^2 + |dJ - dJ'|^2 over the frames that neighbouring windows share: (G,)."""
    joints = joints.unflatten(0, (-1, len(starts)))
    length, total = joints.shape[2], 0.0
    for w, step in enumerate(b - a for a, b in pairwise(starts)):
        gap = joints[:, w, step:] - joints[:, w + 1, : length - step]
        total = total + 0.5 * (gap.square().sum((1, 2, 3)) + gap.diff(dim=1).square().sum((1, 2, 3)))
    return total


def search(
    terms: Callable[[Problem, Variables], Terms],
    problem: Problem,
    unknown: Variables,
    moving: tuple[str, ...],
    old: preconditioned.Back = lambda new, rows: new,
    *,
    steps: int,
    inner: int,
    tolerance: float = 0.0,
    progress: bool = False,
) -> tuple[dict[str, Tensor], BatchFit]:
    """Lower the sum of some terms by moving some unknowns, each recording for itself; all unknowns come back.

    A recording that is done costs nothing more.
    old: the way from ``unknown`` of some recordings, and their numbers, to what the terms are functions of.
    tolerance: share of its own first energy that a recording must gain in an iteration, whatever its neighbours are.
    """
    point = {n: x.detach().clone().requires_grad_(n in moving and x.numel() > 0) for n, x in unknown.items()}
    every = torch.arange(len(next(iter(unknown.values()))))
    with torch.no_grad():
        first = sum(terms(problem, old(point, every)).values()).abs().nan_to_num(0.0, 0.0, 0.0)
    fit = minimise_batch(
        lambda at, rows: sum(terms(problem.rows(rows), old(at, rows)).values()),
        point,
        rows=True,
        steps=steps,
        inner=inner,
        tolerance_change=tolerance * first,
        progress=progress,
    )
    return {**{n: x.detach() for n, x in point.items()}, **fit.variables}, fit


def stage_1_and_2(problem: Problem, unknown: Variables, stage: int, **budget) -> tuple[dict[str, Tensor], BatchFit]:
    """Root alone (1), or root, pose and shape (2); lean mode searches in rounder coordinates."""
    moving = ("trans", "orient") if stage == 1 else ("trans", "orient", "latent", "betas")
    if problem.mode != "lean":
        return search(partial(pose_terms, stage=stage), problem, unknown, moving, **budget)
    weights = problem.weights.of(stage, listed=True)
    new, old = preconditioned.rounded(unknown, moving, problem.priors, problem.evidence, weights)
    found, fit = search(partial(pose_terms, stage=stage), problem, new, tuple(new), old, **budget)
    return {n: x.detach() for n, x in old(found).items()}, fit


def stage_3(
    problem: Problem,
    unknown: Variables,
    factors: Tensor | None = None,
    *,
    steps: int,
    short: int,
    refine: tuple[int, int],
    **budget,
) -> tuple[dict[str, Tensor], list[BatchFit]]:
    """First the first ``short`` frames; then all, x0 frozen and without contact terms; then everything.

    factors: of ``transitions.start``; without them the search is in the unknowns as they are.
    refine: the steps at which the second and the third sub-stage begin.
    """
    camera = ("camera",) if "camera" in unknown and problem.evidence.view.free else ()
    everything = (*FIRST, "z", "betas", *camera)
    fits: list[BatchFit] = []

    def part(unknown: Variables, moving: tuple[str, ...], steps: int, **how) -> dict[str, Tensor]:
        if steps <= 0 or (fits and interrupted(fits[-1])):
            return dict(unknown)
        if factors is None:
            found, fit = search(partial(motion_terms, **how), problem, unknown, moving, steps=steps, **budget)
        else:
            new, old = preconditioned.rounded_motion(unknown, moving, factors)
            found, fit = search(partial(motion_terms, **how), problem, new, tuple(new), old, steps=steps, **budget)
            found = old(found)
        fits.append(fit)
        return {n: x.detach() for n, x in found.items()}

    frames, plan = unknown["z"].shape[2] + 1, (min(refine[0], steps), min(refine[1], steps))
    if frames <= short:
        return part(unknown, everything, steps), fits
    head = part({**unknown, "z": unknown["z"][:, :, : short - 1]}, everything, plan[0], grown=False)
    unknown = {**head, "z": torch.cat((head["z"], unknown["z"][:, :, short - 1 :]), 2)}
    unknown = part(unknown, tuple(n for n in everything if n not in FIRST), plan[1] - plan[0], contacts=False)
    return part(unknown, everything, steps - plan[1]), fits


def interrupted(fit) -> bool:
    """Whether a person stopped a search."""
    return "interrupted" in fit.reasons
