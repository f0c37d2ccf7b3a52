"""The faithful schedule run to its end, and shooting on the same clips: where do they end?

The official budget takes a quarter to half an hour of one core for a clip, too long for a notebook: ``make_record``
leaves a record, which notebook 08 shows.

Both lower the same energy of stage 3, from the same stages 1 and 2: one by the official form's code, its rotation
vectors, its start by the posterior's mean and its three sub-stages, the other as fits do.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor import stages, unknowns
from motionlab.humor import start as starts
from motionlab.humor.shooting.feedback_solver import Plan
from motionlab.humor.testops import Schedule
from motionlab.humor.unknowns import Unknowns
from studies.nb08_fast import trials
from studies.nb08_fast.trials import Task, clock
from studies.official import unknowns as official_unknowns


def compared(
    task: Task,
    schedule: Schedule,
    plan: Plan | None = None,
    *,
    before: Mapping[str, object] | None = None,
    progress: bool = False,
) -> dict[str, object]:
    """Energies and errors (cm) of all clips by both, and of a batch seconds of one core and the faithful closures.

    Each by its own form's roll-out. They differ by a thousandth, since the official heading is off by as much
    (``official.rotation.alignment``).

    before: a row of an earlier run of the same schedule: if it began where this task begins, only shooting is run, and
    the faithful seconds are those of then.
    """
    start = _row(task.energy(task.unknown), task.error(task.rough))
    if before is None or before["start"] != start:
        before = {"faithful": _faithful(task, schedule, progress)}
    run = trials.shot(task, plan := plan or Plan())
    ours = _row(run.end, task.error(task.motion(run.unknown)), seconds=round(float(run.spent), 1), plan=asdict(plan))
    return {"task": task.name, "faithful": before["faithful"], "shooting": ours, "start": start}


def _row(energy: Tensor, error: Tensor, **more: object) -> dict[str, object]:
    return {"energy": [round(x, 4) for x in energy.tolist()], "error": [round(x, 4) for x in error.tolist()]} | more


def _faithful(task: Task, schedule: Schedule, progress: bool) -> dict[str, object]:
    began = clock()
    unknown, closures = in_full(task, schedule, progress=progress)
    spent, problem = clock() - began, replace(task.problem, mode="official", form=official_unknowns.FAITHFUL)
    with torch.no_grad():
        end = sum(stages.motion_terms(problem, unknown).values())
        body = problem.form.roll(unknown, problem.priors, problem.evidence).body
    motion = unknowns.motion_of(body, task.truth.fps)
    return _row(end, task.error(motion), closures=closures, seconds=round(spent, 1))


def in_full(task: Task, schedule: Schedule, *, progress: bool = False) -> tuple[Unknowns, int]:
    """The unknowns that the faithful form's stage 3 ends with, after all of its sub-stages, and how many closures."""
    problem, frames = replace(task.problem, mode="official", form=official_unknowns.FAITHFUL), task.truth.frames
    how = (problem.evidence.trust, problem.priors, (0,), frames, "official")
    unknown, factors = starts.start_stage_3(task.rough, task.latent, task.unknown.shared(), *how)
    s = schedule
    work = {"steps": s.steps[2], "short": s.short, "refine": s.refine, "inner": s.inner, "tolerance": s.tolerance}
    unknown, fits = stages.stage_3(problem, unknown, factors, progress=progress, **work)
    return unknown, sum(fit.closures for fit in fits)


def load(path: Path | str) -> list[dict]:
    """What ``make_record`` wrote, a row per task.

    Raises:
        DataError: no such file, or another kind of file.
    """
    remedy = f"delete it, if it is there, and run make records, or python -m studies.nb08_fast.make_record {path}"
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
    """A Markdown table: where each of them ends, clip by clip, and what that takes, all clips of a task together."""
    head = (
        "task", "energy: at shooting's start", "faithful", "shooting", "error, cm: stage 2", "faithful", "shooting",
        "closures, faithful", "s together: faithful", "shooting",
    )  # fmt: skip
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for row in rows:
        pairs = [(what, who) for what in ("energy", "error") for who in ("start", "faithful", "shooting")]
        cells = [", ".join(f"{value:.3g}" for value in row[who][what]) for what, who in pairs]
        spent = [f"{row[who]['seconds']:.0f}" for who in ("faithful", "shooting")]
        cells += [f"{row['faithful']['closures']:,}", *spent]
        lines.append("| " + " | ".join([row["task"], *cells]) + " |")
    return "\n".join(lines)
