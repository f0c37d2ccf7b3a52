"""Tune every search of notebook 07 (``tuning``), two walks at a time.

``make records`` runs it; from ``notebooks/``: ``python -m studies.nb07_decoupled.make_record results/long/tuning.json``
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch

from data_synth import scenes
from motionlab.humor import pretrained
from motionlab.humor.testops import Schedule
from studies.nb07_decoupled import trials, tuning, tuning_record
from studies.nb07_decoupled.tuning_record import Recipe

#: As notebook 07 has it.
RECIPE = Recipe(
    seed=1, clips=3, frames=60, short=30, long=100, schedule="lean", search=800, fixed=2000, rounds=8,
    steps=(1, 2, 5, 10),
)  # fmt: skip


def practised(recipe: Recipe) -> Callable[..., trials.Case]:
    """The practice clips, as (frames=, solver=) says (``trials.case``)."""
    coach = scenes.film(recipe.scene, recipe.clips, seed=recipe.seed, frames=recipe.long)
    return partial(trials.case, coach, pretrained.load_priors("compact"), getattr(Schedule, recipe.schedule)())


def main(path: Path, *, recipe: Recipe = RECIPE, workers: int = 2) -> None:
    """Walk; what is done is on disk, and a run that was stopped goes on from there."""
    torch.set_num_threads(1)
    known, every = tuning_record.load(path, recipe), tuning_record.searches(recipe)
    print(f"{len(known)} of {len(every)} walks are on record", flush=True)
    if len(known) == len(every):
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    fitted = practised(recipe)
    practice = fitted(frames=recipe.frames, solver="rollout")

    def done(found: dict[tuning_record.Key, tuning.Choice]) -> None:
        tuning_record.save(path, recipe, found)
        key, choice = list(found.items())[-1]
        told = f"{tuning.text(choice.setting)}, {len(choice.rows)} settings, {choice.seconds:.0f} s"
        print(f"z of {': '.join(key)}: {told}{'' if choice.ended else ', not ended'}", flush=True)

    tuning_record.walks(recipe, practice, fitted, workers=workers, known=known, done=done)


def command(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.nb07_decoupled.make_record", description=__doc__.splitlines()[0]
    )
    parser.add_argument("record", type=Path, help="JSON file, notebooks/results/long/tuning.json")
    parser.add_argument("--workers", type=int, default=2, help="walks at a time, a core each (2)")
    given = parser.parse_args(arguments)
    main(given.record, recipe=RECIPE, workers=given.workers)


if __name__ == "__main__":
    command()
