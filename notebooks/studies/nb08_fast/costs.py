"""What the parts of a fast stage 3 cost, by themselves and within a whole fit, and how they grow."""

from __future__ import annotations

import cProfile
import math
import pstats
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor import stages
from motionlab.humor.shooting import coordinates, feedback_solver
from motionlab.humor.stages import Problem
from motionlab.humor.unknowns import FIRST, Unknowns
from motionlab.metrics.intervals import interval
from studies.nb08_fast.trials import Run, Task, clock, shot
from studies.shared.statistics import middle
from studies.shared.workload import Workload

#: Functions of a fit whose own and deeper time is one row of the table: label -> (file, function).
PARTS = {
    "derivatives of the decoder": ("derivatives.py", "decoder_slopes"),
    "derivatives of the step": ("derivatives.py", "transition_slopes"),
    "derivatives of the prior": ("derivatives.py", "prior_slopes"),
    "rows of the energies": ("gauss_newton.py", "residual_rows"),
    "Riccati sweep": ("gauss_newton.py", "riccati_sweep"),
    "the whole linearisation": ("coordinates.py", "linearised"),
    "valleys": ("feedback_solver.py", "_starts"),
    "closures": ("optimise.py", "evaluate"),
    "everything": ("feedback_solver.py", "solve"),
}

#: Those that lie within the linearisation.
_INSIDE = list(PARTS)[: list(PARTS).index("the whole linearisation")]


def parts_of_a_fit(task: Task, plan: feedback_solver.Plan) -> dict[str, float]:
    """Seconds of processor time of each of ``PARTS`` in one fit, what they call included; parts lie within others."""
    watch = cProfile.Profile(clock)
    watch.enable()
    try:
        shot(task, plan)
    finally:
        watch.disable()
    found = {(file.rsplit("/", 1)[-1], name): row[3] for (file, _, name), row in pstats.Stats(watch).stats.items()}
    spent = {label: found[where] for label, where in PARTS.items() if where in found}
    if "everything" not in spent:
        raise DataError("no solve in its own profile", remedy="PARTS must name the functions as they are called now")
    return spent


def apart(spent: dict[str, float]) -> dict[str, float]:
    """The same seconds as parts that lie side by side and add up to the whole fit."""
    inside = [name for name in _INSIDE if name in spent]
    found = {name: spent[name] for name in inside}
    found["rest of the linearisation"] = spent["the whole linearisation"] - sum(found.values())
    found |= {name: spent[name] for name in ("valleys", "closures")}
    found["everything else"] = spent["everything"] - sum(found.values())
    return found


def closed_closure(problem: Problem, unknown: Unknowns, loop: coordinates.Loop) -> Callable[[], Tensor]:
    """One closure in closed-loop coordinates: exact roll-out, energy (B,), gradient."""
    nu = torch.zeros_like(unknown.z[:, 0]).requires_grad_()
    first = loop.first.new_zeros(loop.first.shape[:2]).requires_grad_()

    def run() -> Tensor:
        at, rolled = coordinates.opened(problem, unknown, loop, {"nu": nu, "first": first})
        value = sum(stages.rolled_terms(problem, at, rolled).values())
        torch.autograd.grad(value.sum(), (nu, first))
        return value.detach()

    return run


def plain_closure(problem: Problem, unknown: Unknowns) -> Callable[[], Tensor]:
    """One closure of single shooting: exact roll-out of z, energy (B,), gradient."""
    free = (*FIRST, "z", "betas")
    moving = Unknowns(**{n: x.clone().requires_grad_(n in free) for n, x in unknown.named().items()})

    def run() -> Tensor:
        value = sum(stages.motion_terms(problem, moving).values())
        torch.autograd.grad(value.sum(), [getattr(moving, n) for n in free])
        return value.detach()

    return run


def three_costs(work: Workload) -> dict[str, Callable[[], object]]:
    """What is to be timed of a workload: a linearisation, and a closure with and without feedback."""
    unknown = work.moving.detached()
    loop = coordinates.linearised(work.problem, unknown)
    return {
        "linearisation": lambda: coordinates.linearised(work.problem, unknown),
        "closed-loop closure": closed_closure(work.problem, unknown, loop),
        "single-shooting closure": plain_closure(work.problem, unknown),
    }


def lowest(runs: Sequence[Run]) -> Tensor:
    """The lowest energy (B,) that any run found on each clip, by a roll-out or on the way."""
    ends = [torch.where(run.end.isfinite(), run.end, torch.inf) for run in runs]
    return torch.stack(ends + [run.energies[-1] for run in runs]).amin(0)


def gain(slow: Run, fast: Run, best: Tensor, share: float) -> Tensor:
    """How many times sooner the fast run is within ``share`` of the best energies (B,): (B,).

    A slow run that never is counts with the time it spent, so that the number is the least that the gain can be; a
    fast run that never is counts 0, whatever the slow one does.
    """
    before, after = slow.within(best, share), fast.within(best, share)
    before = torch.where(before.isfinite(), before, torch.as_tensor(slow.spent).to(before))
    return torch.where(after.isfinite(), before / after, 0.0)


def fallen(run: Run, other: Run, start: Tensor, best: Tensor) -> Tensor:
    """Energy (B,) that a run ends with less another's, in parts of the fall from the start's to the best energy."""
    return (run.end - other.end) / (start - best).clamp(min=1e-9)


def solved(run: Run, best: Tensor, share: float = 0.05) -> Tensor:
    """(B,) whether a run ends within ``share`` of |best|."""
    return run.end <= best + share * best.abs()


def paired(mine: Tensor, theirs: Tensor, generator: torch.Generator) -> dict[str, object]:
    """A table's row of what one run's errors (B,) are less another's on the same clips."""
    less, row = mine - theirs, {"clips": len(mine), "smaller on": int((mine < theirs).sum())}
    for statistic in ("median", "mean"):
        value, low, high = interval(less, statistic, generator)
        row[statistic] = f"{value:.2f} [{low:.2f}, {high:.2f}]"
    return row


def seconds_text(seconds: Tensor, spent: float | Tensor) -> str:
    """Median seconds of (B,), and how many of them never arrived within the time spent."""
    never, half = int(seconds.isinf().sum()), middle(seconds)
    text = f"{half:.1f}" if half.isfinite() else f"> {middle(torch.as_tensor(spent)):.0f}"
    return text + (f" ({never} of {len(seconds)} never)" if never else "")


def times_table(
    runs: Mapping[str, Run], best: Tensor, start: Tensor, errors: Mapping[str, Tensor]
) -> list[dict[str, object]]:
    """A row per contender of one task: when it is near the best energy, where it ends, how far from the truth.

    Near is measured twice, since |best| depends on where the energy has its zero: in parts of |best|, and of the fall
    from the start's energy. start (B,): that of the common start.
    """
    rows, fall = [], start - best
    for name, run in runs.items():
        above = run.end - best
        rows.append(
            {"contender": name, "clips": len(best),
             "s to within 5 %": seconds_text(run.within(best, 0.05), run.spent),
             "1 %": seconds_text(run.within(best, 0.01), run.spent),
             "1 % of the fall": seconds_text(run.within(best, 0.01, fall), run.spent),
             "s in all": middle(torch.as_tensor(run.spent)).item(),
             "ends above the best, %": middle(100 * above / best.abs().clamp(min=1e-9)).item(),
             "% of the fall": middle(100 * above / fall.clamp(min=1e-9)).item(),
             "within 5 %": f"{int(solved(run, best).sum())} of {len(best)}",
             "error, cm (mean)": errors[name].mean().item()}
        )  # fmt: skip
    return rows


def pooled(runs: Sequence[Run]) -> Run:
    """Clips that were run one at a time, as one run in which every clip keeps its own times.

    Clips that took fewer closures stay where they ended.
    """
    count = max(len(run.seconds) for run in runs)

    def longer(x: Tensor) -> Tensor:
        return torch.cat((x, x[-1:].expand(count - len(x), *x.shape[1:])))

    energies, seconds = (torch.cat([longer(x) for x in each], 1) for each in
                         ([run.energies for run in runs], [run.each for run in runs]))  # fmt: skip
    each = [run.unknown.named() for run in runs]
    unknown = Unknowns(**{n: torch.cat([one[n] for one in each]) for n in each[0]})
    end = torch.cat([run.end for run in runs])
    spent, linearised = (
        torch.cat([torch.as_tensor(getattr(run, name)).double().expand(len(run.end)) for run in runs])
        for name in ("spent", "linearised")
    )
    return Run(energies, seconds, unknown, end, spent, linearised)


def curve(run: Run, best: Tensor, *, points: int = 300) -> tuple[Tensor, Tensor]:
    """Times (P,), evenly in their logarithm, and how far above the best each clip is then, of |best| (P, B)."""
    first, last = run.seconds.min().item(), run.seconds.max().item()
    times = torch.logspace(math.log10(first), math.log10(last), points if last > first else 1, dtype=torch.float64)
    times[-1], times[0] = last, first  # not rounded to before the first
    return times, torch.stack([(run.at(now) - best) / best.abs() for now in times])


def fit_row(task: Task, run: Run) -> dict[str, object]:
    """What a whole fit costs by clip and by frame, and what it finds: of runs of different lengths and batches."""
    frames = task.truth.frames
    end, began = (x.mean().item() / frames for x in (run.end, task.energy(task.unknown)))
    return {
        "clips": len(task), "frames": frames, "s": float(run.spent), "s per clip": float(run.spent) / len(task),
        "s per second of motion": float(run.spent) / (len(task) * frames / task.truth.fps),
        "linearisations, % of it": 100 * float(run.linearised) / float(run.spent), "closures": len(run.seconds),
        "energy per frame: start": began, "end": end, "error, cm": task.error(task.motion(run.unknown)).mean().item(),
    }  # fmt: skip
