"""TestOps on real mocap, filmed by ``data_synth.scenes``: stage 3 against a stage 2 that is tuned on other people.

    PYTHONPATH=notebooks python -m studies.nb05_testops.real_mocap FOLDER OUT.json --priors compact real

Tuned are stage 2's smoothness and a filter after it. Clips are of the people of one part (``people.toml``), at most so
many each, evenly through what they did.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from data_synth import scenes
from motionlab import corpus, splits
from motionlab.humor import pretrained
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule
from motionlab.metrics.intervals import interval
from motionlab.motion import Motion
from motionlab.parallel import one_thread
from studies.nb05_testops.trials import Rival, fit_rivals, fit_together, rival_of, scores, tried

FRAMES = 60
MEASURES = ("all", "legs", "world", "acceleration", "contact F1")


def clips(folder: Path | str, part: str, count: int) -> list[tuple[str, Motion]]:
    """Returns at most ``count`` clips of two seconds with who performs them, as evenly over people as can be."""
    takes = [t for t in corpus.assemble(folder, splits.real_sources(folder)).part(part) if t.source == "cmu_library"]
    by_person: dict[str, list[Motion]] = {}
    for take in takes:
        for start in range(0, take.motion.frames - FRAMES + 1, FRAMES):
            by_person.setdefault(take.person, []).append(take.motion.cut(start, start + FRAMES))
    each = -(-count // len(by_person))
    found = [(who, motion) for who, motions in by_person.items() for motion in splits.evenly(motions, each + 2)[1:-1]]
    return splits.evenly(found, count)


def filmed(motions: Sequence[Motion], seed: int) -> dict[str, scenes.Scene]:
    """Films the clips in every view."""
    return {view: scenes.film_recorded(view, motions, seed=seed) for view in scenes.VIEWS}


def tuned_stage_2(practice: dict[str, scenes.Scene], priors: Priors, schedule: Schedule) -> dict[str, Rival]:
    """Finds for each view the stage 2 with the least error of legs, or of all joints in plain view."""
    found = tried(
        practice, priors, schedule, smoothness=(100.0, 10.0, 1.5, 0.5, 0.15), pose=(1.0,), windows=(0, 5, 9, 15)
    )
    return {view: rival_of(found, view, "all" if view == "plain view" else "legs") for view in practice}


def compare(
    practice: dict[str, scenes.Scene], tested: dict[str, scenes.Scene], people: Sequence[str], priors: Priors
) -> dict[str, dict]:
    """Computes errors of stage 3 and of the tuned stage 2 in every view, and their paired differences, by person."""
    schedule, generator, found = Schedule.lean(), torch.Generator().manual_seed(0), {}
    best = tuned_stage_2(practice, priors, schedule)
    fits = fit_together(tested, priors, schedule=schedule)
    for view, scene in tested.items():
        plain = fit_rivals({view: scene}, {view: best[view]}, priors, schedule)
        two = scores(plain[view], scene.truth, scene.seen)
        three = scores(fits[view].stages[3], scene.truth, scene.seen)
        found[view] = vars(best[view]) | {"clips": len(people)}
        for name in MEASURES:
            a, b = _by_person(three[name], people), _by_person(two[name], people)
            found[view][name] = {
                "stage 3": float(a.mean()),
                "tuned stage 2": float(b.mean()),
                "difference": interval(a - b, "mean", generator),
                "people": len(a),
            }
    return found


def _by_person(values: Tensor, people: Sequence[str]) -> Tensor:
    """The mean of every person's clips."""
    names = sorted(set(people))
    rows = [values[[i for i, who in enumerate(people) if who == name]].nanmean() for name in names]
    return torch.stack(rows)


def main() -> None:
    """Runs from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--priors", nargs="+", default=["compact", "real"])
    parser.add_argument("--part", default="report", choices=("choose", "report"))
    parser.add_argument("--clips", type=int, default=24)
    options = parser.parse_args()
    one_thread()
    people, motions = zip(*clips(options.folder, options.part, options.clips), strict=True)
    _, others = zip(*clips(options.folder, "choose", 8), strict=True)
    tested, practice = filmed(motions, seed=1), filmed(others, seed=2)
    found = {name: compare(practice, tested, people, pretrained.load_priors(name)) for name in options.priors}
    options.out.write_text(json.dumps({"part": options.part, "people": sorted(set(people))} | found, indent=1) + "\n")
    for name, views in found.items():
        for view, row in views.items():
            print(name, view, {m: row[m] for m in ("all", "legs", "acceleration")})


if __name__ == "__main__":
    main()
