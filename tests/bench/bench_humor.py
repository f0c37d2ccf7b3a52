"""HuMoR's stage-3 closure and roll-out: the lean form against the faithful one, networks of the official size.

60 frames, one clip, one thread, processor time. Medians of ratios taken round by round; both forms must have the same
energy before they are timed.
"""

import sys
import time

import torch

from data_synth import clips
from studies.shared import profiling, savings
from studies.shared.savings import FAITHFUL, LEAN, Savings
from studies.shared.workload import Part, random_priors, workload

CLOSURE, ROLLOUT = 8.0, 2.5  # required ratios


def main() -> int:
    """Check, time, print; 1 where a ratio is too small."""
    generator = torch.Generator().manual_seed(0)
    walk = clips.draw(1, generator, actions=("walk",))[0].motion.cut(0, 60)
    work, whole = workload(walk, random_priors(generator), generator), Part(3, 60)
    with torch.no_grad():
        energy = [sum(savings.terms(work.problem, work.unknowns(whole, on), on).values()) for on in (FAITHFUL, LEAN)]
    torch.testing.assert_close(*energy, rtol=1e-4, atol=0)
    alone = {"roll-out, faithful": FAITHFUL, "roll-out, faithful, frozen": Savings(frozen=True), "roll-out, lean": LEAN}
    ways = {"closure, faithful": work.closure(whole, FAITHFUL), "closure, lean": work.closure(whole, LEAN)}
    ways |= {name: savings.chain_alone(work.problem, work.unknowns(whole, on), on) for name, on in alone.items()}
    found = profiling.interleaved(ways, n=9, clock=time.process_time)
    for name, seconds in found.items():
        print(f"{name:28s} {1e3 * seconds.median():7.0f} ms")
    short = False
    for slow, lean, least in (
        ("closure, faithful", "closure, lean", CLOSURE),
        ("roll-out, faithful", "roll-out, lean", ROLLOUT),
        ("roll-out, faithful, frozen", "roll-out, lean", ROLLOUT),
    ):
        low, middle, high = (found[slow] / found[lean]).quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist()
        short = short or middle < least
        print(f"{slow} / lean: {middle:.1f} [{low:.1f}, {high:.1f}], required {least:g}")
    return int(short)


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
