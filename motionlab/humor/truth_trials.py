"""Is a lower energy nearer to the truth? A search that begins at the truth, and errors where joints were seen and not.

What such a search finds is no contender's result, since no fit knows the truth: where it ends higher than fits do, the
energy likes something else better, and no search of this energy would find its way back.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionlab.humor import transitions, variables
from motionlab.humor.solver_trials import CM, Task
from motionlab.motion import Motion


def at_truth(task: Task) -> dict[str, Tensor]:
    """The start of stage 3 that follows the true motion instead of stage 2's, all joints believed, with what is shared
    (betas, camera) as stage 2 has it."""
    shared = {n: task.unknown[n] for n in variables.SHARED if n in task.unknown}
    evidence, priors = task.problem.evidence, task.problem.priors
    with torch.no_grad():
        latent = priors.pose.encode(task.truth.rot[:, :, 1:]).mean
    start, _ = transitions.start(
        task.truth, latent, shared, torch.ones_like(evidence.trust), priors, (0,), task.truth.frames, "lean",
        task.problem.weights.pull, transitions.EAGER,
    )  # fmt: skip
    return {n: x.detach() for n, x in start.items()}


def errors_where(task: Task, motion: Motion, seen: Tensor) -> dict[str, Tensor]:
    """Distance of joints from the true ones in the world, mean (B,), cm: of those seen (B, T, 22), and of the others;
    not a number where a clip has none."""
    off = CM * (motion.positions - task.truth.positions).norm(dim=-1)
    parts = {"seen": seen, "hidden": ~seen}
    return {name: (off * where).sum((-1, -2)) / where.sum((-1, -2)) for name, where in parts.items()}
