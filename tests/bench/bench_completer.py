"""A window completed: milliseconds of one core, and what is left, by one answer and by draws of 1, 10 and 50 steps.

Left is the energy score of two draws; of one answer its error. With recordings in MOTIONLAB_DATA on validation people;
without, on synthetic sequences that nothing was trained on.
"""

import os
import time

import torch

from data_synth import corpus
from motionlab import bench
from motionlab.diffusion import completer
from motionlab.diffusion.windows import gather, on_standard
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

STEPS, CASES = (1, 10, 50), ("legs hidden", "gap of 30 frames", "gap of 45 frames")


def some_windows() -> tuple[Motion, torch.Tensor]:
    """Motions (N, 60), and the units that their figures lack."""
    if folder := os.environ.get("MOTIONLAB_DATA"):
        motion, _, lacks = bench.people(folder, "val", each=4)
        return motion, lacks
    motions = [on_standard(s.motion) for s in corpus.build(version="B").heldout_sequences]
    return gather(motions, bench.FRAMES).evenly(48), torch.zeros(48, 1, len(STANDARD) + 2, dtype=torch.bool)


def main() -> None:
    torch.set_num_threads(1)
    (motion, lacks), one, many = some_windows(), completer.load("completer"), completer.load("completer_draws")
    ways = {"one answer": (lambda known, seed: one.complete(motion, known), 1)}
    for n in STEPS:
        draw = lambda known, seed, n=n: many.complete(motion, known, torch.Generator().manual_seed(seed), steps=n)  # noqa: E731
        ways[f"two draws, {n} steps"] = draw, 2
    for name in CASES:
        case = bench.CASES[name]
        known = case.mask(len(motion.root))
        for way, (fill, count) in ways.items():
            begin = time.process_time()
            made = [fill(known & ~lacks, seed) for seed in range(count)]
            spent = 1000 * (time.process_time() - begin) / count / len(motion.root)
            left = bench.energy_score(
                [bench.restore_known(m, motion, known | lacks) for m in made], motion, known, case.joints
            ).mean()
            print(f"{name:18} {way:20} {float(left):5.2f} cm  {spent:6.1f} ms a window")


if __name__ == "__main__":
    main()
