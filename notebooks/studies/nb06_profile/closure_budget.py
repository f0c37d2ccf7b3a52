"""What a whole fit spends: the official schedule as phases in which every closure costs the same, and those costs.

seconds of the program = sum over phases of closures x seconds of one closure
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.humor.testops import Schedule
from studies.shared.profiling import Stopwatch
from studies.shared.savings import Savings
from studies.shared.workload import Part, Workload

#: Of the official video demo.
OFFICIAL = Schedule(steps=(30, 80, 70))


@dataclass(frozen=True)
class Phase:
    """A part of a fit: its name, the closure that it repeats, and how often."""

    name: str
    part: Part
    closures: int


def phases(frames: int) -> list[Phase]:
    """The budget: an outer step may take 5/4 as many closures as it has iterations, torch's default limit."""
    each, (one, two, three) = OFFICIAL.inner * 5 // 4, OFFICIAL.steps
    begin, end = OFFICIAL.refine
    short = min(OFFICIAL.short, frames)
    return [
        Phase("stage 1: root", Part(1, frames), each * one),
        Phase("stage 2: pose", Part(2, frames), each * two),
        Phase(f"stage 3: first {short} frames", Part(3, short), each * begin),
        Phase("stage 3: first state fixed", Part(3, frames, first_fixed=True, contacts=False), each * (end - begin)),
        Phase("stage 3: everything", Part(3, frames), each * (three - end)),
    ]


@dataclass(frozen=True, eq=False)
class Spent:
    """Seconds of one closure of every phase, by part (``savings.Mark``), (n,): one number per round of measuring."""

    phases: tuple[Phase, ...]
    seconds: tuple[dict[str, Tensor], ...]

    def program(self, *parts: str, stage: int | None = None) -> Tensor:
        """Seconds (n,) of the whole program; of some parts of the closures or one stage alone where they are named."""
        total = 0.0
        for phase, spent in zip(self.phases, self.seconds, strict=True):
            if stage in (None, phase.part.stage):
                total = total + phase.closures * sum(x for name, x in spent.items() if not parts or name in parts)
        return total

    def minutes(self) -> dict[str, dict[str, float]]:
        """Minutes that the program spends in each part of each phase, from medians."""
        return {
            phase.name: {name: phase.closures * x.median().item() / 60 for name, x in spent.items()}
            for phase, spent in zip(self.phases, self.seconds, strict=True)
        }


def spend(contenders: Mapping[str, tuple[Workload, Savings]], *, n: int) -> dict[str, Spent]:
    """Time one closure of each phase of each contender, in n rounds through all of them after one more."""
    tables = {name: phases(work.frames) for name, (work, _) in contenders.items()}
    calls = {name: [work.closure(phase.part, on) for phase in tables[name]] for name, (work, on) in contenders.items()}
    rounds = [{name: [_parts(closure) for closure in row] for name, row in calls.items()} for _ in range(1 + n)][1:]

    def columns(rows: Sequence[dict[str, float]]) -> dict[str, Tensor]:
        return {name: torch.tensor([row[name] for row in rows], dtype=torch.float64) for name in rows[0]}

    return {
        name: Spent(tuple(table), tuple(map(columns, zip(*(r[name] for r in rounds), strict=True))))
        for name, table in tables.items()
    }


def _parts(closure: Callable[..., Tensor]) -> dict[str, float]:
    watch = Stopwatch(time.process_time)
    closure(mark=watch)
    return watch.seconds
