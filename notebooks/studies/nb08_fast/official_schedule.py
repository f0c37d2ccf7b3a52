"""The official schedule run to its end, and our search on the same clips: where do they end?

It takes five to fifteen minutes of one core for three clips. So ``make records`` leaves a record, which notebook 08
shows; from ``notebooks/``: ``python -m studies.nb08_fast.official_schedule results/long/faithful.json``. Both lower the
same energy of stage 3, from the same stages 1 and 2: one by the official form's code, its rotation vectors, its start
and its three sub-stages, the other as ``fit`` does, here with the solver's first plan.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from data_synth import scenes
from motionlab import files
from motionlab.humor import feedback_solver, pretrained, stages, unknowns
from motionlab.humor import start as starts
from motionlab.humor.energies import JOINTS, KEYPOINTS, RGB_LIGHT
from motionlab.humor.testops import Schedule
from motionlab.humor.unknowns import Unknowns
from studies.nb08_fast import trials
from studies.nb08_fast.trials import Task, clock
from studies.shared import joints, savings

WALK = "walking, legs hidden"
SEED, FRAMES, CLIPS = 216, 60, 3  # clips that nothing else has used
#: The official budget without a tolerance: a sub-stage ends when it is spent, or where nothing lower is found.
FULL = Schedule(tolerance=0.0)
_OURS = ("shooting", "guesses")  # the work of another solver; and an addition, off
OFFICIAL = {n: list(x) if isinstance(x, tuple) else x for n, x in asdict(FULL).items() if n not in _OURS}
RECIPE = {"prior": pretrained.DEFAULT, "seed": SEED, "frames": FRAMES, "clips": CLIPS, "threads": 1}
RECIPE["official"] = OFFICIAL


def tasks() -> Iterator[Task]:
    """Clips of joints with noise, of hidden low joints, and of keypoints of a walk behind a wall."""
    known = pretrained.load_priors()
    truth = scenes.held_out(CLIPS, seed=SEED, frames=FRAMES)
    film = scenes.film(WALK, CLIPS, seed=SEED + 1, frames=FRAMES)
    noisy = joints.noisy(truth, torch.Generator().manual_seed(SEED))
    for name, seen, weights, moved, cameras in (
        ("noisy joints", noisy, JOINTS, truth, None),
        ("low joints hidden", joints.low_hidden(truth), KEYPOINTS, truth, None),
        (WALK, film.observation, RGB_LIGHT, film.truth, film.cameras),
    ):
        yield trials.prepare(name, seen, known, weights, moved, cameras=cameras)


def compared(task: Task, schedule: Schedule) -> dict[str, object]:
    """Energies and errors (cm) of all clips by both, each by its own form's roll-out, and seconds of one core."""
    began = clock()
    unknown, closures = in_full(task, schedule)
    spent, problem = clock() - began, replace(task.problem, **savings.OFFICIAL)
    with torch.no_grad():
        end = sum(stages.motion_terms(problem, unknown).values())
        body = problem.roll(unknown, problem.priors, problem.evidence).body
    error = task.error(unknowns.motion_of(body, task.truth.fps))
    theirs = _row(end, error, closures=closures, seconds=round(spent, 1))
    began, plan = clock(), feedback_solver.Plan()
    second = task.begun(starts.DAMPING_ROLLOUT).unknown
    found, _ = feedback_solver.solve(task.problem, task.unknown, plan, second_start=second)
    spent = round(clock() - began, 1)
    ours = _row(task.energy(found), task.error(task.motion(found)), seconds=spent, plan=asdict(plan))
    start = _row(task.energy(task.unknown), task.error(task.rough))
    return {"task": task.name, "faithful": theirs, "shooting": ours, "start": start}


def _row(energy: Tensor, error: Tensor, **more: object) -> dict[str, object]:
    return {"energy": [round(x, 4) for x in energy.tolist()], "error": [round(x, 4) for x in error.tolist()]} | more


def in_full(task: Task, schedule: Schedule) -> tuple[Unknowns, int]:
    """The unknowns that the faithful form's stage 3 ends with, after all of its sub-stages, and how many closures."""
    problem = replace(task.problem, **savings.OFFICIAL)
    how = (problem.evidence.confidence_per_joint, problem.priors, "official")
    unknown, factors = starts.start_stage_3(task.rough, task.latent, task.unknown.shared(), *how)
    work = {name: getattr(schedule, name) for name in ("short", "refine", "inner", "tolerance")}
    unknown, fits = stages.stage_3(problem, unknown, factors, steps=schedule.steps[2], **work)
    return unknown, sum(fit.closures for fit in fits)


def load(path: Path | str) -> list[dict]:
    """What ``make records`` wrote, a row per task."""
    return json.loads(Path(path).read_text(encoding="utf-8"))["tasks"]


def table(rows: Sequence[dict]) -> list[dict[str, object]]:
    """A row per task: what the official schedule and our search take for all its clips together, and where they end."""
    found = []
    for row in rows:
        theirs, ours = row["faithful"], row["shooting"]
        above, off = ([a - b for a, b in zip(theirs[n], ours[n], strict=True)] for n in ("energy", "error"))
        found.append({
            "task": row["task"], "clips": len(above), "official schedule, s": theirs["seconds"],
            "ours, s": ours["seconds"], "times": theirs["seconds"] / ours["seconds"],
            "official ends higher on": sum(x > 0 for x in above), "farther on": sum(x > 0 for x in off),
            "official, cm": sum(theirs["error"]) / len(off), "ours, cm": sum(ours["error"]) / len(off),
        })  # fmt: skip
    return found


if __name__ == "__main__":
    torch.set_num_threads(1)
    done = []
    for one in tasks():
        done.append(compared(one, FULL))
        files.write_whole(Path(sys.argv[1]), json.dumps({"recipe": RECIPE, "tasks": done}, indent=1) + "\n")
