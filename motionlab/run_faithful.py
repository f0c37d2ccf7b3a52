"""Run the faithful schedule to its end on a few clips (``humor.faithful_trials``), a task after another.

``python -m motionlab.run_faithful notebooks/results/long/faithful.json``
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from data_synth import scenes
from motionlab import writing
from motionlab.humor import priors, solver_trials, three_d
from motionlab.humor.faithful_trials import compared, load
from motionlab.humor.solver_trials import Task
from motionlab.humor.testops import Schedule
from motionlab.humor.weights import JOINTS, KEYPOINTS, RGB_LIGHT

WALK = "walking, legs hidden"
SEED, FRAMES, CLIPS = 216, 60, 3  # clips that nothing else has used
#: The official budget without a tolerance: a sub-stage ends when it is spent, or where nothing lower is found.
FULL = Schedule(tolerance=0.0)
OFFICIAL = {n: list(x) if isinstance(x, tuple) else x for n, x in asdict(FULL).items() if n != "shooting"}
RECIPE = {"seed": SEED, "frames": FRAMES, "clips": CLIPS, "threads": 1, "official": OFFICIAL}


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


def main(path: Path) -> None:
    """Run all tasks; what is done is on disk. Faithful fits that an earlier run of the same schedule left there are
    not run again."""
    torch.set_num_threads(1)
    rows, before = [], earlier(path)
    for task in tasks():
        rows.append(compared(task, FULL, before=before.get(task.name), progress=True))
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = rows + [row for name, row in before.items() if name not in {r["task"] for r in rows}]
        writing.write_whole(path, json.dumps({"recipe": RECIPE, "tasks": kept}, indent=1) + "\n")
        print(json.dumps(rows[-1]), flush=True)


def earlier(path: Path) -> dict[str, dict]:
    """The rows of a record of this recipe by task; none where there is no such record."""
    if not path.exists():
        return {}
    rows = load(path)
    same = json.loads(path.read_text(encoding="utf-8")).get("recipe") == RECIPE
    return {row["task"]: row for row in rows if same}


def command(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m motionlab.run_faithful", description=__doc__.splitlines()[0])
    parser.add_argument("record", type=Path, help="JSON file, notebooks/results/long/faithful.json")
    main(parser.parse_args(arguments).record)


if __name__ == "__main__":
    command()
