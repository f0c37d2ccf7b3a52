"""What becomes of one nudge of one latent: in a plain roll-out, and in one that steers itself."""

from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.humor import coordinates, unknowns
from motionlab.humor.rollout import steered_rollout
from motionlab.humor.unknowns import Unknowns
from motionlab.motion import Motion
from studies.nb08_fast.trials import CM, Task


class Nudged(NamedTuple):
    """Motions (T,) of the roll-out as it was, and nudged without and with feedback; apart: how far the nudged ones are
    from it, mean over joints, cm (T,), by way."""

    before: Motion
    after: dict[str, Motion]
    apart: dict[str, Tensor]


def nudged(task: Task, unknown: Unknowns, number: int, sigmas: float) -> Nudged:
    """Adds so many of the prior's standard deviations to all of z_number of one clip, in random directions, and rolls
    out with the other latents held (open loop) or answering (closed loop)."""
    white = coordinates.linearised(task.problem, unknown, stride=4)
    with torch.no_grad():
        first, z = unknowns.first_state(unknown, task.problem.priors), unknown.z
        plain, _ = steered_rollout(task.problem.priors.motion, first, z)
        push = torch.zeros_like(z)
        sign = torch.randn(z.shape[-1], generator=torch.Generator().manual_seed(number)).sign()
        push[0, number - 1] = sigmas * sign * (0.5 * plain.prior.log_var[0, number - 1]).exp()
        ways = {"open loop": (z + push, None), "closed loop": (white.base + push, white.gains.transpose(0, 1))}
        rolled = {way: steered_rollout(task.problem.priors.motion, first, *how)[0] for way, how in ways.items()}
        bodies = {
            way: unknowns.motion_of(unknowns.rolled_from(first, r, unknown, task.problem.evidence).body, 30.0).clip(0)
            for way, r in {"before": plain, **rolled}.items()
        }
    before = bodies.pop("before")
    apart = {way: CM * (m.positions - before.positions).norm(dim=-1).mean(-1) for way, m in bodies.items()}
    return Nudged(before, bodies, apart)
