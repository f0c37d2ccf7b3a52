"""What the parts of a fast stage 3 cost, by themselves and within a whole fit, and how they grow."""

from __future__ import annotations

import cProfile
import pstats
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor import shooting, stages
from motionlab.humor.ladder import LEAN
from motionlab.humor.program import OFFICIAL, Phase, phases
from motionlab.humor.solver_trials import Run, Task, clock
from motionlab.humor.stages import Problem
from motionlab.humor.testops import Schedule
from motionlab.humor.workload import Part, Workload

#: Functions of a fit whose own and deeper time is one row of the table: label -> (file, function).
PARTS = {
    "derivatives of the decoder": ("slopes.py", "transition"),
    "derivatives of the prior": ("slopes.py", "prior_slopes"),
    "rows of the energies": ("curvature.py", "rows"),
    "Riccati sweep": ("riccati.py", "sweep"),
    "the whole linearisation": ("loop.py", "linearised"),
    "closures": ("optimise_batch.py", "evaluate"),
    "everything": ("shooting.py", "solve"),
}


def parts_of_a_fit(task: Task, plan: shooting.Plan) -> dict[str, float]:
    """Seconds of processor time of each of ``PARTS`` in one fit, what they call included; parts lie within others."""
    watch = cProfile.Profile(clock)
    watch.enable()
    try:
        shooting.solve(task.problem, task.unknown, plan, shooting.Report())
    finally:
        watch.disable()
    found = {(file.rsplit("/", 1)[-1], name): row[3] for (file, _, name), row in pstats.Stats(watch).stats.items()}
    spent = {label: found[where] for label, where in PARTS.items() if where in found}
    if "everything" not in spent:
        raise DataError("no solve in its own profile", remedy="PARTS must name the functions as they are called now")
    return spent


def apart(spent: dict[str, float]) -> dict[str, float]:
    """The same seconds as parts that lie side by side and add up to the whole fit."""
    inside = [name for name in list(PARTS)[:4] if name in spent]
    found = {name: spent[name] for name in inside}
    found["rest of the linearisation"] = spent["the whole linearisation"] - sum(found.values())
    found["closures"] = spent["closures"]
    found["everything else"] = spent["everything"] - sum(found.values())
    return found


def closed_closure(problem: Problem, unknown: dict[str, Tensor], loop: shooting.Loop) -> Callable[[], Tensor]:
    """One closure in closed-loop coordinates: exact roll-out, energy (B,), gradient."""
    nu = torch.zeros_like(unknown["z"][:, 0]).requires_grad_()
    first = loop.first.new_zeros(loop.first.shape[:2]).requires_grad_()

    def run() -> Tensor:
        at, rolled = shooting.opened(problem, unknown, loop, {"nu": nu, "first": first})
        value = sum(stages.rolled_terms(problem, at, rolled).values())
        torch.autograd.grad(value.sum(), (nu, first))
        return value.detach()

    return run


def three_costs(work: Workload) -> dict[str, Callable[[], object]]:
    """What is to be timed of a workload: a linearisation, and a closure with and without feedback."""
    unknown = {n: x.detach() for n, x in work.moving.items()}
    loop = shooting.linearised(work.problem, unknown)
    return {
        "linearisation": lambda: shooting.linearised(work.problem, unknown),
        "closed-loop closure": closed_closure(work.problem, unknown, loop),
        "single-shooting closure": work.closure(Part(3, work.frames), LEAN),
    }


def faithful_phases(frames: int) -> list[Phase]:
    """Stage 3 of the official schedule: closures at most, 25 for each of 70 outer steps."""
    return phases(Schedule(steps=(0, 0, OFFICIAL.steps[2])), frames)


# ------------------------------------------------------------------------------------------------ who was how fast
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
    before = torch.where(before.isfinite(), before, torch.full_like(before, slow.spent))
    return torch.where(after.isfinite(), before / after, 0.0)


def fallen(run: Run, other: Run, start: Tensor, best: Tensor) -> Tensor:
    """Energy (B,) that a run ends with less another's, in parts of the fall from the start's to the best energy."""
    return (run.end - other.end) / (start - best).clamp(min=1e-9)


def solved(run: Run, best: Tensor, share: float = 0.05) -> Tensor:
    """(B,) whether a run ends within ``share`` of |best|."""
    return run.end <= best + share * best.abs()


def seconds_text(seconds: Tensor, spent: float) -> str:
    """Median seconds of (B,), and how many of them never arrived within the time spent."""
    never = int(seconds.isinf().sum())
    middle = seconds.quantile(0.5, interpolation="higher")
    text = f"{middle:.1f}" if middle.isfinite() else f"> {spent:.0f}"
    return text + (f" ({never} of {len(seconds)} never)" if never else "")


def times_table(
    runs: dict[str, Run],
    best: Tensor,
    errors: dict[str, Tensor],
    times: dict[str, tuple[Tensor, Tensor]] | None = None,
) -> list[dict[str, object]]:
    """A row per contender of one task: when it is near the best energy, where it ends, how far from the truth.

    times: seconds (B,) to within 5 and 1 % where they are not those of the runs, such as of clips run alone.
    """
    rows = []
    for name, run in runs.items():
        above = 100 * (run.end - best) / best.abs().clamp(min=1e-9)
        five, one = (times or {}).get(name) or (run.within(best, 0.05), run.within(best, 0.01))
        rows.append(
            {"contender": name, "clips": len(best), "s to within 5 %": seconds_text(five, run.spent),
             "to within 1 %": seconds_text(one, run.spent), "s in all": run.spent,
             "ends above the best, % (median)": above.quantile(0.5).item(),
             "within 5 %": f"{int(solved(run, best).sum())} of {len(best)}",
             "error, cm (mean)": errors[name].mean().item()}
        )  # fmt: skip
    return rows


def pooled(runs: Sequence[Run]) -> Run:
    """Clips that were run alone, one after the other, as one run: its energies at the mean time of each closure.

    Clips that took fewer closures stay where they ended. For the curves alone: times of single clips are in the runs.
    """
    count = max(len(run.seconds) for run in runs)

    def longer(x: Tensor) -> Tensor:
        return torch.cat((x, x[-1:].expand(count - len(x), *x.shape[1:])))

    energies = torch.cat([longer(run.energies) for run in runs], 1)
    seconds = torch.stack([longer(run.seconds) for run in runs]).mean(0)
    unknown = {n: torch.cat([run.unknown[n] for run in runs]) for n in runs[0].unknown}
    end = torch.cat([run.end for run in runs])
    spent, linearised = (sum(getattr(run, name) for run in runs) / len(runs) for name in ("spent", "linearised"))
    return Run(energies, seconds, unknown, end, spent, linearised)
