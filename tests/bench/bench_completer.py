"""A window completed by one answer, and by draws of 1 to 50 steps: milliseconds of one core, and what they leave.

With recordings in MOTIONLAB_DATA on the people who choose; without, on synthetic windows, which the models know.
"""

import os
import time

import torch

from data_synth import corpus
from motionlab.bench import judge
from motionlab.bench.person_windows import PersonWindows
from motionlab.diffusion import completer
from motionlab.diffusion.windows import gather, on_standard
from motionlab.skeleton import STANDARD

STEPS = (1, 2, 5, 10, 25, 50)


def some_windows() -> PersonWindows:
    if folder := os.environ.get("MOTIONLAB_DATA"):
        return judge.people(folder, "choose", each=12)
    motions = [on_standard(s.motion) for s in corpus.build(version="B").heldout_sequences]
    motion = gather(motions, judge.FRAMES).evenly(64)
    whose = torch.zeros(64, dtype=torch.long)
    return PersonWindows(motion, whose, torch.zeros(64, 1, len(STANDARD) + 2, dtype=torch.bool))


def main() -> None:
    torch.set_num_threads(1)
    windows, one, many = some_windows(), completer.load("completer"), completer.load("completer_draws")
    generator = torch.Generator().manual_seed(0)
    ways = {"one answer": one.complete} | {
        f"a draw, {n} steps": lambda m, k, n=n: many.complete(m, k, generator, steps=n) for n in STEPS
    }
    for name, case in judge.CASES.items():
        print(name)
        for way, fill in ways.items():
            begin = time.process_time()
            error = float(judge.judged(fill, case, windows)["cm"].mean())
            spent = 1000 * (time.process_time() - begin) / len(windows.motion.root)
            print(f"  {way:18} {error:5.1f} cm  {spent:6.1f} ms a window, measuring included")


if __name__ == "__main__":
    main()
