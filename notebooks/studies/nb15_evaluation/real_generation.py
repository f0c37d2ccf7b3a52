"""What a diffusion model of real motion generates, beside people nobody trained on.

    PYTHONPATH=notebooks python -m studies.nb15_evaluation.real_generation FOLDER [--models ...] [--part choose]

Beside each model that corrects a filter stands that filter alone, and beside all "people who train": as many windows of
those whom it learnt from, which is as near as a generator of what it saw can come. All sets have one size, as coverage
depends on it. Intervals are 1.96 deviations between random halves of the people of the report, which is about what so
many people leave open (Shao and Wu 1989); a bootstrap would draw people twice, which coverage takes for a lack of
variety. Coverage and Frechet distance are the measures that the ruler (``real_ruler``) nearly passed; recall is printed
because it was asked for, and is no ruler. The result goes into the model's recipe.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import torch
from torch import Tensor

from motionlab import checkpoint, corpus, splits
from motionlab.bench.person_windows import person_windows
from motionlab.diffusion import completer
from motionlab.diffusion.embedding import motion_features
from motionlab.diffusion.model import motion_model, silenced
from motionlab.files import write_whole
from motionlab.metrics import generation
from motionlab.metrics.pose import masked_mean
from motionlab.models import REPORT
from motionlab.motion import Motion
from motionlab.skeleton import BALLS, STANDARD

FRAMES, EACH, DRAWS = 60, 24, 40  # of a window; windows of a person; halves
STEPS, MANY, DRAWN = 50, 250, 25  # of the samplers: of models of filters, the plain one, completers
DOWN = 0.03  # metres above where a ball rests


def slide_mm(motion: Motion) -> Tensor:
    """mm per frame (N,) that balls of the feet move while they are down; NaN where none is."""
    balls = motion.positions[..., STANDARD.indices(BALLS), :]
    down = balls[..., 2] - STANDARD.sole < DOWN
    return masked_mean(1000 * balls[..., :2].diff(dim=-3).norm(dim=-1), down[:, 1:] & down[:, :-1], 2)


def travel(motion: Motion) -> Tensor:
    """Speed (N,) of the pelvis over the floor, m/s."""
    return motion.fps * motion.root[..., :2].diff(dim=-2).norm(dim=-1).mean(-1)


def scored(made: Motion, real: Motion, rows: Tensor, features, latent: Tensor) -> dict[str, float]:
    """Every number of a set of windows beside the rows (M,) of the real ones, whose features ``latent`` are."""
    x, y = features(made), latent[rows]
    skating, moving = slide_mm(made).nanmean(), travel(made).mean()
    return {
        "coverage": generation.density_coverage(x, y).coverage,
        "recall": generation.precision_recall(x, y).recall,
        "frechet": generation.frechet(x, y).value,
        "slide over the data's": float(skating / slide_mm(real)[rows].nanmean()),
        "travel over the data's": float(moving / travel(real)[rows].mean()),
    }


def sampled(name: str, count: int) -> dict[str, Motion]:
    """Windows (count, T) from nothing known, by model and its filter."""
    generator = torch.Generator().manual_seed(0)
    if name.startswith("completer"):
        still = torch.eye(3).expand(count, FRAMES, len(STANDARD), 3, 3)
        motion = Motion(STANDARD, torch.zeros(count, FRAMES, 3), still, 30.0)
        known = torch.zeros(count, FRAMES, len(STANDARD) + 2, dtype=torch.bool)
        return {name: completer.load(name).complete(motion, known, generator, steps=DRAWN)}
    model = motion_model(name)
    both = {name: model} | ({f"{name}, filter alone": silenced(model)} if model.recipe.spectral else {})
    steps = STEPS if model.recipe.spectral else MANY
    return {title: each.sample(count, generator, steps=steps) for title, each in both.items()}


def measure(names: list[str], folder: str, part: str) -> dict[str, dict[str, dict[str, float]]]:
    """By model and by what stands beside it: value, and the ends of its interval over people."""
    features, generator = motion_features("features_real"), torch.Generator().manual_seed(0)
    takes = corpus.assemble(folder, splits.real_sources(folder))
    real, whose, _ = person_windows(takes.part(part), FRAMES, EACH)
    learnt = person_windows(takes.part("train"), FRAMES, EACH).motion
    some = torch.randperm(len(learnt.root), generator=generator)[: len(real.root)]
    sets = {"people who train": replace(learnt, root=learnt.root[some], rot=learnt.rot[some], contacts=None)}
    for name in names:
        sets |= sampled(name, len(real.root))
    latent, people, found = features(real), int(whose.max()) + 1, {}
    for title, made in sets.items():
        value = scored(made, real, torch.arange(len(whose)), features, latent)
        halves = [torch.randperm(people, generator=generator)[: people // 2] for _ in range(DRAWS)]
        draws = [scored(made, real, torch.isin(whose, some).nonzero()[:, 0], features, latent) for some in halves]
        found[title] = {}
        for what, mean in value.items():
            wide = 1.96 * float(torch.tensor([draw[what] for draw in draws]).std())
            found[title][what] = {"mean": mean, "low": mean - wide, "high": mean + wide, "people": people}
        print(title, {k: f"{v['mean']:.2f} [{v['low']:.2f}, {v['high']:.2f}]" for k, v in found[title].items()})
    return found


def main() -> None:
    """Measures, prints and keeps in each model's recipe."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("--models", nargs="+", default=["completer_draws", "diffusion_real_free", "diffusion_plain"])
    parser.add_argument("--part", choices=("choose", "report"), default="report")
    options = parser.parse_args()
    found = measure(options.models, options.folder, options.part)
    for name in options.models if options.part == "report" else ():
        path, rows = checkpoint.SHIPPED / f"{name}.json", {}
        for title in [t for t in (name, f"{name}, filter alone", "people who train") if t in found]:
            who = "" if title == name else ", " + title.removeprefix(f"{name}, ")
            rows |= {f"generated, {what}{who}": value for what, value in found[title].items()}
        about = checkpoint.read_recipe(path)
        write_whole(path, json.dumps(about | {REPORT: about.get(REPORT, {}) | rows}, indent=1) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
