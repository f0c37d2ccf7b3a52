"""Roll-outs of the prior: from a first state and latents to a motion. The lean form, with nothing computed twice.

Every step happens in the canonical frame of its own newest state; ``recursion`` walks that chain, the only thing that
must be done step by step. What z adds to each layer, the prior of every step and the way back into the world do not
feed the chain and are computed for all steps at once.

Source: HuMoR (Rempe et al. 2021), ``roll_out`` of the official code; thesis 3.1.1, 3.3.1 (K-step parallel decode).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.errors import ShapeError, check_shape
from motionlab.frames import Frame
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.recursion import BACK, LEAN, ROT, Decoder, Recursion, Stepper
from motionlab.humor.state import STATE, globalise, heading, localise


class Rollout(NamedTuple):
    """states (B, T, 339), t = 1..T; contact_logits (B, T, 9); z (B, T, 48); prior of each z, or None."""

    states: Tensor
    contact_logits: Tensor
    z: Tensor
    prior: Gaussian | None


def rollout(
    model: Cvae,
    first: Tensor,
    z: Tensor,
    *,
    offset: Tensor | None = None,
    with_prior: bool = True,
) -> Rollout:
    """Decode T transitions one after the other.

    Args:
        first: (B, 339) states, world coordinates. z: (B, T, 48), T > 0.
        offset: (B, 3) from ``state.pelvis_offset`` where ``trans`` is not the pelvis.
        with_prior: evaluate p(z_t | x_{t-1}) of every step, in one batch.

    Returns:
        states in the coordinates of ``first``. First derivatives only.
    Raises:
        ShapeError: first and z do not fit each other.
    """
    check(model, first, z)
    decoder = Decoder.of(model)
    start = heading(first)
    x = localise(first, start, offset)[:, LEAN.to(first.device)]
    weights = (*decoder.weights, *decoder.gains, *decoder.shifts)
    past, after, logits = Recursion.apply(decoder, x, _spread(offset), *decoder.shares(z.transpose(0, 1)), *weights)
    back = BACK.to(first.device)
    prior = None
    if with_prior:
        prior = Gaussian(*(part.transpose(0, 1) for part in model.prior(past[..., back])))
    states = to_world(start, after[..., back].transpose(0, 1), offset)
    return Rollout(states, logits.transpose(0, 1), z, prior)


def check(model: Cvae, first: Tensor, z: Tensor) -> None:
    """Raises ShapeError where first states (B, 339) and latents (B, T, 48) do not fit each other."""
    check_shape(first, f"B {STATE}", "first")
    check_shape(z, f"B T {model.latent}", "z")
    if len(first) != len(z):
        raise ShapeError(f"first has {len(first)} rows, z {len(z)}")
    if not z.shape[1]:
        raise ShapeError("z has no steps: a roll-out needs T > 0")


def _spread(offset: Tensor | None) -> Tensor | None:
    """The offset (B, 3) at the joints among the 50 vectors of ``recursion``."""
    return None if offset is None else F.pad(offset[:, None].expand(-1, 22, -1), (0, 0, 3, 25))


def to_world(start: Frame, local: Tensor, offset: Tensor | None) -> Tensor:
    """States (B, T, 339), each in the frame of the state before it, in the coordinates that ``start`` (B) is given in.

    x_{k+1} = A_k (x_k + s_k), so that x_k = turn_k (x + shift_k) with turn_{k+1} = A_k turn_k and
    shift_{k+1} = shift_k + turn_k^T s_k, from turn_0 and shift_0 of ``start``. All A turn about z: angles add up.
    """
    steps = heading(local[:, :-1])
    angle = torch.atan2(steps.turn[..., 1, 0], steps.turn[..., 0, 0]).cumsum(1)
    turn = rotation.rotation_about("z", F.pad(angle, (1, 0))) @ start.turn[:, None]
    way = (turn[:, :-1].mT @ steps.shift[..., None])[..., 0].cumsum(1)
    shift = start.shift[:, None] + F.pad(way, (0, 0, 1, 0))
    return globalise(local, Frame(turn, shift), None if offset is None else offset[:, None])


def sample(
    model: Cvae, first: Tensor, steps: int, *, generator: torch.Generator | None = None, offset: Tensor | None = None
) -> Rollout:
    """Roll out with z from the prior: drawn where a generator is given, else its mean. Gradients are not kept.

    first: (B, 339) states, world coordinates.
    """
    check_shape(first, f"B {STATE}", "first")
    with torch.no_grad():
        decoder, back = Decoder.of(model), BACK.to(first.device)
        step, start = Stepper(decoder, _spread(offset)), heading(first)
        x = localise(first, start, offset)[:, LEAN.to(first.device)]
        after, logits, zs, means, variances = [], [], [], [], []
        for _ in range(steps):
            prior = model.prior(x[:, back])
            z = prior.mean if generator is None else prior.sample(generator)
            now = step(x, decoder.shares(z))
            x = now.moved
            after.append(now.after), logits.append(now.raw[:, ROT:]), zs.append(z)
            means.append(prior.mean), variances.append(prior.log_var)
        after, logits, zs, means, variances = (torch.stack(each, 1) for each in (after, logits, zs, means, variances))
        return Rollout(to_world(start, after[..., back], offset), logits, zs, Gaussian(means, variances))


def infer(model: Cvae, states: Tensor, *, offset: Tensor | None = None) -> tuple[Gaussian, Gaussian]:
    """Posterior and prior (B, T-1, 48) of every transition of world states (B, T, 339), all at once.

    Source: Stage-3 initialisation of the official code; offset (B, 3) is taken once, from the first frame.
    """
    frame = heading(states[:, :-1])
    c = None if offset is None else offset[:, None]
    past, now = localise(states[:, :-1], frame, c), localise(states[:, 1:], frame, c)
    return model.posterior(past, now), model.prior(past)


def decode_ahead(model: Cvae, states: Tensor, z: Tensor, steps: int = 1) -> Tensor:
    """K transitions from every state at once: (B, T, K, 339), entry [b, t, k] predicts the state t + k + 1.

    states (B, T, 339), world; z (B, T, 48) of the transition out of each state. Starts from which fewer than K
    latents are left get predictions with the last latent repeated: cut them off by t + k + 1 < T.
    Source: thesis 3.3.1, the decoupled roll-out with K decoding steps.
    """
    batch, frames = states.shape[:2]
    at = (torch.arange(frames)[:, None] + torch.arange(steps)).clamp(max=frames - 1).to(states.device)
    found = rollout(model, states.flatten(0, 1), z[:, at].flatten(0, 1), with_prior=False).states
    return found.unflatten(0, (batch, frames))
