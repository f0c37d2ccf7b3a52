"""Random small networks and states for tests of the roll-out, a naive twin of a transition, and the golden mixture."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.heading import Frame
from motionlab.humor import state
from motionlab.humor.gauss_newton import XI
from motionlab.humor.priors import Cvae, InitGmm, reorder
from motionlab.humor.state import ADDED

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


def own(states: Tensor) -> Tensor:
    """World states (..., 339) in their own heading frames."""
    return state.localise(states, state.heading(states))


def turned(x: Tensor, xi: Tensor) -> Tensor:
    """States (..., 339) after a change (..., 207), rotations on their manifold."""
    matrices = x[..., ADDED:].unflatten(-1, (22, 3, 3)).mT
    after = rotation.exp(xi[..., ADDED:XI].unflatten(-1, (22, 3))) @ matrices
    return torch.cat((x[..., :ADDED] + xi[..., :ADDED], after.mT.flatten(-3)), -1)


def placed(frame: Frame, gamma: Tensor) -> Frame:
    """The heading frame that stands turned by gamma[0], and moved by the rest in its own axes."""
    way = torch.cat((gamma[..., 1:], torch.zeros_like(gamma[..., :1])), -1)
    turn = rotation.rotation_about("z", -gamma[..., 0]) @ frame.turn
    return Frame(turn, frame.shift - (frame.turn.mT @ way[..., None])[..., 0])


def still(like: Tensor) -> Frame:
    """The world's own frame, for each of some states."""
    return Frame(torch.eye(3).to(like).expand(*like.shape[:-1], 3, 3), torch.zeros_like(like[..., :3]))


def advanced(model: Cvae, x: Tensor, z: Tensor, change: Tensor) -> tuple[Tensor, Frame]:
    """One transition as the paper has it, from states (N, 339) in own frames after changes (N, 210): what comes out in
    its own frame, and that frame in the axes of the unchanged frame before."""
    past, frame = turned(x, change[:, :XI]), placed(still(x), change[:, XI:])
    after, _ = state.apply(past, model.decode(past, z))
    world = state.globalise(after, frame)
    found = state.heading(world)
    return state.localise(world, found), found


def between(x: Tensor, frame: Frame, y: Tensor, other: Frame) -> Tensor:
    """The change (N, 210) that takes a state in its frame to another near by; of first order in how far it is."""
    spin = y[:, ADDED:].unflatten(1, (22, 3, 3)).mT @ x[:, ADDED:].unflatten(1, (22, 3, 3))
    spin = (spin - spin.mT) / 2
    omega = torch.stack((spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]), -1)
    angle = (other.turn.mT @ frame.turn)[:, 1, 0]
    way = (frame.turn @ (frame.shift - other.shift)[..., None])[:, :2, 0]
    return torch.cat((y[:, :ADDED] - x[:, :ADDED], omega.flatten(1), angle[:, None], way), 1)
