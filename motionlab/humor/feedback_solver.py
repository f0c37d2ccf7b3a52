"""Minimises stage 3's energy by closed-loop Gauss-Newton (the feedback solver) with few linearisations.

A round differentiates all transitions at once and factorises the Gauss-Newton matrix of the whole clip
(``coordinates``). L-BFGS then lowers the energy in the coordinates in which that matrix is the identity, on exact
roll-outs whose latents are steered by feedback. Gradients are exact and of every term. The unknowns, the energy and its
minima are those of ``stages.stage_3``.

There may be a second start: after some rounds, with slopes at few frames until then, the lower one goes on. Later
rounds search several modes at once, of which each component of the initial-state mixture makes one (``mixture_modes``),
each in its own coordinates: a closure of four roll-outs takes about twice as long as one of one.

Source: thesis 3.3.4 (open); Jacobson and Mayne 1970 (the closed loop); for the modes none.
Differs: no sub-stages of 15 frames, no windows: a closed loop does not drift apart. Not multiple shooting: the states
are no unknowns of their own.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.errors import NotConverged
from motionlab.humor.coordinates import Whitening, linearised, mixed_features, unwhiten
from motionlab.humor.gauss_newton import factorised
from motionlab.humor.stages import Problem, interrupted, rolled_terms
from motionlab.humor.unknowns import Unknowns
from motionlab.optimise import BatchFit, minimise_batch

_LEAST_STEP = 0.05  # of what a round must gain
_RIDGE = 1e-4  # of the matrix that modes share
_TRIAL_STRIDE = 4  # frames between those at which networks are differentiated before the first jumps, at least


@dataclass(frozen=True)
class Plan:
    """How much work the feedback solver does.

    rounds: linearisations at most. closures: of L-BFGS after each. tolerance: a clip is done when a round gains less
    than this share of its energy's size, or less energy per frame than ``min_gain``; and a round when a step, and then
    one down the gradient, gain less than a twentieth of that share. stride: frames between those at which the networks
    are differentiated. mode_jumps: components of the first state's mixture whose modes a clip tries in a round
    (``mixture_modes``), if they promise more. halving_after: where a clip jumps, closures after which only the lowest
    search of each clip goes on; where that is the one that stayed, the clip jumps no more. 0: all go on, in every
    round. trial_rounds: before the first jumps; a second start, if there is one, goes along in them, else never.
    ridge: added to the matrix of z; damping: instead of it in the first rounds, where the matrix is too sure of itself.
    """

    rounds: int = 25
    closures: int = 30
    tolerance: float = 1e-3
    stride: int = 1
    mode_jumps: int = 3
    trial_rounds: int = 2
    ridge: float = 1e-6
    damping: tuple[float, ...] = ()
    min_gain: float = 0.0
    halving_after: int = 0

    def __post_init__(self) -> None:
        if min(self.rounds, self.closures, self.stride) < 1 or min(self.mode_jumps, self.trial_rounds) < 0:
            raise ValueError(f"rounds, closures, stride: expected 1 or more, jumps, trial: 0 or more, got {self}")
        if self.halving_after and not 0 < self.halving_after < self.closures - 1:
            raise ValueError(f"halving_after: expected closures and two more to be left after it, got {self}")


def solve(
    problem: Problem, unknown: Unknowns, plan: Plan | None = None, *, second_start: Unknowns | None = None,
    linearise: Callable[..., Whitening] = linearised, note: Callable[[], None] = lambda: None,
    progress: bool | str = False,
) -> tuple[Unknowns, list[BatchFit]]:  # fmt: skip
    """Runs the feedback solver from unknowns (G, ...); Ctrl-C keeps the best so far.

    second_start: of the same recordings; after the plan's trial rounds the lower one of each goes on. linearise: called
    as ``coordinates.linearised``; another for ablations. note: called whenever energies are known.

    Returns:
        the unknowns of lowest energy, and the reports of all rounds, of all clips; of one that is done: "no decrease".
    Raises:
        ShapeError: recordings of one frame.
        NotConverged: no clip has a finite energy and gradient at the start.
    """
    plan, clips = plan or Plan(), len(unknown.z)
    unknown = unknown.map(lambda x: x.detach().clone())
    if second_start is not None and plan.trial_rounds:
        other = second_start.named()
        unknown = Unknowns(**{name: torch.cat((x, other[name].detach())) for name, x in unknown.named().items()})
    mark, fits = time.perf_counter(), []
    energy = unknown.betas.new_full((len(unknown.betas),), float("inf"))
    live = every = best = torch.arange(len(energy), device=energy.device)
    other = [(x != x[live % clips]).flatten(1).any(1) for x in unknown.named().values()]
    live = live[torch.stack(other).any(0) | (live < clips)]  # a second start that is the first is none
    jumping = torch.ones_like(energy, dtype=torch.bool)
    for count in range(plan.rounds):
        if count == plan.trial_rounds:
            live = live[torch.isin(live, best)]
        if not len(live):
            break
        trial = count < plan.trial_rounds
        now = replace(plan, mode_jumps=0, stride=max(plan.stride, _TRIAL_STRIDE)) if trial else plan
        now = replace(now, ridge=(*plan.damping, plan.ridge)[min(count, len(plan.damping))])
        here, name = unknown.rows(live), progress and f"{progress}, round {count + 1} of at most {plan.rounds}"
        try:
            size = energy[live].abs().nan_to_num(posinf=0.0)  # 0: not known yet
            found, fit, jumping[live] = _round(
                problem.rows(live % clips), here, size, jumping[live], now, linearise, note, name
            )
        except (KeyboardInterrupt, NotConverged) as ended:
            if not fits:
                raise
            if isinstance(ended, KeyboardInterrupt):
                fits[-1] = replace(fits[-1], reasons=["interrupted"] * clips)
            break  # else what is left cannot be differentiated: it stays where it was
        gain = energy[live] - fit.energy
        better = gain > 0
        for kept, new in zip(unknown.named().values(), found.named().values(), strict=True):
            kept[live[better]] = new[better]
        energy[live[better]] = fit.energy[better]
        ran = dict(zip(live.tolist(), fit.reasons, strict=True))  # those that are done stay at their energy
        reasons = [ran.get(row, "no decrease") for row in range(len(energy))]
        history = energy.expand(len(fit.history), -1).index_copy(1, live, fit.history)
        whole = BatchFit({}, energy.clone(), history, time.perf_counter() - mark, reasons)
        best, report = _of_clips(whole, every % clips)
        fits.append(report)
        done = (plan.tolerance * energy[live].abs()).clamp(min=plan.min_gain * (unknown.z.shape[1] + 1))
        mark, live = time.perf_counter(), live if trial else live[gain > done]
        if interrupted(fit):
            break
    return unknown.rows(best), fits


def _round(
    problem: Problem, unknown: Unknowns, size: Tensor, jumping: Tensor, plan: Plan, linearise: Callable[..., Whitening],
    note: Callable[[], None], progress: bool | str,
) -> tuple[Unknowns, BatchFit, Tensor]:  # fmt: skip
    """One linearisation and the searches around it: from where a clip is, and from where it may jump to. size (B,): of
    each clip's energy. jumping: bool (B,), clips that may jump; returned anew."""
    clips = len(size)
    white = linearise(problem, unknown, ridge=plan.ridge, stride=plan.stride)
    who, whitener, first = _starts(problem, unknown, white, jumping, plan)
    how, enough = {"note": note, "progress": progress}, _LEAST_STEP * plan.tolerance * size
    race = plan.halving_after if len(who) > clips else 0
    args = who, whitener, first, race or plan.closures
    rows, fit = minimise_from(problem, unknown, white, *args, enough=enough[who], **how)
    found, (best, fit) = fit.variables, _of_clips(fit, who)
    rows = rows.rows(best)
    if not race or interrupted(fit):
        return rows, fit, jumping
    args = who[best], whitener[best], found["first"][best], plan.closures - race
    try:
        rows, more = minimise_from(problem, unknown, white, *args, nu=found["nu"][best], enough=enough, **how)
    except KeyboardInterrupt:  # before its first energy
        return rows, replace(fit, reasons=["interrupted"] * clips), jumping
    tried = torch.isin(torch.arange(clips, device=who.device), who[clips:])
    whole = replace(more, history=torch.cat((fit.history, more.history)))
    return rows, whole, jumping & ((best >= clips) | ~tried)


def minimise_from(
    problem: Problem, unknown: Unknowns, white: Whitening, who: Tensor, whitener: Tensor, first: Tensor, closures: int,
    *, nu: Tensor | None = None, enough: float | Tensor = 0.0, note: Callable[[], None] = lambda: None,
    progress: bool | str = False,
) -> tuple[Unknowns, BatchFit]:  # fmt: skip
    """Minimises the energy from R starts around one linearisation; row r belongs to clip who[r] and starts at first (R,
    f), in coordinates of its own: whitener (R, f, f) in place of ``Whitening.first``.

    nu: where its latents start, (R, T - 1, 48); default 0. enough: a row is done when a step, and then one down the
    gradient, gain no more than this, (R,) or one number.
    """
    some, here = problem.rows(who), unknown.rows(who)
    around = white.rows(who)._replace(first=whitener)

    def energy(new: Mapping[str, Tensor], rows: Tensor) -> Tensor:
        every = some, here, around  # gains are large: no copies while all run
        these, at, near = every if len(rows) == len(who) else (each.rows(rows) for each in every)
        at, rolled = unwhiten(these, at, near, new)
        found = sum(rolled_terms(these, rolled).values())
        note()
        return found

    start = {"nu": torch.zeros_like(here.z) if nu is None else nu, "first": first}
    how = {"inner": closures, "max_closures": closures, "tolerance_change": enough}
    fit = minimise_batch(energy, start, steps=1, unit=True, progress=progress, **how)
    with torch.no_grad():
        at, rolled = unwhiten(some, here, around, fit.variables)
    return replace(at, z=rolled.rollout.z), fit


def _of_clips(fit: BatchFit, who: Tensor) -> tuple[Tensor, BatchFit]:
    """Of each clip the row (G,) of lowest energy, and the report of rows as one of clips ``who``."""
    clips = int(who.max()) + 1
    mine = who == torch.arange(clips, device=who.device)[:, None]  # (G, R)
    best = torch.where(mine, fit.energy, torch.inf).argmin(1)
    best = torch.where(fit.energy[best].isfinite(), best, mine.double().argmax(1))
    history = torch.where(mine, fit.history.nan_to_num(nan=torch.inf)[:, None], torch.inf).amin(-1)
    stopped = {w for w, reason in zip(who.tolist(), fit.reasons, strict=True) if reason == "interrupted"}
    reasons = ["interrupted" if clip in stopped else fit.reasons[row] for clip, row in enumerate(best.tolist())]
    return best, BatchFit({}, fit.energy[best], history, fit.seconds, reasons)


# A search stays with the component of the mixture that it begins in: on the way to another the density is next to
# nothing. All other terms are nearly quadratic in the change d of the first state and of what is shared, while nu = 0
# and later latents give way. So the least of the energy with component k alone,
#
#     E_k = min_d  g d + 1/2 d H d + w (1/2 |W_k (f + F d - m_k)|^2 - c_k),
#
# is a linear system, whose matrix gives a jump the coordinates to search in. g: gradient of all terms but the
# mixture's. H: their matrix (``Whitening.rest``). f, F: the first state's features and how they move. W_k, m_k, c_k:
# whitener, mean and constant of the component; w: its weight.
def _starts(
    problem: Problem, unknown: Unknowns, white: Whitening, jumping: Tensor, plan: Plan
) -> tuple[Tensor, Tensor, Tensor]:
    """Where searches begin: whose each of R rows is (R,), its whitener (R, f, f) of the first state and what is shared,
    and its beginning in these coordinates (R, f). First all clips where they are, then the jumps of those that may, to
    where the energy should be lower by more than the plan's tolerance, the mode of its own component included."""
    clips, size = white.first.shape[:2]
    stay, here = torch.arange(clips, device=white.first.device), white.first.new_zeros(clips, size)
    if not (plan.mode_jumps and jumping.any() and _weight(problem, unknown)):
        return stay, white.first, here
    found = mixture_modes(problem, unknown, white)
    gain, which = found.gain.topk(min(plan.mode_jumps, found.gain.shape[1]), 1)
    worth = gain > plan.tolerance * found.energy.abs()[:, None]
    who, k = (worth & jumping[:, None]).nonzero().unbind(1)
    whitener, begin = in_mode(white, found, who, which[who, k])
    return torch.cat((stay, who)), torch.cat((white.first, whitener)), torch.cat((here, begin))


class MixtureModes(NamedTuple):
    """For each mixture component of the first state, how much lower the energy should be there: energy (B,) now, gain
    (B, K), where that is (B, K, f), and its matrix (B, K, f, f), both in the coordinates of ``Whitening.first``."""

    energy: Tensor
    gain: Tensor
    where: Tensor
    matrix: Tensor


def in_mode(white: Whitening, found: MixtureModes, who: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
    """Computes whiteners (R, f, f) and beginnings (R, f) of searches in modes: component which (R,) of clip who (R,).

    In the coordinates of another, of another width by far, the search would leave the mode again.
    """
    factor = factorised(found.matrix[who, which])
    whitener = torch.linalg.solve_triangular(factor.mT, white.first[who].to(factor), upper=True, left=False)
    begin = (factor.mT @ found.where[who, which, :, None])[..., 0]
    return whitener.to(white.first), begin.to(white.first)


def mixture_modes(problem: Problem, unknown: Unknowns, white: Whitening) -> MixtureModes:
    """Computes, for each mixture component of the first state, how much lower the energy should be there."""
    clips, size = white.first.shape[:2]
    weight, gmm = _weight(problem, unknown), problem.priors.initial
    new = {"nu": torch.zeros_like(unknown.z), "first": white.first.new_zeros(clips, size).requires_grad_()}
    with torch.enable_grad():
        terms = rolled_terms(problem, unwhiten(problem, unknown, white, new)[1])
        whole = sum(terms.values())
        rest = whole - terms.get("init_motion_prior", 0.0)
        g = torch.autograd.grad(rest.sum(), new["first"])[0].double()
    with torch.no_grad():
        f = mixed_features(problem, unknown)
        off, way, constant = gmm.whitened(f, white.features)
        h = white.rest.double() + _RIDGE * torch.eye(size, dtype=torch.float64, device=g.device)
        matrix = h[:, None] + weight * way.mT @ way
        toward = -g[:, None] - weight * (way.mT @ off[..., None])[..., 0]
        d = torch.linalg.solve_ex(matrix, toward[..., None])[0][..., 0]
        change = 0.5 * (d[..., None, :] @ h[:, None] @ d[..., None])[..., 0, 0] + (d * g[:, None]).sum(-1)
        least = change + weight * (0.5 * (off + (way @ d[..., None])[..., 0]).square().sum(-1) - constant)
        now = -weight * gmm.log_prob(f).double()
    gain = (now[:, None] - least).nan_to_num(nan=-torch.inf)
    return MixtureModes(whole.detach(), gain.to(whole), d, matrix)


def _weight(problem: Problem, unknown: Unknowns) -> float:
    return problem.weights.of(3, frames=unknown.z.shape[1] + 1).get("init_motion_prior", 0.0)
