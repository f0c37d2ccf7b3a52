"""The program of a fit, timed: one closure of stage 3 step by step, the whole schedule, and its shares.

A closure is one evaluation of the energy with its gradient, which L-BFGS asks for again and again. The schedule falls
into phases in which every closure costs the same: the program takes, over all phases, closures times seconds of one.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.humor import stages
from motionlab.humor.pretrained import load_priors
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import Rollout
from motionlab.humor.testops import Schedule
from motionlab.humor.unknowns import Posed, Rolled
from motionlab.motion import Motion
from studies.nb06_profile import figures
from studies.nb06_profile.official_profile import LABEL, Official
from studies.shared import savings
from studies.shared.profiling import Stopwatch
from studies.shared.savings import FAITHFUL, FORMS, LEAN, Savings
from studies.shared.workload import Noise, Part, Workload, workload

#: What the thesis read off its profile, in %, and what its conclusion asks of the roll-out (our bound).
CLAIMED = {"stage-3 closure": 90.0, "backward": 56.0, "roll-out function": 32.0}
CAUSE = {"roll-out and its gradient": 50.0}
#: States (B, T, 339) of a roll-out, what else it found, and the poses in the closure's own form.
Chain = tuple[Tensor, Rollout, Tensor]
_FUNCTION = ("first state", "chain")  # what the official code calls its roll-out function
#: Of the official video demo.
OFFICIAL = Schedule(steps=(30, 80, 70))


class Closure:
    """One closure of stage 3 in its steps, for a cell that writes them out; together they are ``savings.closure``."""

    def __init__(self, work: Workload, on: Savings) -> None:
        self.problem, self.on = work.problem, on
        self.unknown = work.unknowns(Part(3, work.frames), on)
        self.body = savings.body_of(self.unknown, self.problem.evidence, on)

    def gradients(self) -> AbstractContextManager:
        """Clears the gradients; while it lasts, the networks' weights need some too unless frozen."""
        return savings.gradients(self.problem, self.unknown, self.on)

    def first_state(self) -> Tensor:
        """Computes x_0 (B, 339): the pose prior's pose, and the body's joints in it."""
        return savings.first_state(self.unknown, self.problem.priors, self.body)

    def roll_out(self, first: Tensor) -> Chain:
        """Computes all later states, one after the other."""
        return savings.roll_out(self.unknown, self.problem.priors, first, self.body)

    def pose(self, chain: Chain) -> Posed:
        """Computes joints and keypoints of all frames, and their pixels."""
        states, _, pose = chain
        return savings.posed(self.unknown, self.problem.evidence, states, pose, self.body)

    def energies(self, chain: Chain, people: Posed) -> dict[str, Tensor]:
        """Computes the weighted terms (B,)."""
        return stages.rolled_terms(self.problem, Rolled(*chain[:2], people))


class Bars:
    """Bars of closures that were tried, the newest below: what the knobs of the notebook turn.

    timed: runs a closure step by step, a stopwatch around each.
    """

    def __init__(self, clip: Motion, priors: Priors, timed: Callable, noise: Callable[[object], Noise]) -> None:
        self.clip, self.priors, self.timed, self.noise = clip, priors, timed, noise
        self.tried: dict[str, dict[str, float]] = {}

    def turn(self, form: str, frames: int, clips: int) -> Figure:
        """Draws the bar of one setting below the last five; the second of two closures counts."""
        return figures.bars(self.measured(form, frames, clips))

    def measured(self, form: str, frames: int, clips: int) -> dict[str, dict[str, float]]:
        """Measures one setting in seconds and returns it with those before it, by part."""
        frames = min(frames, self.clip.frames)
        work = workload(self.clip.cut(0, frames), self.priors, self.noise((frames, clips)), clips)
        step = Closure(work, FORMS[form])
        for _ in range(2):
            watch = Stopwatch(time.process_time)
            self.timed(step, watch)
        label = f"{form}, {frames} frames, {clips} clip{'s' * (clips > 1)}"
        self.tried.pop(label, None)
        self.tried[label] = dict(watch.seconds)
        self.tried = dict(list(self.tried.items())[-6:])
        return self.tried


# ------------------------------------------------------------------------------------------------- the whole schedule
class Phase(NamedTuple):
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


def minutes(spent: Spent) -> dict[str, dict[str, float]]:
    """Computes minutes of the schedule by phase and part, from medians; the last two, with all frames, are one."""
    found: dict[str, dict[str, float]] = {}
    for phase, parts in zip(spent.phases, spent.seconds, strict=True):
        name = f"stage 3: all {phase.part.frames} frames" if phase in spent.phases[-2:] else phase.name
        row = found.setdefault(name, {"roll-out function": 0.0, "body and energies": 0.0, "backward": 0.0})
        for part, x in parts.items():
            kind = "roll-out function" if part in _FUNCTION else part if part in row else "body and energies"
            row[kind] += phase.closures * x.median().item() / 60
    return found


def shares(spent: Spent) -> dict[str, Tensor]:
    """Computes three shares of the program's time in %, one number per round (n,)."""
    parts = {"stage-3 closure": (), "backward": ("backward",), "roll-out function": _FUNCTION}
    return {name: 100 * spent.program(*some, stage=3) / spent.program() for name, some in parts.items()}


def alone(one: Workload) -> dict[str, Callable[[], object]]:
    """Returns what is measured against the whole closure: the roll-out by itself in three forms, and the bodies."""
    whole, unknown = Part(3, one.frames), {form: one.unknowns(Part(3, one.frames), on) for form, on in FORMS.items()}
    chain, frozen = savings.chain_alone, Savings(frozen=True)
    return {
        "whole closure": one.closure(whole, FAITHFUL),
        "roll-out": chain(one.problem, unknown["faithful"], FAITHFUL),
        "roll-out, weights frozen": chain(one.problem, unknown["faithful"], frozen),
        "roll-out, lean": chain(one.problem, unknown["lean"], LEAN),
        "bodies": savings.bodies_alone(one.problem, unknown["faithful"], FAITHFUL),
    }


def alone_table(found: Mapping[str, Tensor], official: Official) -> list[dict[str, object]]:
    """Lists milliseconds of each part alone and its share of the faithful closure, the official code's beside them."""
    theirs = {"whole closure": official.closure, "roll-out": official.alone["both"],
              "roll-out, weights frozen": official.alone["both, weights frozen"]}  # fmt: skip
    whole = found["whole closure"]
    return [
        {
            "forward and backward": name,
            "official code, ms": f"{1e3 * theirs[name]:,.0f}" if name in theirs else "",
            "its share, %": f"{100 * theirs[name] / official.closure:.0f}" if name in theirs else "",
            "our imitation, ms": f"{1e3 * x.median():,.0f}", "share, %": f"{100 * (x / whole).median():.0f}",
            "n": len(x),
        }
        for name, x in found.items()
    ]  # fmt: skip


def drawn(
    official: Official, found: Mapping[str, tuple[float, float, float]], lean: Mapping[str, Tensor]
) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Computes what ``figures.shares`` draws: (value, low, high) of every share, by program.

    found: of the faithful form on this machine.
    """
    theirs = {name: (x, x, x) for name, x in official.shares().items()}
    (last,) = CAUSE
    theirs[last] = (theirs[last][0], *official.range(theirs[last][0]))
    quick = {name: (x.median().item(),) * 3 for name, x in lean.items()}
    return {LABEL: theirs, "faithful, this machine": dict(found), "lean, this machine": quick}


def changes(clip: Motion, noise: Noise) -> tuple[float, dict[str, float]]:
    """Computes the size of an energy, and by which share of it each saving changes the energy, in double precision.

    With trained priors and latents that their encoders find. Size: the sum of its terms' sizes, which have either sign.
    """
    work = workload(clip, load_priors(), noise, inferred=True).to(torch.float64)
    part = Part(3, work.frames)
    with torch.no_grad():
        terms = [savings.terms(work.problem, work.unknowns(part, on), on) for _, on in savings.rungs()]
    size, energies = sum(x.abs().sum().item() for x in terms[0].values()), [sum(t.values()).item() for t in terms]
    steps = (abs(b - a) / size for a, b in pairwise(energies))
    return size, dict(zip(savings.NAMES.values(), steps, strict=True))
