"""Run the faithful schedule to its end on a few clips (``official_schedule``), a task after another.

``make records`` runs it; from ``notebooks/``: ``python -m studies.nb08_fast.make_record results/long/faithful.json``
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from data_synth import scenes
from motionlab import files
from motionlab.humor import pretrained
from motionlab.humor.energies import JOINTS, KEYPOINTS, RGB_LIGHT
from motionlab.humor.testops import Schedule
from studies.nb08_fast import trials
from studies.nb08_fast.official_schedule import compared, load
from studies.nb08_fast.trials import Task
from studies.shared import joints

WALK = "walking, legs hidden"
SEED, FRAMES, CLIPS = 216, 60, 3  # clips that nothing else has used
#: The official budget without a tolerance: a sub-stage ends when it is spent, or where nothing lower is found.
FULL = Schedule(tolerance=0.0)
OFFICIAL = {n: list(x) if isinstance(x, tuple) else x for n, x in asdict(FULL).items()}
for _not_official in ("shooting", "guesses"):  # the work of another solver; and an addition, off
    del OFFICIAL[_not_official]
RECIPE = {"seed": SEED, "frames": FRAMES, "clips": CLIPS, "threads": 1, "official": OFFICIAL}


def tasks(count: int = CLIPS, *, seed: int = SEED, frames: int = FRAMES) -> Iterator[Task]:
    """Clips of each of notebook 08's tasks."""
    known = pretrained.load_priors("compact")
    truth = scenes.held_out(count, seed=seed, frames=frames)
    film = scenes.film(WALK, count, seed=seed + 1, frames=frames)
    noisy = joints.noisy(truth, torch.Generator().manual_seed(seed))
    for name, seen, weights, moved, cameras in (
        ("noisy joints", noisy, JOINTS, truth, None),
        ("low joints hidden", joints.low_hidden(truth), KEYPOINTS, truth, None),
        (WALK, film.observation, RGB_LIGHT, film.truth, film.cameras),
    ):
        yield trials.prepare(name, seen, known, weights, moved, cameras=cameras)


def main(path: Path) -> None:
    """Run all tasks; what is done is on disk. Faithful fits that an earlier run of the same schedule left there are
    not run again."""
    torch.set_num_threads(1)
    rows, before = [], earlier(path)
    for task in tasks():
        rows.append(compared(task, FULL, before=before.get(task.name), progress=True))
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = rows + [row for name, row in before.items() if name not in {r["task"] for r in rows}]
        files.write_whole(path, json.dumps({"recipe": RECIPE, "tasks": kept}, indent=1) + "\n")
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
    parser = argparse.ArgumentParser(
        prog="python -m studies.nb08_fast.make_record", description=__doc__.splitlines()[0]
    )
    parser.add_argument("record", type=Path, help="JSON file, notebooks/results/long/faithful.json")
    main(parser.parse_args(arguments).record)


if __name__ == "__main__":
    command()
