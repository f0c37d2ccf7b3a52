"""Hidden legs, gaps and joints of people nobody trained on: a model that is told, against rivals of the same hours.

    PYTHONPATH=notebooks python -m studies.nb11_cases.real_people FOLDER [--model diffusion_real_told]

Rivals learn from windows of the people who train, settings of everybody are chosen on the people who choose, and the
people of the report are used once. Every person counts alike; intervals are by bootstrap over people. The result goes
into the model's recipe, where ``python -m motionlab models`` reads it.

Most recordings are of a figure without toes and with a stiff back. Nobody is asked for a joint that a figure does not
have: it stays as it came, whoever fills in the rest, and the model, which learnt never to be told of it, is not.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor
from tqdm import tqdm

from motionlab import checkpoint, corpus, shipped, splits
from motionlab.bench import cases, rivals
from motionlab.bench.judge import CASES, FRAMES, judged
from motionlab.bench.person_windows import person_windows
from motionlab.diffusion.inpainting import Way, repair
from motionlab.diffusion.model import Trained, motion_model, silenced
from motionlab.diffusion.start import InitialGuess
from motionlab.diffusion.windows import gather, on_standard
from motionlab.files import write_whole
from motionlab.metrics import intervals
from motionlab.models import REPORT
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

EACH, PRACTICE = 24, 8  # windows of each person, for the report and to choose on
LEARNT, RECALLED = 30_000, 12_000  # training windows that the rivals learn from, and that the start recalls
FADES = (0, 5, 10)  # frames over which the jump at the edge of what is known may fade
STEPS = (1, 2, 5, 25)  # of the sampler
TOLD = ("told", "own start alone")
Fill = Callable[..., Motion]


def contenders(model: Trained, learnt: Motion, clips: Tensor, generator: torch.Generator) -> dict[str, tuple]:
    """Everybody by name: a function of (motion, known, setting), and one of whether the mask has edges in time, which
    gives the settings to choose from. ``TOLD`` are not told of joints that a figure lacks."""
    fitted = rivals.Rivals.fit(learnt, generator)
    start = InitialGuess(FRAMES, model.layout.size, RECALLED)
    start.measure(model.encode(learnt), clips, generator)

    def told(motion: Motion, known: Tensor, how: tuple[int, int], who: Trained = model) -> Motion:
        way = Way(put="nothing", steps=how[0], finish=how[1])
        return repair(who, motion, cases.columns(who.layout, known), torch.Generator().manual_seed(0), way)

    def alone(motion: Motion, known: Tensor, how: int, who: Trained) -> Motion:
        return told(motion, known, (1, how), who)

    recalled = replace(model, denoiser=_Silent(start), recipe=replace(model.recipe, told=True))

    def ridge(motion: Motion, known: Tensor, how: tuple[float, int]) -> Motion:
        return replace(fitted, ridge=how[0]).regression(motion, known, how[1])

    def both(first: Sequence, edges: bool) -> list[tuple]:
        return [(x, fade) for x in first for fade in (FADES if edges else (0,))]

    plain = {"mean pose": fitted.mean, "nearest": fitted.nearest, "start alone": partial(alone, who=recalled)}
    plain["own start alone"] = partial(alone, who=silenced(model))
    found = {name: (fill, lambda edges: FADES if edges else (0,)) for name, fill in plain.items()}
    between = lambda motion, known, how: rivals.interpolated(motion, known)  # noqa: E731
    found["slerp"] = (between, lambda edges: (0,) if edges else ())  # needs a frame on either side
    found["ridge"] = (ridge, partial(both, rivals.RIDGES))
    return found | {"told": (told, partial(both, STEPS))}


class _Silent(torch.nn.Module):
    """The start, as a model that says nothing more."""

    def __init__(self, start: InitialGuess) -> None:
        super().__init__()
        self.start, self.none = start, torch.nn.Parameter(torch.zeros(()), requires_grad=False)

    def forward(self, x: Tensor, stamps: Tensor, known: Tensor, mask: Tensor) -> Tensor:
        return self.start.eval()(known, mask.expand_as(x) > 0)


def measure(name: str, folder: str) -> tuple[dict[str, dict[str, float]], dict[str, object]]:
    """Everybody on every case: means and intervals over people of what they leave and of how much more each rival
    leaves than the model that is told, by measure; and the settings that were chosen."""
    model, generator = motion_model(name), torch.Generator().manual_seed(0)
    found = corpus.assemble(folder, splits.real_sources(folder))
    train = [m for some in shipped.real_motions(folder).train.values() for m in some if m.frames >= FRAMES]
    learnt, clips = gather([on_standard(m) for m in tqdm(train, desc="windows")], FRAMES).drawn(LEARNT, generator)
    everybody = contenders(model, replace(learnt, skeleton=STANDARD), clips, generator)
    practice, report = (person_windows(found.part(p), FRAMES, n) for p, n in (("choose", PRACTICE), ("report", EACH)))
    rows, chosen = {}, {}
    for title, case in CASES.items():
        some = {}
        for who, (fill, settings) in everybody.items():
            if not (options := list(settings(case.edges))):
                continue
            judge = lambda how, some: judged(lambda m, k: fill(m, k, how), case, some, lacking=who not in TOLD)  # noqa: B023, E731
            left = [float(judge(o, practice)["cm"].mean()) for o in options]
            best = chosen[f"{title}: {who}"] = options[left.index(min(left))]
            some[who] = judge(best, report)
            print(f"{title}: {who} {best}: {float(some[who]['cm'].mean()):.1f} cm", flush=True)
        for who, each in some.items():
            rows[f"{title}, {who}, cm"] = _over_people(each["cm"], generator)
            if who != "told":
                rows[f"{title}, {who} minus told, cm"] = _over_people(each["cm"] - some["told"]["cm"], generator)
        for what, unit in {"slide": "slide, mm per frame", "acceleration": "acceleration over the truth's"}.items():
            rows[f"{title}, told, {unit}"] = _over_people(some["told"][what], generator)
    return rows, chosen


def _over_people(values: Tensor, generator: torch.Generator) -> dict[str, float]:
    values = values[values.isfinite()]
    mean, low, high = intervals.interval(values, "mean", generator)
    return {"mean": mean, "low": low, "high": high, "people": len(values)}


def main() -> None:
    """Measures, prints and keeps in the model's recipe."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("--model", default="diffusion_real_told")
    options = parser.parse_args()
    found, chosen = measure(options.model, options.folder)
    path = checkpoint.SHIPPED / f"{options.model}.json"
    about = checkpoint.read_recipe(path) | {REPORT: found, "settings, by the people who choose": chosen}
    write_whole(path, json.dumps(about, indent=1) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
