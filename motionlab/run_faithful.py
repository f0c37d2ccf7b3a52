"""Run the faithful schedule to its end on a few clips (``humor.faithful_trials``), a task after another.

``python -m motionlab.run_faithful notebooks/results/long/faithful.json``
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import torch

from data_synth import scenes
from motionlab import writing
from motionlab.humor import priors, solver_trials, three_d
from motionlab.humor.faithful_trials import compared
from motionlab.humor.solver_trials import Task
from motionlab.humor.testops import Schedule
from motionlab.humor.weights import JOINTS, KEYPOINTS, RGB_LIGHT

WALK = "walking, legs hidden"
SEED, FRAMES, CLIPS = 216, 60, 3  # clips that nothing else has used
#: The official budget without a tolerance: a sub-stage ends when it is spent, or where nothing lower is found.
FULL = Schedule(tolerance=0.0)
RECIPE = {"seed": SEED, "frames": FRAMES, "clips": CLIPS, "schedule": "official, no tolerance", "threads": 1}


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
    """Run all tasks; what is done is on disk."""
    torch.set_num_threads(1)
    rows = []
    for task in tasks():
        rows.append(compared(task, FULL, progress=True))
        path.parent.mkdir(parents=True, exist_ok=True)
        writing.write_whole(path, json.dumps({"recipe": RECIPE, "tasks": rows}, indent=1) + "\n")
        print(json.dumps(rows[-1]), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
