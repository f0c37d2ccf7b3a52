"""Whole fits of two seconds, keypoints to motion: processor seconds of one thread, and where they end.

Synthetic people, by turns in plain view and behind a low wall, known cameras: one by one as ``fit`` and ``fit --quick``
do it, 16 at once, and as a yardstick the official schedule run to its end in the official form: its stage 3 alone, from
our stages 1 and 2, some minutes a clip. Ratios and energies are those of the same clips.

    PYTHONPATH=notebooks python tests/bench/bench_fit.py [--singles 4] [--official 1]
"""

import argparse
import os
import time
from dataclasses import replace

import torch
from torch import Tensor

from motionlab.footage.scene_fit import FULL_WORK, QUICK_WORK
from motionlab.humor import pretrained, stages, testops, unknowns
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule
from studies.nb08_fast import official_schedule, race
from studies.nb08_fast.trials import clock
from studies.shared.clips import stacked
from studies.shared.savings import OFFICIAL

BATCH, FRAMES, SEED = 16, 60, 343
Ends = tuple[Tensor, Tensor, Tensor]  # of clips (B,): seconds, nats a frame, cm


def fitted(some: list[race.Clip], priors: Priors, work: Schedule) -> Ends:
    """Fits clips together, as the product does."""
    began, cameras = clock(), [clip.seen.camera for clip in some]
    seen = stacked([clip.seen for clip in some])
    found = testops.fit(seen, priors, cameras=cameras, floor="camera", schedule=work, solver="shooting")
    spent = torch.full((len(some),), (clock() - began) / len(some))
    off = [clip.task.error(found.motion.clip([k])) for k, clip in enumerate(some)]
    return spent, sum(found.energies[3].values()) / some[0].task.nat, torch.cat(off)


def one_by_one(some: list[race.Clip], priors: Priors, work: Schedule) -> Ends:
    """Fits each clip alone."""
    return tuple(torch.cat(x) for x in zip(*(fitted([clip], priors, work) for clip in some), strict=True))


def official(some: list[race.Clip]) -> Ends:
    """Runs the official schedule to its end, each clip alone."""
    ends = []
    for clip in some:
        task, began = clip.task, clock()
        unknown, _ = official_schedule.in_full(task, official_schedule.FULL)
        spent, problem = clock() - began, replace(task.problem, **OFFICIAL)
        with torch.no_grad():
            energy = sum(stages.motion_terms(problem, unknown).values())
            body = problem.roll(unknown, problem.priors, problem.evidence).body
        error = task.error(unknowns.motion_of(body, task.truth.fps))
        ends.append((torch.tensor([spent]), energy / task.nat, error))
    return tuple(torch.cat(x) for x in zip(*ends, strict=True))


def rate(kind: torch.dtype, size: int = 1024, count: int = 10) -> float:
    """Matrix products of a kind of number, GFlop/s of processor time."""
    x = torch.randn(size, size).to(kind)
    x @ x
    began = time.process_time()
    for _ in range(count):
        x @ x
    return 2e-9 * count * size**3 / (time.process_time() - began)


def row(name: str, found: Ends, base: Ends) -> None:
    """Prints a way's numbers beside the default's on the same clips."""
    count = min(len(found[0]), len(base[0]))
    seconds, nats, off = (x[:count] for x in found)
    above, more = nats - base[1][:count], off - base[2][:count]
    print(
        f"{name:22} {count:2} clips  {seconds.median():7.2f} s a clip, {(seconds / base[0][:count]).median():6.2f} of "
        f"the default's; {above.median():+6.2f} nats a frame [{above.min():+.2f}, {above.max():+.2f}], "
        f"{more.mean():+5.1f} cm",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--singles", type=int, default=4, help=f"clips fitted one by one, of {BATCH}")
    parser.add_argument("--official", type=int, default=1, help="clips of the yardstick; 0: none")
    options = parser.parse_args()
    kinds = ", ".join(f"{rate(kind):.0f} GFlop/s in {str(kind)[6:]}" for kind in (torch.float32, torch.bfloat16))
    print(f"{race.processor()}, one thread: {kinds}; load {os.getloadavg()[0]:.1f}")
    priors = pretrained.load_priors()
    some = race.clips(priors, None, "val", {race.SYNTHETIC: BATCH}, SEED, FRAMES, FULL_WORK)
    singles, works = some[: options.singles], {"default": FULL_WORK, "--quick": QUICK_WORK}
    for clip in singles[:1]:
        fitted([clip], priors, QUICK_WORK)  # compiles the loops
    base = one_by_one(singles, priors, FULL_WORK)
    row("default", base, base)
    row("--quick", one_by_one(singles, priors, QUICK_WORK), base)
    for name, work in works.items():
        row(f"{BATCH} at once, {name}", fitted(some, priors, work), base)
    if options.official:
        row("official, its stage 3", official(singles[: options.official]), base)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
