"""Who races, on whom, and what is read from a race: one clip at a time, one core, the processor's own clock."""

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from data_synth import scenes
from motionlab.footage.scene_fit import FULL_WORK, QUICK_WORK
from motionlab.humor import start as starts
from motionlab.humor.energies import RGB_LIGHT
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.motion import Motion
from motionlab.observation import Observation2D
from studies.nb08_fast.trials import CM, Run, Single, Task, clock, prepare, shooting, single_shooting
from studies.shared.clips import everyday, stacked, takes

SYNTHETIC, CMU = "synthetic", "CMU"
PLAIN, WALL = "plain view", "behind a low wall"
SINGLE, DEFAULT, QUICK, START = "single shooting", "default", "quick", "stage 2"
#: Nats a frame that count as level with an energy.
LEVEL = 0.05
#: Ways of single shooting, tried on validation people, and the work of the others; both for a smoke run, too.
WAYS = {
    "product": {
        "as in fits": Single(),
        "20 pairs of L-BFGS, calm start, no sub-stages": Single((0, 0, 720), memory=20, eager=starts.DAMPING_SHOOTING),
    },
    "smoke": {"as in fits": Single((2, 2, 4)), "no sub-stages": Single((0, 0, 4))},
}
_SHORT = replace(FULL_WORK, steps=(1, 2, 3), inner=3, shooting=replace(FULL_WORK.shooting, rounds=2, closures=8))
WORKS = {
    "product": {DEFAULT: FULL_WORK, QUICK: QUICK_WORK},
    "smoke": {DEFAULT: _SHORT, QUICK: replace(_SHORT, shooting=replace(QUICK_WORK.shooting, rounds=1, closures=3))},
}


@dataclass(frozen=True, eq=False)
class Clip:
    """One clip of one person: its task, what was seen, and what stood in the way."""

    source: str
    person: str
    view: str
    task: Task
    seen: Observation2D
    things: Sequence[object]


def clips(
    priors: Priors, folder: Path | None, part: str, counts: Mapping[str, int], seed: int, frames: int, work: Schedule
) -> list[Clip]:
    """People of each source (``counts``), filmed by turns in plain view and behind a wall or desk, after stage 2.

    Synthetic people are unknown to the corpus; those of the CMU library are of one part of its people.
    """
    found = []
    for source, count in counts.items():
        if source == SYNTHETIC:
            who, truth = [f"stranger {k}" for k in range(count)], scenes.held_out(count, seed=seed, frames=frames)
            motions = [truth.clip(k) for k in range(count)]
        elif folder:
            who, motions = zip(*everyday(takes(folder, part), count), strict=True)
            motions = [motion.cut(0, frames) for motion in motions]
        else:
            continue
        films = {view: scenes.film_recorded(view, motions, seed=seed) for view in (PLAIN, WALL)}
        for k, person in enumerate(who):
            view = (PLAIN, WALL)[k % 2]
            film, seen = films[view], films[view].clip(k)
            how = {"cameras": [film.cameras[k]], "schedule": work, "seen": film.seen[k : k + 1]}
            task = prepare(view, stacked([seen], camera=None), priors, RGB_LIGHT, film.truth.clip([k]), **how)
            found.append(Clip(source, person, view, task, seen, film.occluders[k]))
    return found


def contenders(how: Single, works: Mapping[str, Schedule]) -> dict[str, partial]:
    """Returns what races: a function of a task by name."""
    ours = {name: partial(shooting, work=work) for name, work in works.items()}
    return {SINGLE: partial(single_shooting, how=how)} | ours


def errors(task: Task, motion: Motion) -> dict[str, float]:
    """Distances from the true joints in the room, cm: of all, of those in view, and of those hidden."""
    off = CM * (motion.positions - task.truth.positions).norm(dim=-1)
    return {"all": off.mean().item(), "seen": off[task.seen].mean().item(), "hidden": off[~task.seen].mean().item()}


def after(task: Task, run: Run, seconds: float) -> dict[str, float]:
    """``errors`` of what a run had after so many seconds."""
    return errors(task, task.motion(run.at(seconds)))


def best(runs: Mapping[str, Run]) -> float:
    """The lowest energy that anybody found."""
    return min(run.end for run in runs.values())


def above(task: Task, run: Run, low: float, seconds: float) -> float:
    """How far the energy known after so many seconds is above another, nats a frame; the start's, before any is."""
    known = run.energies[run.seconds <= seconds].tolist()[-1:]
    return (min([*known, *task.energy(run.kept[0][1]).tolist()]) - low) / task.nat


def times_sooner(task: Task, runs: Mapping[str, Run]) -> float:
    """How many times sooner the default is within ``LEVEL`` of where single shooting ends; 0 where it never is."""
    aim = runs[SINGLE].end + LEVEL * task.nat
    return runs[SINGLE].until(aim) / runs[DEFAULT].until(aim)


def less(task: Task, runs: Mapping[str, Run], name: str, measure: str, *, at_end: bool = False) -> float:
    """Error of one racer, or of stage 2, less that of single shooting, cm: after the default's time, or each at its own
    end."""
    limit = float("inf") if at_end else runs[DEFAULT].spent
    mine = errors(task, task.rough) if name == START else after(task, runs[name], limit)
    return mine[measure] - after(task, runs[SINGLE], limit)[measure]


def profiles(
    some: Sequence[Clip], runs: Sequence[Mapping[str, Run]], times: Sequence[float]
) -> dict[str, dict[str, Tensor]]:
    """By measure and contender, a number for every clip and time (B, N): nats a frame above the best, cm of joints in
    view and hidden."""
    found: dict[str, dict[str, list]] = {}
    for clip, race in zip(some, runs, strict=True):
        low = best(race)
        for name, run in race.items():
            off = [after(clip.task, run, t) for t in times]
            rows = {"energy": [above(clip.task, run, low, t) for t in times]}
            for measure, row in (rows | {m: [x[m] for x in off] for m in ("seen", "hidden")}).items():
                found.setdefault(measure, {}).setdefault(name, []).append(row)
    return {m: {name: torch.tensor(rows) for name, rows in by.items()} for m, by in found.items()}


def by_source(some: Sequence[Clip], values: Sequence[float]) -> dict[str, Tensor]:
    """A number per person (P,) by source: the mean of a person's clips that have one."""
    found: dict[str, dict[str, list[float]]] = {}
    for clip, value in zip(some, values, strict=True):
        if not math.isnan(value):
            found.setdefault(clip.source, {}).setdefault(clip.person, []).append(value)
    return {s: torch.tensor([sum(x) / len(x) for x in people.values()]).double() for s, people in found.items()}


def whole_errors(task: Task, runs: Mapping[str, Run], quick: Motion) -> dict[str, float]:
    """Errors of all joints, cm, of whole fits of one clip: both of the product's, and its stage 2."""
    shown = {DEFAULT: task.motion(runs[DEFAULT].kept[-1][1]), QUICK: quick, START: task.rough}
    return {name: errors(task, motion)["all"] for name, motion in shown.items()}


def whole_fit(clip: Clip, priors: Priors, work: Schedule) -> tuple[float, Motion]:
    """Processor seconds of a whole fit by the product, keypoints to motion, and the motion."""
    one, began = stacked([clip.seen]), clock()
    fitted = fit(one, priors, cameras=[clip.seen.camera], floor="camera", schedule=work, solver="shooting")
    return clock() - began, fitted.motion


def processor() -> str:
    """The name of the processor, where the machine tells."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
