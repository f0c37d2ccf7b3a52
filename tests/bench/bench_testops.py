"""How long a fit takes, stage by stage, and what rounder coordinates save: 60 frames, noisy joints, the shipped prior.

The ratio counts evaluations of the energy until the lean search's energy is reached, of at most as many as are given.
"""

import time
from functools import partial

import torch

from data_synth import scenes
from motionlab.humor import pretrained, stages, testops
from motionlab.humor.energies import JOINTS
from motionlab.humor.evidence import evidence
from studies.shared import joints

CLIPS, CEILING = 2, 600  # closures that the plain search may spend


def main() -> None:
    """Print closures and seconds per stage, and the ratios."""
    kit, truth = pretrained.load_priors("compact"), scenes.held_out(CLIPS)
    seen = joints.noisy(truth, torch.Generator().manual_seed(0))
    began = time.perf_counter()
    fitted = testops.fit(seen, kit)
    whole = time.perf_counter() - began
    for stage, reports in fitted.results.items():
        error = 100 * (fitted.stages[stage].positions - truth.positions).norm(dim=-1).mean()
        closures, seconds = sum(r.closures for r in reports), sum(r.seconds for r in reports)
        print(f"stage {stage}: {closures:4d} closures, {seconds:5.1f} s for {CLIPS} clips, {error:.2f} cm")
    print(f"whole fit {whole:.1f} s; {whole / CLIPS:.1f} s per clip of 2 s")

    problem = stages.Problem(evidence(seen), kit, JOINTS)
    unknown = testops.start_stage_1(problem)
    moving = ("trans", "orient", "latent", "betas")
    _, rounder = stages.stage_1_and_2(problem, unknown, 2, steps=10, inner=20, tolerance=1e-4)
    steps = CEILING * 4 // 5 // 20
    terms = partial(stages.pose_terms, stage=2)
    _, plain = stages._search(terms, problem, unknown, moving, steps=steps, inner=20)
    for clip in range(CLIPS):
        goal = rounder.energy[clip] * 1.01
        ours, theirs = ((each.history[:, clip] <= goal).nonzero() for each in (rounder, plain))
        reached = f"{int(theirs[0]) + 1}" if len(theirs) else f"more than {plain.closures}"
        print(f"stage 2, clip {clip}: {int(ours[0]) + 1} closures in rounder coordinates, {reached} in plain ones")


if __name__ == "__main__":
    main()
