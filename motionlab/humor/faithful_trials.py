"""The faithful schedule run to its end, and shooting on the same clips: where do they end?

The official budget takes a quarter of an hour of one core for a clip, so that this runs apart from the notebooks,
all clips of a task in one batch, and leaves a file which notebook 08 shows:

    python -m motionlab.humor.faithful_trials notebooks/results/long/faithful.json

Both lower the same energy of stage 3, from the same stages 1 and 2: one by the official form's code, its rotation
vectors, its start by the posterior's mean and its three sub-stages, the other as fits do.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from data_synth import scenes
from motionlab import writing
from motionlab.errors import DataError
from motionlab.humor import priors, solver_trials, stages, testops, three_d, transitions, variables
from motionlab.humor.shooting import Plan
from motionlab.humor.solver_trials import Task, clock
from motionlab.humor.weights import JOINTS, KEYPOINTS, RGB_LIGHT

WALK = "walking, legs hidden"
SEED, FRAMES, CLIPS = 216, 60, 2  # clips that nothing else has used


def tasks(count: int = CLIPS, *, seed: int = SEED, frames: int = FRAMES) -> Iterator[Task]:
    """Clips of each of notebook 08's tasks."""
    known = priors.load("compact")
    truth = scenes.held_out(count, seed=seed, frames=frames)
    film = scenes.film(WALK, count, seed=seed + 1, frames=frames)
    noisy = three_d.noisy(truth, torch.Generator().manual_seed(seed))
    for name, seen, weights, moved, cameras in (
        ("noisy joints", noisy, JOINTS, truth, None),
        ("low joints hidden", three_d.low_hidden(truth), KEYPOINTS, truth, None),
        (WALK, film.observation, RGB_LIGHT, film.truth, film.cameras),
    ):
        yield solver_trials.prepare(name, seen, known, weights, moved, cameras=cameras)


def compared(
    task: Task, schedule: testops.Schedule | None = None, plan: Plan | None = None, *, progress: bool = False
) -> dict[str, object]:
    """Energies and errors (cm) of all clips by both, and of a batch the seconds of one core and the closures."""
    began = clock()
    unknown, closures = in_full(task, schedule or testops.Schedule(), progress=progress)
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


def in_full(task: Task, schedule: testops.Schedule, *, progress: bool = False) -> tuple[dict[str, Tensor], int]:
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
    """What :func:`main` wrote, a row per task.

    Raises:
        DataError: no such file, or another kind of file.
    """
    remedy = f"run python -m motionlab.humor.faithful_trials {path}"
    try:
        rows = json.loads(Path(path).read_text(encoding="utf-8"))["tasks"]
        for row in rows:
            pair = row["faithful"]["energy"], row["shooting"]["energy"]
            if len(pair[0]) != len(pair[1]):
                raise KeyError("clips")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"not a record of faithful fits ({error})", path=path, remedy=remedy) from error
    return rows


def main(path: Path) -> None:
    """Run all tasks; what is done is on disk."""
    torch.set_num_threads(1)
    rows = []
    for task in tasks():
        rows.append(compared(task, progress=True))
        recipe = {"seed": SEED, "frames": FRAMES, "clips": CLIPS, "schedule": "official", "threads": 1}
        path.parent.mkdir(parents=True, exist_ok=True)
        writing.write_whole(path, json.dumps({"recipe": recipe, "tasks": rows}, indent=1) + "\n")
        print(json.dumps(rows[-1]), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
