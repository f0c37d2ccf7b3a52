"""Is a lower energy nearer to the truth? A search that begins at the truth, and errors where joints were seen and not.

What such a search finds is no contender's result, since no fit knows the truth. Where it ends higher than fits do, the
energy likes something else better; where it ends as low and elsewhere, the energy does not tell the two apart.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from motionlab.humor.start import EAGER
from motionlab.motion import Motion
from studies.nb08_fast.trials import CM, Task


def at_truth(task: Task) -> dict[str, Tensor]:
    """The start of stage 3 that follows the true motion instead of stage 2's, all joints believed, with what is shared
    (betas, camera) as stage 2 has it."""
    with torch.no_grad():
        latent = task.problem.priors.pose.encode(task.truth.rot[:, :, 1:]).mean
    told = replace(task, rough=task.truth, latent=latent)
    return told.begun(EAGER, torch.ones_like(task.problem.evidence.trust)).unknown


def errors_where(task: Task, motion: Motion, seen: Tensor) -> dict[str, Tensor]:
    """Distance of joints from the true ones in the world, mean (B,), cm: of those seen (B, T, 22), and of the others;
    not a number where a clip has none."""
    off = CM * (motion.positions - task.truth.positions).norm(dim=-1)
    parts = {"seen": seen, "hidden": ~seen}
    return {name: (off * where).sum((-1, -2)) / where.sum((-1, -2)) for name, where in parts.items()}
