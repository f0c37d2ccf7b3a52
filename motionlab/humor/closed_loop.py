"""A roll-out that steers itself: z_t = u_t + K_t X_t, X_t the state so far.

A roll-out forgets nothing: what one z does stays done in all frames to come, and a search over z itself is stiff. With
the gains K_t of ``riccati`` every later z makes up for what an earlier one changed, and the search is over u. Any z is
reached by some u, so that minima stay what they are, and what comes out is an exact roll-out.

X_t (345) is the state in its own heading frame, in the order of ``recursion``, and that frame's place in the world, the
first rows of a homogeneous matrix: cos, -sin, x | sin, cos, y.
Source: differential dynamic programming (Jacobson and Mayne 1970), forward pass.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from motionlab.humor import compiled
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.recursion import BACK, LEAN, ROT, Decoder, Step, Stepper, WayBack
from motionlab.humor.rollout import Rollout, check, to_world
from motionlab.humor.state import STATE, heading, localise

INPUT = STATE + 6
_SPIN = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # d/da of a turn, from the right


def steered_rollout(model: Cvae, first: Tensor, u: Tensor, gains: Tensor | None = None) -> tuple[Rollout, Tensor]:
    """Decode T transitions from first states (B, 339), world, with u (B, T, 48) and gains (B, T, 48, 345) or none.
    No derivatives of the decoder's weights.

    Returns:
        the roll-out, its z included, and X (B, T, 345), from which each z was steered.
    """
    check(model, first, u)
    decoder, start = Decoder.of(model), heading(first)
    x = localise(first, start)[:, LEAN.to(first.device)]
    place = torch.cat((start.turn.mT[:, :2, :2], -start.shift[:, :2, None]), -1).flatten(1)
    chain = compiled.Chain if compiled.fits(first, u) else Steered
    if gains is None:
        gains = u.new_zeros(*u.shape, 0 if chain is compiled.Chain else INPUT)
    past, after, logits, z = chain.apply(decoder, torch.cat((x, place), 1), u.transpose(0, 1), gains.transpose(0, 1))
    back = BACK.to(first.device)
    prior = Gaussian(*(part.transpose(0, 1) for part in model.prior(past[..., :STATE][..., back])))
    states = to_world(start, after[..., back].transpose(0, 1), None)
    return Rollout(states, logits.transpose(0, 1), z.transpose(0, 1), prior), past.transpose(0, 1)


class Steered(torch.autograd.Function):
    """All steps: X_0 (B, 345), u (T, B, 48) and gains (T, B, 48, 345) -> X (T, B, 345), states in the frame before
    (T, B, 339), contact logits (T, B, 9) and z (T, B, 48). No derivatives of the decoder's weights or the gains."""

    @staticmethod
    def forward(ctx, decoder: Decoder, first: Tensor, u: Tensor, gains: Tensor):
        """First derivatives only."""
        step, x = Stepper(decoder, None), first
        joint = torch.cat([w for w in decoder.z_weights], 0).detach()
        bias, sizes = torch.cat(list(decoder.biases)).detach(), [len(b) for b in decoder.biases]
        past, steps, zs, ways = [], [], [], []
        place = torch.cat((first[:, STATE:], first.new_tensor([[0.0, 0.0, 1.0]]).expand(len(first), 3)), 1)
        place, places = place.unflatten(1, (3, 3)), []
        transposed = joint.mT.contiguous()
        for now, gain in zip(u.unbind(0), gains.unbind(0), strict=True):
            past.append(x)
            z = torch.baddbmm(now[..., None], gain, x[..., None])[..., 0]
            done = step(x[:, :STATE], torch.addmm(bias, z, transposed).split(sizes, 1))
            places.append(place), ways.append(_onward(done))
            place = place @ ways[-1]
            x = torch.cat((done.moved, place[:, :2].flatten(1)), 1)
            steps.append(done), zs.append(z)
        ctx.decoder, ctx.step, ctx.steps, ctx.gains, ctx.joint, ctx.sizes = decoder, step, steps, gains, joint, sizes
        ctx.past, ctx.places, ctx.ways = torch.stack(past), places, ways
        ctx.after, ctx.raw = torch.stack([s.after for s in steps]), torch.stack([s.raw for s in steps])
        return ctx.past.clone(), ctx.after.clone(), ctx.raw[..., ROT:].clone(), torch.stack(zs)

    @staticmethod
    @once_differentiable
    def backward(ctx, d_past: Tensor, d_after: Tensor, d_logits: Tensor, d_z: Tensor):
        """Gradients of X_0 and u."""
        count = len(ctx.past)
        d_past, d_after, d_logits, d_z = (d.unbind(0) for d in (d_past, d_after, d_logits, d_z))
        way = WayBack(ctx.step, ctx.steps, ctx.past[..., :STATE], ctx.after, ctx.raw)
        spins = (torch.stack([s.turn for s in ctx.steps]) @ _SPIN.to(ctx.past)).unbind(0)
        d_x, d_u = torch.zeros_like(d_past[0]), [None] * count
        for t in reversed(range(count)):
            d, d_place = d_after[t], torch.nn.functional.pad(d_x[:, STATE:].unflatten(1, (2, 3)), (0, 0, 0, 1))
            if t < count - 1:  # the last state's own frame is nobody's input
                d_angle, back = way.of_frame(t, d_x)
                d_way = ctx.places[t].mT @ d_place
                d = way.of_after(t, d, d_x, d_angle + (d_way * spins[t]).sum((1, 2))[:, None], back)
                d[:, :2] += d_way[:, :2, 2]
                d_place = d_place @ ctx.ways[t].mT
            d_shares, _, d_state = way.of_step(t, d, d_logits[t])
            d_u[t] = torch.addmm(d_z[t], torch.cat(d_shares, 1), ctx.joint)
            d_x = torch.cat((d_state, d_place[:, :2].flatten(1)), 1) + d_past[t]
            d_x = torch.baddbmm(d_x[:, None], d_u[t][:, None], ctx.gains[t])[:, 0]
        return None, d_x, torch.stack(d_u), None


def _onward(step: Step) -> Tensor:
    """From places in the next heading frame to places in this one: (B, 3, 3), homogeneous, on the floor."""
    onward = step.turn.clone()
    onward[:, :2, 2] = step.after[:, :2]
    return onward
