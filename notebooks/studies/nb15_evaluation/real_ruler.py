"""Is what generated motion is judged by a ruler? Real motion of people whom nothing learnt from, against spoilt motion.

    PYTHONPATH=notebooks python -m studies.nb15_evaluation.real_ruler FOLDER [--features features_real] [--part choose]

The people are parted at random into halves: one is the reference, the other stands for a generator that is perfect, and
spoilt for one that is not. A measure may decide a verdict if it ranks every fault below the motion as it was, in 95 of
100 partings or more. Feet of the CMU library slide by 10 cm/s themselves; sliding of 40 cm/s was added after no measure
had passed that of 20. The result goes into the features' recipe.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import torch

from motionlab import checkpoint, corpus, rotation, splits
from motionlab.bench.person_windows import person_windows
from motionlab.diffusion.embedding import motion_features
from motionlab.files import write_whole
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from studies.nb15_evaluation.measures import MEASURES, judged, score, spoilt

FRAMES, EACH, DRAWS, ENOUGH = 60, 48, 40, 0.95  # of a window; windows of a person; partings; share of them
RULER = "ruler"  # in the recipe


def faults(long: Motion, generator: torch.Generator) -> dict[str, Motion]:
    """The first half of each window as it was and with one fault each; twice as fast: every second frame of all."""
    long = replace(long, contacts=None)
    plain = replace(long, root=long.root[:, :FRAMES], rot=long.rot[:, :FRAMES])
    made = spoilt(plain, generator)
    count, joints = len(plain.root), len(STANDARD)
    mean = rotation.mean(plain.rot.flatten(0, 1)[::50].transpose(0, 1))
    order = torch.cat((torch.zeros(count, 1), 1 + torch.rand(count, joints - 1, generator=generator)), 1).argsort(1)
    shuffled = plain.rot.gather(2, order[:, None, :, None, None].expand_as(plain.rot))
    up = torch.tensor([0.0, 0.0, 1.0])
    middle = plain.root.mean((0, 1)) * up  # where nobody goes anywhere
    return {
        "as it was": plain,
        "frozen": made["frozen"],
        "mean pose": replace(plain, root=middle.expand_as(plain.root), rot=mean.expand_as(plain.rot)),
        "trembling 2 degrees": made["trembling 2 degrees"],
        "sliding 20 cm/s": made["slid 20 cm/s"],
        "sliding 40 cm/s": replace(plain, root=2 * made["slid 20 cm/s"].root - plain.root),
        "floating 15 cm": replace(plain, root=plain.root + 0.15 * up),
        "twice as fast": replace(long, root=long.root[:, ::2], rot=long.rot[:, ::2]),
        "joints shuffled": replace(plain, rot=shuffled),
    }


def badness(name: str, value: float) -> float:
    """How bad a value of a measure is: less is better."""
    goal = MEASURES[name]
    return {"low": value, "high": -value, "0": abs(value), "1": abs(value - 1)}[goal]


def measure(features_name: str, folder: str, part: str) -> dict[str, dict[str, dict[str, float]]]:
    """By fault and measure: mean over partings, and the share of them in which it ranks below the motion as it was."""
    features, generator = motion_features(features_name), torch.Generator().manual_seed(0)
    takes = corpus.assemble(folder, splits.real_sources(folder)).part(part)
    long, whose, _ = person_windows(takes, 2 * FRAMES, EACH)
    every = {name: judged(motion, features) for name, motion in faults(long, generator).items()}
    people, rows = int(whose.max()) + 1, {name: [] for name in every}
    for _ in range(DRAWS):
        order = torch.randperm(people, generator=generator)
        reference, other = (torch.isin(whose, some).nonzero()[:, 0] for some in order.split(-(-people // 2)))
        seed = int(torch.randint(2**31, (), generator=generator))
        for name, seen in every.items():
            real = every["as it was"].some(reference)
            rows[name].append(score(seen.some(other), real, features, torch.Generator().manual_seed(seed)))
    found = {}
    for name, some in rows.items():
        found[name] = {}
        for what in MEASURES:
            values = torch.tensor([row[what] for row in some])
            worse = [
                badness(what, a[what]) > badness(what, b[what]) for a, b in zip(some, rows["as it was"], strict=True)
            ]
            found[name][what] = {"mean": float(values.mean()), "below": sum(worse) / DRAWS}
    return found


def qualified(found: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    """The measures that rank every fault below the motion as it was."""
    wrong = [name for name in found if name != "as it was"]
    return [what for what in MEASURES if all(found[name][what]["below"] >= ENOUGH for name in wrong)]


def main() -> None:
    """Measures, prints and keeps in the features' recipe."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("--features", default="features_real")
    parser.add_argument("--part", choices=("choose", "report"), default="choose")
    options = parser.parse_args()
    found = measure(options.features, options.folder, options.part)
    print(" " * 22 + "".join(f"{what[:14]:>16}" for what in MEASURES))
    for name, row in found.items():
        print(f"{name:22}" + "".join(f"{row[w]['mean']:9.3g} {100 * row[w]['below']:4.0f} %" for w in MEASURES))
    print("rank every fault below real motion:", ", ".join(qualified(found)) or "none")
    path = checkpoint.SHIPPED / f"{options.features}.json"
    if path.exists():
        kept = checkpoint.read_recipe(path)
        kept[RULER] = kept.get(RULER, {}) | {
            f"people of {options.part}": {"qualified": qualified(found), "rows": found}
        }
        write_whole(path, json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
