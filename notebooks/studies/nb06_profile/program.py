"""The program of a fit, timed: one closure of stage 3 step by step, the whole schedule, and its shares.

A closure is one evaluation of the energy with its gradient, which L-BFGS asks for again and again.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise

import torch
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.humor import stages
from motionlab.humor.pretrained import load_priors
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import Rollout
from motionlab.humor.unknowns import Posed, Rolled
from motionlab.motion import Motion
from studies.nb06_profile import figures
from studies.nb06_profile.closure_budget import Spent
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


class Closure:
    """One closure of stage 3 in its steps, for a cell that writes them out; together they are ``savings.closure``."""

    def __init__(self, work: Workload, on: Savings) -> None:
        self.problem, self.on = work.problem, on
        self.unknown = work.unknowns(Part(3, work.frames), on)
        self.body = savings.body_of(self.unknown, self.problem.evidence, on)

    @contextmanager
    def gradients(self) -> Iterator[None]:
        """Clears the gradients of the unknowns; while it lasts, the networks' weights need some too unless frozen."""
        for value in self.unknown.named().values():
            value.grad = None
        with savings.weights_of(self.problem.priors, self.on):
            yield

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
        return stages.rolled_terms(self.problem, self.unknown, Rolled(*chain[:2], people))


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
def minutes(spent: Spent) -> dict[str, dict[str, float]]:
    """Computes minutes of the schedule by phase and part, the two phases of stage 3 with all frames as one."""
    found: dict[str, dict[str, float]] = {}
    for phase, parts in spent.minutes().items():
        whole = phase.startswith("stage 3") and "first" not in phase.replace("first state", "")
        name = f"stage 3: all {spent.phases[-1].part.frames} frames" if whole else phase
        row = found.setdefault(name, {"roll-out function": 0.0, "body and energies": 0.0, "backward": 0.0})
        for part, took in parts.items():
            row["roll-out function" if part in _FUNCTION else part if part in row else "body and energies"] += took
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
