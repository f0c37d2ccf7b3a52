"""Computes roll-outs of the prior from a first state and latents, plain or steered.

    raw = decoder(x, z);   x' = x + raw,  M' = M exp(v)^T;   then every vector into the heading frame of x'

Every step happens in the heading frame of its own newest state; the chain of steps (``compiled`` for few clips) is the
only thing that must be done one after the other. The prior of every step and the way back into the world do not feed
the chain and are computed for all steps at once. ``state.apply`` is the plain form of a step.

A steered roll-out takes u instead of z, z_t = u_t + K_t X_t, where X_t (345) is the state in its own heading frame and
that frame's place in the world, the first rows of a homogeneous matrix: cos, -sin, x | sin, cos, y. A plain roll-out
forgets nothing: what one z does stays done in all frames to come, and a search over z is stiff. With the gains K_t of
``coordinates`` every later z makes up for what an earlier one changed. Any z is reached by some u, so that
minima stay what they are, and what comes out is an exact roll-out.

Source: HuMoR (Rempe et al. 2021), ``roll_out`` of the official code; thesis 3.1.1, 3.3.1 (K-step parallel decode);
differential dynamic programming (Jacobson and Mayne 1970), forward pass. Derivatives by hand.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from motionlab import rotation
from motionlab.errors import ShapeError, check_shape
from motionlab.heading import Frame
from motionlab.humor import compiled, state
from motionlab.humor.priors import Cvae, Gaussian
from motionlab.humor.state import ADDED, CHANGES, STATE, VECTORS, globalise, heading, localise
from motionlab.parallel import threads_for

#: What the root's place on the floor is taken from: those of the 50 vectors that are positions.
_PLACED = torch.zeros(VECTORS // 3, 3)
_PLACED[0, :2] = _PLACED[3:25, :2] = 1
#: The same as a matrix: (B, 150) @ _CENTRED has it taken off, going back.
_CENTRED = torch.eye(VECTORS)
_CENTRED[:, :3] -= (_PLACED[:, :, None] * torch.eye(3)).flatten(0, 1)
_QUATERNION = torch.zeros(4, 4, 3, 3)  # exp(v)^T = sum_ij q_i q_j _QUATERNION[i, j]
_TURN = torch.zeros(3, 3, 3)  # A^T = sum_i (1, x, y)_i _TURN[i], A = [[x, y], [-y, x]]
_TURN[0, 2, 2] = _TURN[1, 0, 0] = _TURN[1, 1, 1] = _TURN[2, 1, 0] = 1
_TURN[2, 0, 1] = -1
for _a, _b, _c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _QUATERNION[0, 0, _a, _a] = _QUATERNION[_a + 1, _a + 1, _a, _a] = 1
    _QUATERNION[_b + 1, _b + 1, _a, _a] = _QUATERNION[_c + 1, _c + 1, _a, _a] = -1
    _QUATERNION[_a + 1, _b + 1, _a, _b] = _QUATERNION[_a + 1, _b + 1, _b, _a] = 2
    _QUATERNION[0, _c + 1, _a, _b], _QUATERNION[0, _c + 1, _b, _a] = 2, -2
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
        return _walked(model, start, localise(first, start), z, None, with_prior, loops)[0]


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
    return _walked(model, start, torch.cat((localise(first, start), place), 1), u, gains)


def _check(model: Cvae, first: Tensor, z: Tensor) -> None:
    check_shape(first, f"B {STATE}", "first")
    check_shape(z, f"B T {model.latent}", "z")
    if len(first) != len(z):
        raise ShapeError(f"first has {len(first)} rows, z {len(z)}")
    if not z.shape[1]:
        raise ShapeError("z has no steps: a roll-out needs T > 0")


def _walked(
    model: Cvae, start: Frame, x: Tensor, u: Tensor, gains: Tensor | None, with_prior: bool = True,
    loops: bool | None = None,
) -> tuple[Rollout, Tensor]:  # fmt: skip
    """Walks the chain from X_0 (B, 345), or a state alone (B, 339), in the frame ``start``; also all X or states."""
    layers = DecoderLayers.of(model)
    if not (compiled.fits(x, u) if loops is None else loops):
        past, *found = Chain.apply(layers, x, u.transpose(0, 1), None if gains is None else gains.transpose(0, 1))
    else:
        steering = u.new_zeros(*u.shape, 0) if gains is None else gains
        whole = F.pad(x, (0, compiled.PLACED - x.shape[1]))
        past, *found = compiled.LoopedChain.apply(layers, whole, u.transpose(0, 1), steering.transpose(0, 1))
        past = past[..., : x.shape[1]]
    prior = Gaussian(*(part.transpose(0, 1) for part in model.prior(past[..., :STATE]))) if with_prior else None
    after, logits, z = (each.transpose(0, 1) for each in found)
    return Rollout(_to_world(start, after), logits, u if gains is None else z, prior), past.transpose(0, 1)


class DecoderLayers(NamedTuple):
    """The decoder's layers apart. Per Linear the weights of state and of z and the bias; per norm gain and shift.
    skip (216, 339): of the linear layer past them, or (216, 0)."""

    weights: list[Tensor]
    z_weights: list[Tensor]
    biases: list[Tensor]
    gains: list[Tensor]
    shifts: list[Tensor]
    groups: int
    eps: float
    skip: Tensor

    @classmethod
    def of(cls, model: Cvae) -> Self:
        """Takes a model's decoder apart, without its gradients."""
        linear = [layer for layer in model.decoder.net if isinstance(layer, torch.nn.Linear)]
        norms = [layer for layer in model.decoder.net if isinstance(layer, torch.nn.GroupNorm)]
        weights = [layer.weight.detach() for layer in linear]
        parts = [weight[:, : -model.latent] for weight in weights], [weight[:, -model.latent :] for weight in weights]
        biases, gains = [layer.bias.detach() for layer in linear], [norm.weight.detach() for norm in norms]
        skip = weights[-1][:, :0] if model.skip is None else model.skip.weight.detach()
        return cls(*parts, biases, gains, [n.bias.detach() for n in norms], norms[0].num_groups, norms[0].eps, skip)


class Step(NamedTuple):
    """One step: the new state in the old frame and in its own, raw changes, and what going back needs."""

    after: Tensor  # (B, 339)
    moved: Tensor  # (B, 339)
    raw: Tensor  # (B, 216)
    turned: Tensor  # (B, 22, 3, 3), exp(v)^T
    turn: Tensor  # (B, 3, 3), A^T
    layers: list[tuple[Tensor, ...]]  # per norm: input, mean, 1 / std, output


class Stepper:
    """Takes steps without autograd."""

    def __init__(self, decoder: DecoderLayers) -> None:
        self.decoder = decoder
        self.transposed = [weight.mT.contiguous() for weight in decoder.weights]
        self.skip = decoder.skip.mT.contiguous()
        like = self.transposed[0]
        self.placed, self.centred, self.quaternion = (c.to(like) for c in (_PLACED, _CENTRED, _QUATERNION.view(16, 9)))
        self.still, self.turns = _TURN[0].reshape(9).to(like), _TURN[1:].reshape(2, 9).to(like)
        #: Added to the right axis on the floor: nothing, but where there is none the frame keeps its axes.
        self.ahead = like.new_tensor([1e-18, 0.0])
        self.tiny = torch.finfo(like.dtype).tiny ** 0.5

    def __call__(self, x: Tensor, shares: list[Tensor]) -> Step:
        """Computes one step from states (B, 339), each in its own heading frame, and the shares (B, out) of their z."""
        h, layers, batch, norms = x, [], len(x), zip(self.decoder.gains, self.decoder.shifts, strict=True)
        for weight, share, (gain, shift) in zip(self.transposed, shares, norms, strict=False):
            h = torch.addmm(share, h, weight).view(batch * self.decoder.groups, -1)
            normed, mean, scale = torch.native_layer_norm(h, h.shape[-1:], None, None, self.decoder.eps)
            out = torch.addcmul(shift, normed.view(batch, -1), gain).relu_()
            layers.append((h, mean, scale, out))
            h = out
        raw = torch.addmm(shares[-1], h, self.transposed[-1])
        if self.skip.numel():
            raw = torch.addmm(raw, x, self.skip)
        turned = self.exp(raw[:, ADDED:CHANGES].unflatten(1, (22, 3)))
        matrices = x[:, ADDED:].unflatten(1, (22, 3, 3)) @ turned
        after = torch.cat((x[:, :ADDED] + raw[:, :ADDED], matrices.flatten(1)), dim=1)
        right = self.ahead - after[:, ADDED : ADDED + 2]
        right = right / torch.linalg.vector_norm(right, dim=-1, keepdim=True)
        turn = torch.addmm(self.still, right, self.turns).view(-1, 3, 3)
        vectors = after[:, :VECTORS].unflatten(1, (50, 3))
        moved = torch.addcmul(vectors, self.placed, after[:, None, :3], value=-1) @ turn
        return Step(after, torch.cat((moved.flatten(1), after[:, VECTORS:]), dim=1), raw, turned, turn, layers)

    def exp(self, v: Tensor) -> Tensor:
        """Computes exp(v)^T (B, 22, 3, 3) by the quaternion (cos t/2, v sin(t/2) / t), t = |v|."""
        t = torch.linalg.vector_norm(v, dim=-1, keepdim=True).clamp_(min=self.tiny)
        half = 0.5 * t
        q = torch.cat((half.cos(), v * (half.sin() / t)), dim=-1)
        return ((q[..., :, None] * q[..., None, :]).flatten(-2) @ self.quaternion).unflatten(-1, (3, 3))


class Chain(torch.autograd.Function):
    """All steps in tensors, with first derivatives: from X_0 (B, 339 or 345), u (T, B, 48) and gains (T, B, 48, 345) or
    none to X (T, B, 339 or 345), states in the frame before (T, B, 339), contact logits (T, B, 9) and z (T, B, 48)."""

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
                way = done.turn.clone()  # from places in the next heading frame to places in this one
                way[:, :2, 2] = done.after[:, :2]
                places.append(place), ways.append(way)
                place = place @ way
                x = torch.cat((x, place.flatten(1)), 1)
            steps.append(done), zs.append(z)
        ctx.step, ctx.steps, ctx.gains, ctx.joint, ctx.places, ctx.ways = step, steps, gains, joint, places, ways
        ctx.past = torch.stack(past)
        ctx.after, ctx.raw = torch.stack([s.after for s in steps]), torch.stack([s.raw for s in steps])
        return ctx.past.clone(), ctx.after.clone(), ctx.raw[..., CHANGES:].clone(), torch.stack(zs)

    @staticmethod
    @once_differentiable
    def backward(ctx, d_past: Tensor, d_after: Tensor, d_logits: Tensor, d_z: Tensor):
        """Computes the gradients of X_0 and u; what does not depend on the step before for all steps at once."""
        decoder, steps, count, placed = ctx.step.decoder, ctx.steps, len(ctx.past), bool(ctx.places)
        d_past, d_after, d_logits = (d.unbind(0) for d in (d_past, d_after, d_logits))
        bend = rotation.left_jacobian(ctx.raw[..., ADDED:CHANGES].unflatten(-1, (22, 3))).unbind(0)
        matrices = ctx.after[..., ADDED:].unflatten(-1, (22, 3, 3)).unbind(0)
        swing, lever = (each.unbind(0) for each in _heading_slopes(ctx.past[..., :STATE], ctx.after))
        outs = [torch.stack([s.layers[k][-1] for s in steps]) for k in range(len(decoder.gains))]
        slopes = [((out > 0) * gain).unbind(0) for out, gain in zip(outs, decoder.gains, strict=True)]
        spins = (torch.stack([s.turn for s in steps]) @ _SPIN.to(ctx.past)).unbind(0) if placed else ()
        d_x, d_shares = torch.zeros_like(d_past[0]), [None] * count
        for t in reversed(range(count)):
            d, step = d_after[t], steps[t]
            d_place = d_x[:, STATE:].unflatten(1, (2, 3)) if placed else None
            if t < count - 1:  # the last state's own frame is nobody's input
                vectors = d_x[:, :VECTORS]
                d_angle = (vectors * lever[t + 1]).sum(-1, keepdim=True)
                back = vectors.unflatten(1, (50, 3)) @ step.turn.mT
                if placed:
                    d_way = ctx.places[t].mT @ d_place
                    d_angle = d_angle + (d_way * spins[t]).sum((1, 2))[:, None]
                d = torch.addcmul(d, d_angle, swing[t])
                d = d + torch.cat((back.flatten(1) @ ctx.step.centred, d_x[:, VECTORS:STATE]), dim=1)
                if placed:
                    d[:, :2] += d_way[:, :2, 2]
                    d_place = d_place @ ctx.ways[t].mT
            d_matrices = d[:, ADDED:].unflatten(1, (22, 3, 3))
            torque = torch.linalg.cross(matrices[t], d_matrices).sum(-2, keepdim=True)
            shares = [torch.cat((d[:, :ADDED], (torque @ bend[t]).flatten(1), d_logits[t]), dim=1)]
            d_h = shares[0] @ decoder.weights[-1]
            for k in reversed(range(len(decoder.gains))):
                h, mean, scale, _ = step.layers[k]
                d_in = torch.ops.aten.native_layer_norm_backward(
                    (d_h * slopes[k][t]).view_as(h), h, h.shape[-1:], mean, scale, None, None, [True, False, False]
                )[0]
                shares.insert(0, d_in.view_as(d_h))
                d_h = shares[0] @ decoder.weights[k]
            if decoder.skip.numel():
                d_h = torch.addmm(d_h, shares[-1], decoder.skip)
            d_x = d_h + torch.cat((d[:, :ADDED], (d_matrices @ step.turned.mT).flatten(1)), dim=1)
            d_shares[t] = torch.cat(shares, 1)
            if placed:
                d_x = torch.cat((d_x, d_place.flatten(1)), 1)
            d_x = d_x + d_past[t]
            if ctx.gains is not None:
                d_shares[t] = torch.addmm(d_z[t], d_shares[t], ctx.joint)  # of u
                d_x = torch.baddbmm(d_x[:, None], d_shares[t][:, None], ctx.gains[t])[:, 0]
        d_u = torch.stack(d_shares)
        return None, d_x, d_z + d_u @ ctx.joint if ctx.gains is None else d_u, None


def _heading_slopes(past: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Of the heading a = atan2(y, x) of the right axis on the floor: da/d(after), (T, B, 339), 0 where there is none;
    and d(the 50 vectors of past)/da, (T, B, 150)."""
    right = -after[..., ADDED : ADDED + 2]
    squared = right.square().sum(-1, keepdim=True)
    swing = torch.zeros_like(after)
    swing[..., ADDED] = torch.where(squared == 0, 0.0, right / squared)[..., 1]
    swing[..., ADDED + 1] = -torch.where(squared == 0, 0.0, right / squared)[..., 0]
    x, y, z = past[..., :VECTORS].unflatten(-1, (50, 3)).unbind(-1)
    return swing, torch.stack((y, -x, torch.zeros_like(z)), -1).flatten(-2)


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


def sample_rollout(model: Cvae, first: Tensor, steps: int, *, generator: torch.Generator | None = None) -> Rollout:
    """Computes a roll-out from states (B, 339), world coordinates, with z from the prior: drawn where a generator is
    given, else its mean. Keeps no gradients.
    """
    check_shape(first, f"B {STATE}", "first")
    with torch.no_grad(), threads_for(len(first)):
        decoder = DecoderLayers.of(model)
        step, start = Stepper(decoder), heading(first)
        x = localise(first, start)
        after, logits, zs, means, variances = [], [], [], [], []
        for _ in range(steps):
            prior = model.prior(x)
            z = prior.mean if generator is None else prior.sample(generator)
            now = step(x, [F.linear(z, w, b) for w, b in zip(decoder.z_weights, decoder.biases, strict=True)])
            x = now.moved
            after.append(now.after), logits.append(now.raw[:, CHANGES:]), zs.append(z)
            means.append(prior.mean), variances.append(prior.log_var)
        after, logits, zs, means, variances = (torch.stack(each, 1) for each in (after, logits, zs, means, variances))
        return Rollout(_to_world(start, after), logits, zs, Gaussian(means, variances))


def infer(model: Cvae, states: Tensor) -> tuple[Gaussian, Gaussian]:
    """Computes posterior and prior (B, T - 1, 48) of every transition of world states (B, T, 339), all at once."""
    past, now = state.transition_pairs(states)
    return model.posterior(past, now), model.prior(past)


def decode_ahead(model: Cvae, states: Tensor, z: Tensor) -> Tensor:
    """Computes one transition from every state at once: (B, T, 339), entry [b, t] predicts the state t + 1.

    states (B, T, 339), world; z (B, T, 48) of the transition out of each state.
    Source: thesis 3.3.1, the decoupled roll-out with one decoding step.
    """
    found = rollout(model, states.flatten(0, 1), z.flatten(0, 1)[:, None], with_prior=False).states
    return found.unflatten(0, states.shape[:2])[:, :, 0]
