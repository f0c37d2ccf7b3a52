"""How much does the completer gain from more hours of real motion? It is trained on parts of the training people.

    PYTHONPATH=notebooks python -m studies.nb15_what_it_takes.hours FOLDER OUT.json

A part is so many minutes of people in an order drawn by the seed, which the first weights are drawn by as well; the
smaller parts are within the larger ones. Every run takes the same number of steps, and keeps the weights that are best
on the validation people, so that a small part is not judged by what it forgot at the end. Errors are of test people,
each counting alike. Beside it stands ridge regression of the same motion. A run that is in OUT
already is not made again.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from motionlab import bench, corpus, splits
from motionlab.bench import CASES, FRAMES, Fill, PersonWindows, person_windows
from motionlab.corpus import Take
from motionlab.diffusion.completer import CompleterRecipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.files import write_whole
from motionlab.skeleton import STANDARD
from motionlab.training.completer_training import CompleterTraining

SHARES, SEEDS = (1 / 32, 1 / 8, 1 / 2, 1.0), (0, 1, 2)
EACH, PRACTICE = 24, 8  # windows of a person: test, validation
LEGS = "legs hidden"
#: Far fewer steps than of what ships.
COMPLETER = CompleterRecipe(kinds=(("legs", 1.0),), steps=800, batch=32)
RIDGE_ROWS = 12_000  # training windows that the ridge learns from


def part_of_people(takes: Sequence[Take], share: float, seed: int) -> list[Take]:
    """Takes of one person after the other, in an order drawn by the seed, up to a share of all frames; the last take is
    cut off there."""
    names = sorted({take.person for take in takes})
    order = [names[i] for i in torch.randperm(len(names), generator=torch.Generator().manual_seed(seed))]
    left, found = round(share * sum(t.motion.frames for t in takes)), []
    for take in sorted(takes, key=lambda t: order.index(t.person)):
        if left < 90:  # less teaches nothing
            break
        found.append(replace(take, motion=take.motion.cut(0, left)))
        left -= found[-1].motion.frames
    return found


def trained(takes: Sequence[Take], seed: int, val: PersonWindows, test: PersonWindows) -> dict:
    """Trains the completer, of which the best of four averaged models on the way counts, and fits ridge regression, its
    width chosen by the same people."""
    motions, people = [on_standard(t.motion) for t in takes], [t.person for t in takes]
    data = gather(motions, FRAMES, missing=[t.missing for t in takes], people=people)

    def legs(fill: Fill, windows: PersonWindows, lacking: bool = False) -> list[float]:
        return bench.judged(fill, CASES[LEGS], windows, show_missing=lacking)["cm"].tolist()

    run, best = CompleterTraining(replace(COMPLETER, seed=seed), data), float("inf")
    while run.step < run.recipe.steps:
        run.run(until=run.step + run.recipe.steps // 4)
        if (error := sum(legs(run.averaged.complete, val))) < best:
            best, step, model = error, run.step, run.averaged
    generator = torch.Generator().manual_seed(seed)
    fitted = bench.Rivals.fit(replace(data.draw(RIDGE_ROWS, generator), skeleton=STANDARD), generator)
    ridges = {width: replace(fitted, ridge=width).regression for width in bench.RIDGES}
    width = min(ridges, key=lambda width: sum(legs(ridges[width], val, True)))
    found = {"step": step, "ridge's width": width}
    for part, windows in (("val", val), ("test", test)):
        found[part] = {LEGS: legs(model.complete, windows), f"{LEGS}, ridge": legs(ridges[width], windows, True)}
    return found


def main() -> None:
    """Trains what is not there yet and keeps each run as it ends."""
    folder, out = map(Path, sys.argv[1:])
    found = corpus.assemble(folder, splits.real_sources(folder))
    windows = {part: person_windows(found.part(part), FRAMES, n) for part, n in (("val", PRACTICE), ("test", EACH))}
    every = json.loads(out.read_text()) if out.exists() else {}
    rows = every.setdefault("completer", [])
    done = {(row["share"], row["seed"]) for row in rows}
    for seed, share in tqdm([(seed, share) for seed in SEEDS for share in SHARES if (share, seed) not in done]):
        some = part_of_people(found.part("train"), share, seed)
        about = {"share": share, "seed": seed, "people": len({t.person for t in some})}
        about["hours"] = sum(t.motion.seconds for t in some) / 3600
        rows.append(about | trained(some, seed, **windows))
        write_whole(out, json.dumps(every, indent=1) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
