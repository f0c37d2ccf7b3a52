"""How much do models gain from more hours of real motion? Each is trained on parts of the people who train.

    PYTHONPATH=notebooks python -m studies.nb01_data.hours FOLDER OUT.json {prior,completer}

A part is so many minutes of people in an order drawn by the seed, which the first weights are drawn by as well; the
smaller parts are within the larger ones. Every run takes the same number of steps, and keeps the weights that are best
on the people who choose, so that a small part is not judged by what it forgot at the end. Errors are of the people of
the report, each counting alike. Beside the completer stands ridge regression of the same motion. A run that is in OUT
already is not made again.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from tqdm import tqdm

from motionlab import corpus, splits
from motionlab.bench import judge, rivals
from motionlab.bench.judge import CASES, FRAMES, Fill
from motionlab.bench.person_windows import PersonWindows, by_person, person_windows
from motionlab.corpus import Take
from motionlab.diffusion.completer import CompleterRecipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.files import write_whole
from motionlab.humor import quality
from motionlab.humor.cvae import Cvae
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from motionlab.training.chain_training import ChainRecipe, ChainTraining
from motionlab.training.completer_training import CompleterTraining
from motionlab.training.examples import live_examples
from motionlab.training.training_loop import TrainingRun

SHARES, SEEDS = (1 / 32, 1 / 8, 1 / 2, 1.0), (0, 1, 2)
EACH, PRACTICE = 24, 8  # windows of a person: of the report, and to choose on
LEGS = "legs hidden"
#: Far fewer steps than of what ships.
PRIOR = ChainRecipe(steps=400, batch=32, open_loop=0.3, kl=0.002)
COMPLETER = CompleterRecipe(kinds=(("legs", 1.0),), steps=800, batch=32)
RIDGE_ROWS = 12_000  # training windows that the ridge learns from
Errors = dict[str, list[float]]  # by measure, a number for each person


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


def best_of(run: TrainingRun, error: Callable[[object], float]):
    """Trains to the end; of four averaged models on the way the one whose error is least, and its step."""
    best, at, which = float("inf"), 0, None
    while run.step < run.recipe.steps:
        run.run(until=run.step + run.recipe.steps // 4)
        if (found := error(run.averaged)) < best:
            best, at, which = found, run.step, run.averaged
    return which, at


def prior_errors(model: Cvae, takes: Sequence[Take], each: int) -> Errors:
    """What the prior leaves of each person."""
    people: dict[str, list[Motion]] = {}
    for take in takes:
        people.setdefault(take.person, []).append(take.motion)
    found = [x for some in people.values() if len(x := splits.state_windows(some, most=each)[0])]
    whose = torch.cat([torch.full((len(x),), person) for person, x in enumerate(found)])
    states = torch.cat(found)
    step, way = quality.one_step_errors(model, states), quality.rollout_errors(model, states)
    rows = {
        f"one step, {name}": step[name].unflatten(0, (len(states), -1)).mean(1) for name in ("posterior", "prior mean")
    }
    rows |= {f"2 s, {name}": x[:, -1] for name, x in way.items()}
    return {name: by_person(x, whose).tolist() for name, x in rows.items()}


def prior_run(takes: Sequence[Take], seed: int, choose: Sequence[Take], report: Sequence[Take]) -> dict:
    """Trains the prior; chosen by where it is after two seconds with z known."""
    data = live_examples([t.motion for t in takes], PRIOR.length + 1, [t.missing for t in takes])

    def left(model: Cvae) -> float:
        return sum(found := prior_errors(model, choose, PRACTICE)["2 s, posterior z"]) / len(found)

    model, step = best_of(ChainTraining(replace(PRIOR, seed=seed), data), left)
    return {"step": step, "choose": prior_errors(model, choose, PRACTICE), "report": prior_errors(model, report, EACH)}


def completer_run(takes: Sequence[Take], seed: int, choose: PersonWindows, report: PersonWindows) -> dict:
    """Trains the completer and fits ridge regression, its width chosen by the same people."""
    motions, people = [on_standard(t.motion) for t in takes], [t.person for t in takes]
    data = gather(motions, FRAMES, missing=[t.missing for t in takes], people=people)

    def legs(fill: Fill, windows: PersonWindows, lacking: bool = False) -> list[float]:
        return judge.judged(fill, CASES[LEGS], windows, show_missing=lacking)["cm"].tolist()

    run = CompleterTraining(replace(COMPLETER, seed=seed), data)
    model, step = best_of(run, lambda model: sum(legs(model.complete, choose)))
    generator = torch.Generator().manual_seed(seed)
    fitted = rivals.Rivals.fit(replace(data.draw(RIDGE_ROWS, generator), skeleton=STANDARD), generator)
    ridges = {width: replace(fitted, ridge=width).regression for width in rivals.RIDGES}
    width = min(ridges, key=lambda width: sum(legs(ridges[width], choose, True)))
    found = {"step": step, "ridge's width": width}
    for part, windows in (("choose", choose), ("report", report)):
        found[part] = {LEGS: legs(model.complete, windows), f"{LEGS}, ridge": legs(ridges[width], windows, True)}
    return found


def main() -> None:
    """Trains what is not there yet and keeps each run as it ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("out", type=Path)
    parser.add_argument("what", choices=("prior", "completer"))
    options = parser.parse_args()
    found = corpus.assemble(options.folder, splits.real_sources(options.folder))
    train, choose, report = (found.part(part) for part in ("train", "choose", "report"))
    every = json.loads(options.out.read_text()) if options.out.exists() else {}
    rows, run = every.setdefault(options.what, []), partial(prior_run, choose=choose, report=report)
    if options.what == "completer":
        windows = {"choose": person_windows(choose, FRAMES, PRACTICE), "report": person_windows(report, FRAMES, EACH)}
        run = partial(completer_run, **windows)
    done = {(row["share"], row["seed"]) for row in rows}
    for seed, share in tqdm([(seed, share) for seed in SEEDS for share in SHARES if (share, seed) not in done]):
        some = part_of_people(train, share, seed)
        about = {"share": share, "seed": seed, "people": len({t.person for t in some})}
        about["hours"] = sum(t.motion.seconds for t in some) / 3600
        rows.append(about | run(some, seed))
        write_whole(options.out, json.dumps(every, indent=1) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
