"""The faithful schedule run to its end, and shooting on the same clips: where do they end?

The official budget takes a quarter of an hour of one core for a clip, too long for a notebook: ``run_faithful`` leaves
a record, which notebook 08 shows.

Both lower the same energy of stage 3, from the same stages 1 and 2: one by the official form's code, its rotation
vectors, its start by the posterior's mean and its three sub-stages, the other as fits do.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor import solver_trials, stages, transitions, variables
from motionlab.humor.shooting import Plan
from motionlab.humor.solver_trials import Task, clock
from motionlab.humor.testops import Schedule


def compared(task: Task, schedule: Schedule, plan: Plan | None = None, *, progress: bool = False) -> dict[str, object]:
    """Energies and errors (cm) of all clips by both, and of a batch seconds of one core and the faithful closures."""
    began = clock()
    unknown, closures = in_full(task, schedule, progress=progress)
    spent, run = clock() - began, solver_trials.shot(task, plan)
    faithful = replace(task.problem, mode="faithful")
    with torch.no_grad():
        end = sum(stages.motion_terms(faithful, unknown).values())
        body = faithful.form.roll(unknown, faithful.priors, faithful.evidence).body
    motion = variables.motion_of(body, task.truth.fps)

    def plain(x: Tensor) -> list[float]:
        return [round(value, 4) for value in x.tolist()]

    return {
        "task": task.name,
        "faithful": {"energy": plain(end), "error": plain(task.error(motion)), "closures": closures,
                     "seconds": round(spent, 1)},
        "shooting": {"energy": plain(run.end), "error": plain(task.error(task.motion(run.unknown))),
                     "seconds": round(float(run.spent), 1)},
        "start": {"energy": plain(task.energy(task.unknown)), "error": plain(task.error(task.rough))},
    }  # fmt: skip


def in_full(task: Task, schedule: Schedule, *, progress: bool = False) -> tuple[dict[str, Tensor], int]:
    """The unknowns that the faithful form's stage 3 ends with, after all of its sub-stages, and how many closures."""
    problem, frames = replace(task.problem, mode="faithful"), task.truth.frames
    shared = {n: task.unknown[n] for n in variables.SHARED if n in task.unknown}
    how = (problem.evidence.trust, problem.priors, (0,), frames, "faithful")
    unknown, factors = transitions.start(task.rough, task.latent, shared, *how)
    s = schedule
    work = {"steps": s.steps[2], "short": s.short, "refine": s.refine, "inner": s.inner, "tolerance": s.tolerance}
    unknown, fits = stages.stage_3(problem, unknown, factors, progress=progress, **work)
    return unknown, sum(fit.closures for fit in fits)


def load(path: Path | str) -> list[dict]:
    """What ``run_faithful`` wrote, a row per task.

    Raises:
        DataError: no such file, or another kind of file.
    """
    remedy = f"run python -m motionlab.run_faithful {path}"
    try:
        rows = json.loads(Path(path).read_text(encoding="utf-8"))["tasks"]
        for row in rows:
            pair = row["faithful"]["energy"], row["shooting"]["energy"]
            if len(pair[0]) != len(pair[1]):
                raise ValueError(f"{len(pair[0])} clips and {len(pair[1])}")
        table(rows)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"not a record of faithful fits ({error})", path=path, remedy=remedy) from error
    return rows


def table(rows: Sequence[dict]) -> str:
    """A Markdown table: where each of them ends, clip by clip."""
    head = ("task", "energy: at shooting's start", "faithful", "shooting", "error, cm: stage 2", "faithful", "shooting")
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for row in rows:
        pairs = [(what, who) for what in ("energy", "error") for who in ("start", "faithful", "shooting")]
        cells = [", ".join(f"{value:.3g}" for value in row[who][what]) for what, who in pairs]
        lines.append("| " + " | ".join([row["task"], *cells]) + " |")
    return "\n".join(lines)
