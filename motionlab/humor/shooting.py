"""Stage 3 by closed-loop Gauss-Newton: few, expensive looks at the whole roll-out instead of many cheap ones.

Repeat: differentiate all transitions at once, factorise the Gauss-Newton matrix of the whole clip (``loop``), and lower
the energy by L-BFGS in the coordinates in which that matrix is the identity, on exact roll-outs that steer themselves.
Gradients are exact and of every term. The unknowns, the energy and its minima are those of ``stages.stage_3``. Its
valleys, too: there may be a second start, of which the lower one goes on after some rounds, with slopes at few frames
until then; and later rounds search several valleys at once (``leaps``), each in its own coordinates, since a closure of
four roll-outs takes about twice as long as one of one, not four times.

Source: thesis 3.3.4 (open); Jacobson and Mayne 1970 (the closed loop).
Differs: no sub-stages of 15 frames, no windows: a closed loop does not drift apart. Not multiple shooting: the states
are no unknowns of their own, and the loop begins at a roll-out (``transitions``) rather than at a homotopy's end.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from motionlab.errors import NotConverged, ShapeError
from motionlab.humor import leaps
from motionlab.humor.judged import Judged, judged
from motionlab.humor.loop import Loop, linearised, moved, opened
from motionlab.humor.stages import Problem, interrupted, rolled_terms
from motionlab.humor.variables import Variables
from motionlab.optimise_batch import BatchFit, minimise_batch

_LEAST_STEP = 0.05  # of what a round must gain

__all__ = ["Judged", "Loop", "Plan", "Report", "judged", "linearised", "moved", "opened", "solve"]


@dataclass(frozen=True)
class Plan:
    """How much work.

    rounds: linearisations at most. closures: of L-BFGS after each. tolerance: a clip is done when a round gains less
    than this share of its energy's size, and a round when a step, and then one down the gradient, gain less than a
    twentieth of that. stride: frames between those at which the networks are differentiated. leaps: components of the
    first state's mixture whose valleys a clip tries in a round (``leaps``), if they promise more. trial: rounds that a
    second start goes along, before the first leaps; with 0 it is not used. coarse: the least stride of these rounds.
    """

    rounds: int = 25
    closures: int = 30
    tolerance: float = 1e-3
    stride: int = 1
    leaps: int = 3
    trial: int = 2
    coarse: int = 4
    ridge: float = 1e-6

    def __post_init__(self) -> None:
        if min(self.rounds, self.closures, self.stride, self.coarse) < 1 or min(self.leaps, self.trial) < 0:
            raise ValueError(f"rounds, closures, strides: expected 1 or more, leaps, trial: 0 or more, got {self}")


@dataclass
class Report:
    """What a fit spent: after each closure the energies (B,) of its clips (those that are done stay at their last) and
    the seconds until it had them, without its gradient, by ``clock``; seconds of each linearisation and its leaps."""

    history: list[Tensor] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    linearised: list[float] = field(default_factory=list)
    clock: Callable[[], float] = time.perf_counter
    began: float = 0.0


def solve(
    problem: Problem,
    unknown: Variables,
    plan: Plan | None = None,
    report: Report | None = None,
    *,
    rival: Variables | None = None,
    linearise: Callable[..., Loop] = linearised,
    progress: bool = False,
) -> tuple[dict[str, Tensor], list[BatchFit]]:
    """Lower stage 3's energy from unknowns (G, 1, ...) of whole recordings; Ctrl-C keeps the best so far.

    rival: a second start of the same recordings; after the plan's trial the lower one of each goes on. linearise: where
    the coordinates come from, called as ``loop.linearised``; another for ablations.

    Returns:
        the unknowns of lowest energy, and the optimiser's reports of all rounds, of all clips: one that is done has the
        reason "no decrease".
    Raises:
        ShapeError: recordings in several windows, or of one frame; a second start of other recordings.
        NotConverged: no clip has a finite energy and gradient at the start.
    """
    if unknown["z"].shape[1] != 1:
        raise ShapeError(f"z: expected one window per recording, got {unknown['z'].shape[1]}")
    plan, report, clips = plan or Plan(), report or Report(), len(unknown["z"])
    unknown = {n: x.detach().clone() for n, x in unknown.items()}
    trial = 0
    if rival is not None:
        both, trial = _beside(unknown, rival), plan.trial
        unknown = both if trial else unknown
    mark, fits = time.perf_counter(), []
    report.began = report.clock()
    energy = unknown["betas"].new_full((len(unknown["betas"]),), float("inf"))
    live = torch.arange(len(energy), device=energy.device)
    for count in range(plan.rounds):
        if count == trial:
            live = live[torch.isin(live, _lower(energy, clips))]
        if not len(live):
            break
        now = plan if count >= trial else replace(plan, leaps=0, stride=max(plan.stride, plan.coarse))
        here = {n: x[live] for n, x in unknown.items()}
        try:
            size = energy[live].abs().nan_to_num(posinf=0.0)  # 0: not known yet
            found, fit = _round(problem.rows(live % clips), here, size, now, report, linearise, progress)
        except (KeyboardInterrupt, NotConverged) as ended:
            del report.seconds[len(report.history) :]
            if not fits:
                raise
            if isinstance(ended, KeyboardInterrupt):
                fits[-1] = replace(fits[-1], reasons=["interrupted"] * clips)
            break  # else what is left cannot be differentiated: it stays where it was
        gain = energy[live] - fit.energy
        better = gain > 0
        for n, x in found.items():
            unknown[n][live[better]] = x[better]
        energy[live[better]] = fit.energy[better]
        whole = _widened(fit, live, energy, time.perf_counter() - mark)
        fits.append(_of_clips(whole, torch.arange(len(energy), device=energy.device) % clips)[1])
        report.history += fits[-1].history.unbind(0)
        del report.seconds[len(report.history) :]  # Ctrl-C between an energy and its gradient
        gained = gain > plan.tolerance * energy[live].abs()
        mark, live = time.perf_counter(), live[gained] if count >= trial else live
        if interrupted(fit):
            break
    return {n: x[_lower(energy, clips)] for n, x in unknown.items()}, fits


def _beside(unknown: dict[str, Tensor], rival: Variables) -> dict[str, Tensor]:
    """Two starts of G clips as 2 G rows."""
    for n, x in unknown.items():
        if n not in rival or rival[n].shape != x.shape:
            raise ShapeError(f"rival {n}: expected shape {tuple(x.shape)}, got {n in rival and tuple(rival[n].shape)}")
    return {n: torch.cat((x, rival[n].detach())) for n, x in unknown.items()}


def _lower(energy: Tensor, clips: int) -> Tensor:
    """Of each clip the row (G,) with the lower energy, the former where there is none."""
    return energy.unflatten(0, (-1, clips)).argmin(0) * clips + torch.arange(clips, device=energy.device)


def _round(
    problem: Problem,
    unknown: Variables,
    size: Tensor,
    plan: Plan,
    report: Report,
    linearise: Callable[..., Loop],
    progress: bool,
) -> tuple[dict[str, Tensor], BatchFit]:
    """One linearisation and the searches around it: from where a clip is, and from where it may leap to.

    size (B,): of each clip's energy.
    """
    began = report.clock()
    loop = linearise(problem, unknown, ridge=plan.ridge, stride=plan.stride)
    who, shaper, first = leaps.starts(problem, unknown, loop, plan.leaps, plan.tolerance)
    report.linearised.append(report.clock() - began)

    def note() -> None:
        report.seconds.append(report.clock() - report.began)

    how = {"note": note, "progress": progress, "enough": (_LEAST_STEP * plan.tolerance * size)[who]}
    rows, fit = searched(problem, unknown, loop, who, shaper, first, plan.closures, **how)
    best, fit = _of_clips(fit, who)
    return {n: x[best] for n, x in rows.items()}, fit


def searched(
    problem: Problem,
    unknown: Variables,
    loop: Loop,
    who: Tensor,
    shaper: Tensor,
    first: Tensor,
    closures: int,
    *,
    enough: float | Tensor = 0.0,
    note: Callable[[], None] = lambda: None,
    progress: bool = False,
) -> tuple[dict[str, Tensor], BatchFit]:
    """R searches in the coordinates around a loop: row r is of clip who[r] and begins at first (R, f), in coordinates
    of its own: shaper (R, f, f) in place of ``Loop.first``.

    enough: a row is done when a step, and then one down the gradient, gain no more than this, (R,) or one number. note:
    called whenever energies are known.
    """
    some, here = problem.rows(who), {n: x[who] for n, x in unknown.items()}
    around = loop.rows(who)._replace(first=shaper)

    def energy(new: Variables, rows: Tensor) -> Tensor:
        these, at, near = some, here, around
        if len(rows) < len(who):  # gains are large: no copies while all run
            these, at, near = some.rows(rows), {n: x[rows] for n, x in here.items()}, around.rows(rows)
        at, rolled = opened(these, at, near, new)
        found = sum(rolled_terms(these, at, rolled).values())
        note()
        return found

    start = {"nu": torch.zeros_like(here["z"][:, 0]).requires_grad_(), "first": first.clone().requires_grad_()}
    how = {"steps": 1, "inner": closures, "max_closures": closures, "tolerance_change": enough}
    fit = minimise_batch(energy, start, rows=True, unit=True, progress=progress, **how)
    with torch.no_grad():
        at, rolled = opened(some, here, around, fit.variables)
    return {**at, "z": rolled.rollout.z[:, None]}, fit


def _of_clips(fit: BatchFit, who: Tensor) -> tuple[Tensor, BatchFit]:
    """Of each clip the row (G,) of lowest energy, and the report of rows as one of clips ``who``; a person who stops
    one row of a clip stops the clip."""
    clips = int(who.max()) + 1
    mine = who == torch.arange(clips, device=who.device)[:, None]  # (G, R)
    best = torch.where(mine, fit.energy, torch.inf).argmin(1)
    best = torch.where(fit.energy[best].isfinite(), best, mine.double().argmax(1))
    history = torch.where(mine, fit.history.nan_to_num(nan=torch.inf)[:, None], torch.inf).amin(-1)
    stopped = {w for w, reason in zip(who.tolist(), fit.reasons, strict=True) if reason == "interrupted"}
    reasons = ["interrupted" if clip in stopped else fit.reasons[row] for clip, row in enumerate(best.tolist())]
    return best, BatchFit({}, fit.energy[best], history, fit.seconds, reasons)


def _widened(fit: BatchFit, live: Tensor, energy: Tensor, seconds: float) -> BatchFit:
    """The report of some clips as one of all: the others stay at their energy."""
    history = energy.expand(len(fit.history), -1).index_copy(1, live, fit.history)
    reasons = ["no decrease"] * len(energy)
    for at, reason in zip(live.tolist(), fit.reasons, strict=True):
        reasons[at] = reason
    return BatchFit({}, energy.clone(), history, seconds, reasons)
