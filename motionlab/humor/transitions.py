"""From the motion of stage 2 to the unknowns of stage 3: a first state, and the latent of every transition.

Source: stage-3 initialisation of the official code: velocities by finite differences, then the posterior's mean.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionlab.humor import state, windows
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import infer
from motionlab.humor.variables import from_matrix
from motionlab.motion import Motion


def start(
    motion: Motion,
    latent: Tensor,
    shared: dict[str, Tensor],
    seen: Tensor,
    priors: Priors,
    starts: tuple[int, ...],
    length: int,
    mode: str = "lean",
) -> dict[str, Tensor]:
    """The unknowns of stage 3 in windows.

    Args:
        motion (G, T): of stage 2. latent (G, T, 32): its pose latents. shared: its betas, camera.
        seen (G, T): frames of which anything was observed; transitions from or to others get the prior's mean in
            lean mode.
        starts, length: of the windows.
    """
    states = state.from_motion(motion)
    with torch.no_grad():
        posterior, prior = infer(priors.motion, states)
    known = (seen[:, 1:] & seen[:, :-1])[..., None] if mode == "lean" else torch.tensor(True)
    z = torch.where(known, posterior.mean, prior.mean)
    first = state.unpack(states[:, list(starts)])
    return {
        "trans": first["trans"],
        "orient": from_matrix(first["root_orient"], mode),
        "latent": latent[:, list(starts)],
        "trans_vel": first["trans_vel"],
        "root_orient_vel": first["root_orient_vel"],
        "joints_vel": first["joints_vel"].flatten(-2),
        "z": windows.cut(z, starts, length - 1),
        **shared,
    }
