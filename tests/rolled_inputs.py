"""Random small networks and states for tests of the roll-out, and the golden mixture."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.humor import state
from motionlab.humor.priors import Cvae, InitGmm, reorder

F64 = torch.float64


def network(width: int = 128, *, skip: bool = False) -> Cvae:
    """A random model with norms that do something; at 128 all of its norms are over groups of four or more."""
    made = Cvae(width, skip=skip).to(F64)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for value in made.parameters():
            spread = 0.1 if value.ndim == 1 else 1.5 * value.shape[1] ** -0.5
            value.copy_(spread * torch.randn(value.shape, generator=generator) + (value.ndim == 1) * 0.5)
        for net in (made.decoder.net, made.prior_net.net):
            net[-1].weight *= 0.3
            net[-1].bias.zero_()
        if skip:
            made.skip.weight *= 0.1
    return reorder(made).frozen()  # drawn as official weights


def golden_mixture() -> InitGmm:
    """The mixture of the reference values, by their recipe."""
    draw = np.random.RandomState(7)
    means = draw.standard_normal((3, 138)) * 0.3
    factor = draw.standard_normal((3, 138, 138)) * 0.05
    covariances = factor @ factor.transpose(0, 2, 1) + 0.1 * np.eye(138)
    weights = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)
    return InitGmm(weights, torch.from_numpy(means), torch.from_numpy(covariances))


def first_states(generator: torch.Generator, batch: int) -> Tensor:
    """World states (B, 339)."""

    def draw(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=generator, dtype=F64)

    trans = draw(3)
    parts = {"trans": trans, "trans_vel": draw(3), "root_orient_vel": draw(3), "joints_vel": draw(22, 3)}
    parts["root_orient"] = rotation.random((batch,), generator, dtype=F64)
    parts["pose_body"] = rotation.random((batch, 21), generator, dtype=F64)
    return state.pack(parts | {"joints": trans[:, None] + 0.5 * draw(22, 3)})
