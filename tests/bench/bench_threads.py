"""When a second thread pays, and what a fit costs beside a busy core: ratios of one run.

The threshold ``parallel.WIDE`` rests on the first table, taken on an idle machine: a roll-out of 20 frames and
its gradient, on one and on two threads in turns.
"""

import multiprocessing
import os
import time

import torch

from data_synth import scenes
from motionlab import parallel, profiling
from motionlab.humor import pretrained, state, testops
from motionlab.humor.rollout import rollout
from studies.shared import joints

BATCHES, FRAMES, ROUNDS = (1, 16, 64, 256, 1024), 20, 3
SCHEDULE = testops.Schedule(steps=(2, 4, 6), inner=8, refine=(1, 2))


def rolled(kit, batch: int, threads: int):
    """A roll-out forwards and back on so many threads."""
    first = state.from_motion(scenes.held_out(1))[:, 0].expand(batch, -1).contiguous()
    z = torch.randn(batch, FRAMES, kit.motion.latent, generator=torch.Generator().manual_seed(0))

    def run() -> None:
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        start = z.clone().requires_grad_()
        rollout(kit.motion, first, start).states.square().sum().backward()
        torch.set_num_threads(before)

    return run


def spin() -> None:
    """A process that never waits."""
    while True:
        pass


def fitted(kit, seen) -> float:
    """Processor time of one fit."""
    began = time.process_time()
    testops.fit(seen, kit, schedule=SCHEDULE)
    return time.process_time() - began


def main() -> None:
    """Print the ratios."""
    kit = pretrained.load_priors("compact")
    for batch in BATCHES:
        calls = {n: rolled(kit, batch, n) for n in (1, 2)}
        wall = profiling.interleaved(calls, n=ROUNDS)
        busy = profiling.interleaved(calls, n=ROUNDS, clock=time.process_time)
        gain = (wall[1].median() / wall[2].median()).item()
        cost = (busy[2].median() / busy[1].median()).item()
        print(f"roll-out of {batch:4d}: two threads {gain:.2f} times as fast, at {cost:.2f} times the processor time")

    torch.set_num_threads(os.cpu_count() or 1)  # as torch begins: the fit has to hold back by itself
    seen = joints.noisy(scenes.held_out(1), torch.Generator().manual_seed(0))
    fitted(kit, seen)
    alone, beside = [], []
    for _ in range(ROUNDS):
        alone.append(fitted(kit, seen))
        other = multiprocessing.get_context("spawn").Process(target=spin, daemon=True)
        other.start()
        time.sleep(1.0)  # it has begun
        beside.append(fitted(kit, seen))
        other.terminate()
        other.join()
    ratio = torch.tensor(beside).median() / torch.tensor(alone).median()
    print(f"a fit of one clip beside a busy core: {ratio:.2f} times its processor time alone")
    print(f"a batch gets more than one thread from {parallel.WIDE} rows on")


if __name__ == "__main__":
    main()
