"""Computes roll-outs of the prior from a first state and latents, plain or steered.

Every step happens in the heading frame of its own newest state; the chain of steps (``transition``, or ``compiled`` for
few clips) is the only thing that must be done one after the other. The prior of every step and the way back into the
world do not feed the chain and are computed for all steps at once.

A steered roll-out takes u instead of z, z_t = u_t + K_t X_t, where X_t (345) is the state in its own heading frame and
that frame's place in the world, the first rows of a homogeneous matrix: cos, -sin, x | sin, cos, y. A plain roll-out
forgets nothing: what one z does stays done in all frames to come, and a search over z is stiff. With the gains K_t of
``shooting.coordinates`` every later z makes up for what an earlier one changed. Any z is reached by some u, so that
minima stay what they are, and what comes out is an exact roll-out.

Source: HuMoR (Rempe et al. 2021), ``roll_out`` of the official code; thesis 3.1.1, 3.3.1 (K-step parallel decode);
differential dynamic programming (Jacobson and Mayne 1970), forward pass.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from motionlab import rotation
from motionlab.errors import ShapeError, check_shape
from motionlab.heading import Frame
from motionlab.humor import compiled, state
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.state import CHANGES, STATE, bone_lengths, globalise, heading, localise, with_bone_lengths
from motionlab.humor.transition import DecoderLayers, Step, Stepper, WayBack
from motionlab.parallel import threads_for

_SPIN = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # d/da of a turn, from the right


class Rollout(NamedTuple):
    """states (B, T, 339), t = 1..T; contact_logits (B, T, 9); z (B, T, 48); prior of each z, or None."""

    states: Tensor
    contact_logits: Tensor
    z: Tensor
    prior: Gaussian | None


def rollout(model: Cvae, first: Tensor, z: Tensor, *, with_prior: bool = True, loops: bool | None = None) -> Rollout:
    """Computes a plain roll-out: T states from a first state and T latents, one after the other.

    Args:
        first: (B, 339) states, world coordinates. z: (B, T, 48), T > 0.
        with_prior: evaluate p(z_t | x_{t-1}) of every step, in one batch.
        loops: walk the chain in compiled loops, or in tensors; None: in loops where that is quicker.

    Returns:
        states in the coordinates of ``first``. First derivatives only, and none of the decoder's weights.
    Raises:
        ShapeError: first and z do not fit each other.
    """
    _check(model, first, z)
    with threads_for(len(first)):
        start = heading(first)
        past, after, logits, _ = _chain(model, localise(first, start), z.transpose(0, 1), None, loops)
        prior = Gaussian(*(part.transpose(0, 1) for part in model.prior(past))) if with_prior else None
        return Rollout(_to_world(start, after.transpose(0, 1)), logits.transpose(0, 1), z, prior)


def steered_rollout(model: Cvae, first: Tensor, u: Tensor, gains: Tensor | None = None) -> tuple[Rollout, Tensor]:
    """Computes a steered roll-out from a first state, u and gains, as above. No derivatives of the decoder's weights.

    Args:
        first: (B, 339) states, world coordinates. u: (B, T, 48). gains: (B, T, 48, 345) or none.

    Returns:
        the roll-out, its z included, and X (B, T, 345), from which each z was steered.
    """
    _check(model, first, u)
    start = heading(first)
    place = torch.cat((start.turn.mT[:, :2, :2], -start.shift[:, :2, None]), -1).flatten(1)
    x = torch.cat((localise(first, start), place), 1)
    steering = None if gains is None else gains.transpose(0, 1)
    past, after, logits, z = _chain(model, x, u.transpose(0, 1), steering)
    prior = Gaussian(*(part.transpose(0, 1) for part in model.prior(past[..., :STATE])))
    states = _to_world(start, after.transpose(0, 1))
    return Rollout(states, logits.transpose(0, 1), z.transpose(0, 1), prior), past.transpose(0, 1)


def _check(model: Cvae, first: Tensor, z: Tensor) -> None:
    check_shape(first, f"B {STATE}", "first")
    check_shape(z, f"B T {model.latent}", "z")
    if len(first) != len(z):
        raise ShapeError(f"first has {len(first)} rows, z {len(z)}")
    if not z.shape[1]:
        raise ShapeError("z has no steps: a roll-out needs T > 0")


def _chain(model: Cvae, x: Tensor, u: Tensor, gains: Tensor | None, loops: bool | None = None):
    """All steps from X_0 (B, 339 or 345), u (T, B, 48) and gains (T, B, 48, 345): past (T, B, 339 or 345), states in
    the frame before (T, B, 339), contact logits (T, B, 9) and z (T, B, 48)."""
    layers = DecoderLayers.of(model)
    if compiled.fits(x, u) if loops is None else loops:
        none = u.new_zeros(*u.shape, 0)
        past, *rest = compiled.LoopedChain.apply(
            layers, F.pad(x, (0, compiled.PLACED - x.shape[1])), u, none if gains is None else gains
        )
        return past[..., : x.shape[1]], *rest
    return Chain.apply(layers, x, u, gains)


class Chain(torch.autograd.Function):
    """All steps in tensors, as ``_chain`` says, with first derivatives of X_0 and u written out."""

    @staticmethod
    def forward(ctx, decoder: DecoderLayers, first: Tensor, u: Tensor, gains: Tensor | None):
        """Walks the chain. Where ``first`` has a place in the world, that is carried along."""
        step, x = Stepper(decoder), first
        joint, bias = torch.cat(decoder.z_weights), torch.cat(decoder.biases)
        sizes, transposed = [len(b) for b in decoder.biases], joint.mT.contiguous()
        shares = None if gains is not None else F.linear(u, joint, bias).unbind(0)
        place = first[:, STATE:].unflatten(1, (2, 3)) if first.shape[1] > STATE else None
        past, steps, zs, places, ways = [], [], [], [], []
        for t, now in enumerate(u.unbind(0)):
            past.append(x)
            if gains is None:
                z, share = now, shares[t]
            else:
                z = torch.baddbmm(now[..., None], gains[t], x[..., None])[..., 0]
                share = torch.addmm(bias, z, transposed)
            done = step(x[:, :STATE], share.split(sizes, 1))
            x = done.moved
            if place is not None:
                places.append(place), ways.append(_onward(done))
                place = place @ ways[-1]
                x = torch.cat((x, place.flatten(1)), 1)
            steps.append(done), zs.append(z)
        ctx.step, ctx.steps, ctx.gains, ctx.joint, ctx.places, ctx.ways = step, steps, gains, joint, places, ways
        ctx.past = torch.stack(past)
        ctx.after, ctx.raw = torch.stack([s.after for s in steps]), torch.stack([s.raw for s in steps])
        return ctx.past.clone(), ctx.after.clone(), ctx.raw[..., CHANGES:].clone(), torch.stack(zs)

    @staticmethod
    @once_differentiable
    def backward(ctx, d_past: Tensor, d_after: Tensor, d_logits: Tensor, d_z: Tensor):
        """Computes the gradients of X_0 and u."""
        count, placed = len(ctx.past), bool(ctx.places)
        d_past, d_after, d_logits = (d.unbind(0) for d in (d_past, d_after, d_logits))
        way = WayBack(ctx.step, ctx.steps, ctx.past[..., :STATE], ctx.after, ctx.raw)
        spins = (torch.stack([s.turn for s in ctx.steps]) @ _SPIN.to(ctx.past)).unbind(0) if placed else ()
        d_x, d_shares = torch.zeros_like(d_past[0]), [None] * count
        for t in reversed(range(count)):
            d = d_after[t]
            d_place = d_x[:, STATE:].unflatten(1, (2, 3)) if placed else None
            if t < count - 1:  # the last state's own frame is nobody's input
                d_angle, back = way.of_frame(t, d_x)
                if placed:
                    d_way = ctx.places[t].mT @ d_place
                    d_angle = d_angle + (d_way * spins[t]).sum((1, 2))[:, None]
                d = way.of_after(t, d, d_x, d_angle, back)
                if placed:
                    d[:, :2] += d_way[:, :2, 2]
                    d_place = d_place @ ctx.ways[t].mT
            shares, d_x = way.of_step(t, d, d_logits[t])
            d_shares[t] = torch.cat(shares, 1)
            if placed:
                d_x = torch.cat((d_x, d_place.flatten(1)), 1)
            d_x = d_x + d_past[t]
            if ctx.gains is not None:
                d_shares[t] = torch.addmm(d_z[t], d_shares[t], ctx.joint)  # of u
                d_x = torch.baddbmm(d_x[:, None], d_shares[t][:, None], ctx.gains[t])[:, 0]
        d_u = torch.stack(d_shares)
        return None, d_x, d_z + d_u @ ctx.joint if ctx.gains is None else d_u, None


def _onward(step: Step) -> Tensor:
    """From places in the next heading frame to places in this one: (B, 3, 3), homogeneous, on the floor."""
    onward = step.turn.clone()
    onward[:, :2, 2] = step.after[:, :2]
    return onward


def _to_world(start: Frame, local: Tensor) -> Tensor:
    """States (B, T, 339), each in the frame of the state before it, in the coordinates that ``start`` (B) is given in.

    x_{k+1} = A_k (x_k + s_k), so that x_k = turn_k (x + shift_k) with turn_{k+1} = A_k turn_k and
    shift_{k+1} = shift_k + turn_k^T s_k, from turn_0 and shift_0 of ``start``. All A turn about z: angles add up.
    """
    steps = heading(local[:, :-1])
    angle = torch.atan2(steps.turn[..., 1, 0], steps.turn[..., 0, 0]).cumsum(1)
    turn = rotation.rotation_about("z", F.pad(angle, (1, 0))) @ start.turn[:, None]
    way = (turn[:, :-1].mT @ steps.shift[..., None])[..., 0].cumsum(1)
    shift = start.shift[:, None] + F.pad(way, (0, 0, 1, 0))
    return globalise(local, Frame(turn, shift))


def sample_rollout(
    model: Cvae, first: Tensor, steps: int, *, generator: torch.Generator | None = None, rigid: bool = False
) -> Rollout:
    """Computes a roll-out with z from the prior: drawn where a generator is given, else its mean. Keeps no gradients.

    first: (B, 339) states, world coordinates. rigid: after every step the bones get the lengths back that they have in
    the first state (not in HuMoR, whose joints drift from their bones).
    """
    check_shape(first, f"B {STATE}", "first")
    with torch.no_grad(), threads_for(len(first)):
        decoder = DecoderLayers.of(model)
        step, start = Stepper(decoder), heading(first)
        x, lengths = localise(first, start), bone_lengths(first)
        after, logits, zs, means, variances = [], [], [], [], []
        for _ in range(steps):
            prior = model.prior(x)
            z = prior.mean if generator is None else prior.sample(generator)
            now = step(x, decoder.shares(z))
            x, there = (with_bone_lengths(each, lengths) if rigid else each for each in (now.moved, now.after))
            after.append(there), logits.append(now.raw[:, CHANGES:]), zs.append(z)
            means.append(prior.mean), variances.append(prior.log_var)
        after, logits, zs, means, variances = (torch.stack(each, 1) for each in (after, logits, zs, means, variances))
        return Rollout(_to_world(start, after), logits, zs, Gaussian(means, variances))


def infer(model: Cvae, states: Tensor) -> tuple[Gaussian, Gaussian]:
    """Computes posterior and prior (B, T-1, 48) of every transition of world states (B, T, 339), all at once.

    Source: Stage-3 initialisation of the official code.
    """
    past, now = state.transition_pairs(states)
    return model.posterior(past, now), model.prior(past)


def decode_ahead(model: Cvae, states: Tensor, z: Tensor) -> Tensor:
    """Computes one transition from every state at once: (B, T, 339), entry [b, t] predicts the state t + 1.

    states (B, T, 339), world; z (B, T, 48) of the transition out of each state.
    Source: thesis 3.3.1, the decoupled roll-out with one decoding step.
    """
    found = rollout(model, states.flatten(0, 1), z.flatten(0, 1)[:, None], with_prior=False).states
    return found.unflatten(0, states.shape[:2])[:, :, 0]
