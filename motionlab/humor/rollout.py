"""Computes roll-outs of the prior from a first state and latents, plain or steered.

    raw = decoder(x, z);   x' = x + raw,  M' = M exp(v)^T;   then every vector into the heading frame of x'

Every step happens in the heading frame of its own newest state; the chain of steps is the only thing that must be done
one after the other: on the CPU in loops (``compiled``), elsewhere and for very many clips step by step as it is written
in the paper. The prior of every step does not feed the chain and is computed for all steps at once.

A steered roll-out takes u instead of z, z_t = u_t + K_t X_t, where X_t (345) is the state in its own heading frame and
that frame's place in the world, the first rows of a homogeneous matrix: cos, -sin, x | sin, cos, y. A plain roll-out
forgets nothing: what one z does stays done in all frames to come, and a search over z is stiff. With the gains K_t of
``coordinates`` every later z makes up for what an earlier one changed. Any z is reached by some u, so that
minima stay what they are, and what comes out is an exact roll-out.

Source: HuMoR (Rempe et al. 2021), ``roll_out`` of the official code; thesis 3.1.1, 3.3.1 (K-step parallel decode);
differential dynamic programming (Jacobson and Mayne 1970), forward pass.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab.errors import ShapeError, check_shape
from motionlab.heading import Frame
from motionlab.humor import compiled, state
from motionlab.humor.priors import Cvae, Gaussian
from motionlab.humor.state import STATE, globalise, heading, localise
from motionlab.parallel import threads_for


class Rollout(NamedTuple):
    """states (B, T, 339), t = 1..T; contact_logits (B, T, 9); z (B, T, 48); prior of each z, or None."""

    states: Tensor
    contact_logits: Tensor
    z: Tensor
    prior: Gaussian | None


def rollout(model: Cvae, first: Tensor, z: Tensor, *, with_prior: bool = True) -> Rollout:
    """Computes a plain roll-out: T states from a first state and T latents, one after the other.

    Args:
        first: (B, 339) states, world coordinates. z: (B, T, 48), T > 0.
        with_prior: evaluate p(z_t | x_{t-1}) of every step, in one batch.

    Returns:
        states in the coordinates of ``first``. First derivatives, of ``first`` and z.
    Raises:
        ShapeError: first and z do not fit each other.
    """
    with threads_for(len(first)):
        return steered_rollout(model, first, z, with_prior=with_prior)[0]


def steered_rollout(
    model: Cvae, first: Tensor, u: Tensor, gains: Tensor | None = None, *, with_prior: bool = True
) -> tuple[Rollout, Tensor]:
    """Computes a steered roll-out from a first state, u and gains, as above. First derivatives, of ``first`` and u.

    Args:
        first: (B, 339) states, world coordinates. u: (B, T, 48). gains: (B, T, 48, 345) or none.

    Returns:
        the roll-out, its z included, and X (B, T, 345), from which each z was steered.
    """
    check_shape(first, f"B {STATE}", "first")
    check_shape(u, f"B T {model.latent}", "z")
    if len(first) != len(u):
        raise ShapeError(f"first has {len(first)} rows, z {len(u)}")
    if not u.shape[1]:
        raise ShapeError("z has no steps: a roll-out needs T > 0")
    if compiled.fits(first, u):
        steering = u.new_zeros(*u.shape, 0) if gains is None else gains
        chain = compiled.Chain.apply(model, _placed(first, heading(first)), u.transpose(0, 1), steering.transpose(0, 1))
        x, after, logits, z = (each.transpose(0, 1) for each in chain)
        states = globalise(after, _frame(x))
    else:
        x, states, logits, z = _plain(model, first, u, gains)
    prior = model.prior(x[..., :STATE]) if with_prior else None
    return Rollout(states, logits, z, prior), x


def _plain(model: Cvae, first: Tensor, u: Tensor, gains: Tensor | None) -> tuple[Tensor, ...]:
    """X, world states, contact logits and z (B, T, ...), step by step."""
    world, found = first, []
    for t, z in enumerate(u.unbind(1)):
        frame = heading(world)
        x = _placed(world, frame)
        z = z if gains is None else z + (x[:, None] @ gains[:, t].mT)[:, 0]
        after, logits = state.apply(x[:, :STATE], model.decode(x[:, :STATE], z))
        world = globalise(after, frame)
        found.append((x, world, logits, z))
    return tuple(torch.stack(each, 1) for each in zip(*found, strict=True))


def _placed(world: Tensor, frame: Frame) -> Tensor:
    """X (B, 345) of world states (B, 339) in their own heading frames."""
    place = torch.cat((frame.turn.mT[:, :2, :2], -frame.shift[:, :2, None]), -1)
    return torch.cat((localise(world, frame), place.flatten(1)), 1)


def _frame(x: Tensor) -> Frame:
    """The heading frames whose places X (..., 345) holds."""
    place = x[..., STATE:].unflatten(-1, (2, 3))
    up = F.pad(torch.ones_like(x[..., :1]), (2, 0))
    turn = torch.cat((F.pad(place[..., :2].mT, (0, 1)), up[..., None, :]), -2)
    return Frame(turn, F.pad(-place[..., 2], (0, 1)))


def sample_rollout(model: Cvae, first: Tensor, steps: int, *, generator: torch.Generator | None = None) -> Rollout:
    """Computes a roll-out from states (B, 339), world coordinates, with z from the prior: drawn where a generator is
    given, else its mean. Keeps no gradients.
    """
    check_shape(first, f"B {STATE}", "first")
    with torch.no_grad(), threads_for(len(first)):
        world, found = first, []
        for _ in range(steps):
            frame = heading(world)
            past = localise(world, frame)
            prior = model.prior(past)
            z = prior.mean if generator is None else prior.sample(generator)
            after, logits = state.apply(past, model.decode(past, z))
            world = globalise(after, frame)
            found.append((world, logits, z, *prior))
        states, logits, zs, *priors = (torch.stack(each, 1) for each in zip(*found, strict=True))
        return Rollout(states, logits, zs, Gaussian(*priors))


def infer(model: Cvae, states: Tensor) -> tuple[Gaussian, Gaussian]:
    """Computes posterior and prior (B, T - 1, 48) of every transition of world states (B, T, 339), all at once."""
    past, now = state.transition_pairs(states)
    return model.posterior(past, now), model.prior(past)
