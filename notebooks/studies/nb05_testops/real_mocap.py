"""TestOps on real mocap, filmed by ``data_synth.scenes``: stage 3 against a stage 2 that is tuned on other people.

    PYTHONPATH=notebooks python -m studies.nb05_testops.real_mocap FOLDER OUT.json

Tuned are stage 2's smoothness and a filter after it. Clips are of the people of one part (``subjects.toml``), at most
so many each, evenly through what they did.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch

from data_synth import scenes
from motionlab.humor import pretrained
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule
from motionlab.metrics.intervals import interval
from motionlab.motion import Motion
from motionlab.parallel import one_thread
from studies.nb05_testops.cast import by_person, everyday
from studies.nb05_testops.trials import fit_rivals, fit_together, rival_of, scores, tried
from studies.shared.clips import takes

MEASURES = ("all", "legs", "world", "acceleration", "contact F1")


def filmed(motions: Sequence[Motion], seed: int) -> dict[str, scenes.Scene]:
    """Films the clips in every view."""
    return {view: scenes.film_recorded(view, motions, seed=seed) for view in scenes.VIEWS}


def compare(
    practice: dict[str, scenes.Scene], tested: dict[str, scenes.Scene], people: Sequence[str], priors: Priors
) -> dict[str, dict]:
    """Computes errors of stage 3 and of the stage 2 that is best on practice clips (of legs, or of all joints in plain
    view) in every view, and their paired differences, by person."""
    schedule, generator, found = Schedule.lean(), torch.Generator().manual_seed(0), {}
    grid = {"smoothness": (100.0, 10.0, 1.5, 0.5, 0.15), "pose": (1.0,), "windows": (0, 5, 9, 15)}
    scored = tried(practice, priors, schedule, **grid)
    best = {view: rival_of(scored, view, "all" if view == "plain view" else "legs") for view in practice}
    fits = fit_together(tested, priors, schedule=schedule)
    for view, scene in tested.items():
        plain = fit_rivals({view: scene}, {view: best[view]}, priors, schedule)
        two = scores(plain[view], scene.truth, scene.seen)
        three = scores(fits[view].stages[3], scene.truth, scene.seen)
        found[view] = vars(best[view]) | {"clips": len(people)}
        for name in MEASURES:
            a, b = by_person(three[name], people), by_person(two[name], people)
            found[view][name] = {
                "stage 3": float(a.mean()),
                "tuned stage 2": float(b.mean()),
                "difference": interval(a - b, "mean", generator),
                "people": len(a),
            }
    return found


def main() -> None:
    """Runs from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--part", default="report", choices=("choose", "report"))
    parser.add_argument("--clips", type=int, default=24)
    options = parser.parse_args()
    one_thread()
    cast, others = (
        everyday(takes(options.folder, part), count) for part, count in ((options.part, options.clips), ("choose", 8))
    )
    tested, practice = filmed(cast.motions, seed=1), filmed(others.motions, seed=2)
    found = compare(practice, tested, cast.people, pretrained.load_priors())
    told = {"part": options.part, "people": sorted(set(cast.people)), pretrained.DEFAULT: found}
    options.out.write_text(json.dumps(told, indent=1) + "\n")
    for view, row in found.items():
        print(view, {m: row[m] for m in ("all", "legs", "acceleration")})


if __name__ == "__main__":
    main()
