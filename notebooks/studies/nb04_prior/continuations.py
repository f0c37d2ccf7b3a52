"""Chains of single steps, and what becomes of a body when one number of the latent is turned."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from motionlab.motion import Motion
from motionlab.skeleton import STANDARD


@torch.no_grad()
def chain(step: Callable[[Tensor], Tensor], first: Tensor, steps: int) -> Tensor:
    """Computes states (B, steps + 1, 339): a first state (B, 339), and one step after the other."""
    states = [first]
    for _ in range(steps):
        states.append(step(states[-1]))
    return torch.stack(states, 1)


def reading(turned: Mapping[str, Motion], nats: Tensor, active: float) -> str:
    """Computes the sentences on how many dimensions are in use, and what turning some of them moves."""
    said = []
    for name, motion in turned.items():
        pelvis, joint, way = _effect(motion)
        said.append(f"*{name}* moves the pelvis by {pelvis:.0f} cm and, seen from it, the {joint} by {way:.0f} cm.")
    return (
        f"**Reading.** {int((nats > active).sum())} of {len(nats)} dimensions are in use; a transition carries "
        f"{nats.sum():.0f} nats beyond the prior's guess. Each was turned from two deviations below to two above; the "
        f"joint that moves most is named. {' '.join(said)} Each moves the whole body: no dimension has one plain "
        "meaning."
    )


def _effect(motion: Motion) -> tuple[float, str, float]:
    """What separates the last poses of the first and the last of clips (N, T): cm of the pelvis, and the joint
    that moves most beside the pelvis, with its cm."""
    low, high = motion.positions[0, -1], motion.positions[-1, -1]
    beside = ((high - high[:1]) - (low - low[:1])).norm(dim=-1)
    most = int(beside.argmax())
    return 100 * float((high[0] - low[0]).norm()), STANDARD.names[most].replace("_", " "), 100 * float(beside[most])
