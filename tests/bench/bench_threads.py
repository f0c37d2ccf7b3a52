"""When a second thread pays, and what a fit costs where every core is busy: ratios of one run.

The threshold ``parallel.WIDE`` rests on the first table, taken on an idle machine: a roll-out of 20 frames and
its gradient, on one and on two threads in turns. The second fails where a fit costs more than ``MOST`` times as much.
"""

import subprocess
import sys
import time
from unittest import mock

import torch

from data_synth import scenes
from motionlab import parallel
from motionlab.humor import pretrained, state, testops
from motionlab.humor.rollout import rollout
from studies.shared import joints, profiling

BATCHES, FRAMES, ROUNDS = (1, 16, 64, 256, 1024), 20, 3
SCHEDULE = testops.Schedule(steps=(2, 4, 6), inner=8, refine=(1, 2), shooting=testops.Schedule.quick().shooting)
MOST = 1.5  # times the processor time of a fit alone


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


def fitted(kit, seen, solver: str) -> float:
    """Processor time of one fit."""
    began = time.process_time()
    testops.fit(seen, kit, schedule=SCHEDULE, solver=solver)
    return time.process_time() - began


def beside_others(kit, seen, solver: str) -> float:
    """The same beside a process on every core that never waits."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(parallel.cores())]
    try:
        time.sleep(1.0)  # they have begun
        return fitted(kit, seen, solver)
    finally:
        for other in others:
            other.kill()
            other.wait()


def main() -> int:
    """Print the ratios; 1 where a fit is too dear beside others."""
    kit = pretrained.load_priors()
    for batch in BATCHES:
        calls = {n: rolled(kit, batch, n) for n in (1, 2)}
        with mock.patch.object(parallel, "WIDE", 0):  # as many threads as are asked for
            wall = profiling.interleaved(calls, n=ROUNDS)
            busy = profiling.interleaved(calls, n=ROUNDS, clock=time.process_time)
        gain = (wall[1].median() / wall[2].median()).item()
        cost = (busy[2].median() / busy[1].median()).item()
        print(f"roll-out of {batch:4d}: two threads {gain:.2f} times as fast, at {cost:.2f} times the processor time")
    print(f"a batch gets more than one thread from {parallel.WIDE} rows on")

    torch.set_num_threads(parallel.cores())  # as torch begins: the fit has to hold back by itself
    seen, worst = joints.noisy(scenes.held_out(1), torch.Generator().manual_seed(0)), 0.0
    for solver in testops.SOLVERS:
        fitted(kit, seen, solver)
        both = [(fitted(kit, seen, solver), beside_others(kit, seen, solver)) for _ in range(ROUNDS)]
        alone, beside = torch.tensor(both).median(0).values.tolist()
        print(f"{solver}: a fit of one clip beside {parallel.cores()} busy cores takes {beside / alone:.2f} times its "
              f"processor time alone ({alone:.1f} s), at most {MOST}")  # fmt: skip
        worst = max(worst, beside / alone)
    return int(worst > MOST)


if __name__ == "__main__":
    sys.exit(main())
