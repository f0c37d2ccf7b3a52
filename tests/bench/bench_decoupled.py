"""What an evaluation of the decoupled energy costs with x and z moving, with x or z fixed, K = 1 and 5: notebook 07's
sizes, Adam's step included. Processor time, ways in turns in one run; before it is timed, what is fixed must stay."""

import time

import torch

from data_synth import scenes
from motionlab.humor import pretrained
from motionlab.humor.testops import Schedule
from studies.nb07_decoupled import trials
from studies.nb07_decoupled.energy import Form
from studies.nb07_decoupled.search import BOTH, Plan, X, Z, adam
from studies.shared.profiling import interleaved

STEPS, ROUNDS = 5, 7
WAYS = {"both": BOTH, "z fixed": X, "x fixed": Z}


def search(known: trials.Case, moving: tuple[str, ...], k: int):
    """``STEPS`` steps of Adam."""
    plan = Plan(Form(k, 10.0), moving=moving, rate_x=1e-4, rate_z=1e-4)
    return lambda: adam(known.problem, known.start, plan, STEPS)


def main() -> None:
    """Print a line for every way and size."""
    for clips, frames in ((8, 60), (12, 30), (12, 100)):
        film = scenes.film("sitting, legs hidden", clips, seed=3, frames=frames)
        known = trials.case(film, pretrained.load_priors("compact"), Schedule.quick(), frames=frames)
        runs = {f"K = {k}, {name}": search(known, moving, k) for k in (1, 5) for name, moving in WAYS.items()}
        for name, run in runs.items():
            found = run().unknown
            for unknown in ("x", "z"):
                assert torch.equal(found[unknown], known.start[unknown]) == (f"{unknown} fixed" in name), name
        seconds = interleaved(runs, n=ROUNDS, clock=time.process_time)
        for name, x in seconds.items():
            low, middle, high = (1e3 * x / STEPS).quantile(torch.tensor([0.25, 0.5, 0.75]).to(x)).tolist()
            joint = f"{name.split(',')[0]}, both"
            ratio = (x / seconds[joint]).median()
            print(
                f"{clips:2d} clips of {frames:3d} frames, {name:14s} {middle:4.0f} ms [{low:.0f}, {high:.0f}] an "
                f"evaluation, {ratio:.2f} of {joint}; {ROUNDS} rounds of {STEPS}",
                flush=True,
            )


if __name__ == "__main__":
    main()
