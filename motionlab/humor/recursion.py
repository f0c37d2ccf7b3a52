"""The recursion of a roll-out, x_t -> x_{t+1}, as one step of autograd with its derivative written out.

A state here is the official one in another order, 339 numbers,

    trans | trans_vel | root_orient_vel | joints 66 | joints_vel 66 | root_orient^T 9 | pose_body^T 189

so that its first 141 numbers are what is added to, its last 198 are the 22 matrices M = R^T that rotations exp(v)
turn, M' = M exp(v)^T, and its first 150 are the 50 vectors that the change into the next heading frame turns.

One step: raw = decoder(x, z); x' = x + raw and M' = M exp(v)^T; then every vector into the frame of x'.
Nothing of it is recorded for autograd; going backwards, what does not depend on the step before is computed for all
steps at once, and only the chain itself is walked. Source: HuMoR (Rempe et al. 2021), ``roll_out``; thesis 3.1.1.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from motionlab import rotation
from motionlab.humor.cvae import Cvae
from motionlab.humor.state import DELTA_SLICES, SLICES, STATE

_ADDED = ("trans", "trans_vel", "root_orient_vel", "joints", "joints_vel")
SUM, VECTORS, ROT = 141, 150, 207  # ends: of what is added to, of the vectors, of the rotation vectors in ``raw``
_matrices = torch.cat(
    [torch.arange(STATE)[SLICES[name]].view(-1, 3, 3).mT.flatten() for name in ("root_orient", "pose_body")]
)
#: LEAN: where each number comes from in the official state; BACK: the inverse; LEAN_RAW: the same for raw outputs.
LEAN = torch.cat([torch.arange(STATE)[SLICES[name]] for name in _ADDED] + [_matrices])
BACK = torch.argsort(LEAN)
LEAN_RAW = torch.cat(
    [torch.arange(216)[DELTA_SLICES[name]] for name in (*_ADDED, "root_orient", "pose_body", "contacts")]
)
#: What the root's place on the floor is taken from: those of the 50 vectors that are positions.
_PLACED = torch.zeros(VECTORS // 3, 3)
_PLACED[0, :2] = _PLACED[3:25, :2] = 1
#: The same as a matrix: (B, 150) @ _CENTRED has it taken off, in the transposed (backward) sense.
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


class Decoder(NamedTuple):
    """The decoder in the order above. Per Linear the weights of state and z and the bias; per norm gain and shift."""

    weights: list[Tensor]
    z_weights: list[Tensor]
    biases: list[Tensor]
    gains: list[Tensor]
    shifts: list[Tensor]
    groups: int
    eps: float

    @classmethod
    def of(cls, model: Cvae) -> Decoder:
        """That of a model; gradients, where its weights want them, flow back to it."""
        linear = [layer for layer in model.decoder.net if isinstance(layer, torch.nn.Linear)]
        norms = [layer for layer in model.decoder.net if isinstance(layer, torch.nn.GroupNorm)]
        parts = [(layer.weight[:, : -model.latent], layer.weight[:, -model.latent :], layer.bias) for layer in linear]
        device = parts[0][0].device
        parts[0] = (parts[0][0][:, LEAN.to(device)], *parts[0][1:])
        parts[-1] = tuple(part[LEAN_RAW.to(device)] for part in parts[-1])
        gains, shifts = [norm.weight for norm in norms], [norm.bias for norm in norms]
        return cls(*(list(part) for part in zip(*parts, strict=True)), gains, shifts, norms[0].num_groups, norms[0].eps)

    def shares(self, z: Tensor) -> list[Tensor]:
        """What z (..., 48) adds to each Linear (..., out), for all steps at once."""
        return [torch.nn.functional.linear(z, w, b) for w, b in zip(self.z_weights, self.biases, strict=True)]


class Step(NamedTuple):
    """One step: the new state in the old frame and in its own, contact logits, and what going back needs."""

    after: Tensor  # (B, 339)
    moved: Tensor  # (B, 339)
    raw: Tensor  # (B, 216)
    turned: Tensor  # (B, 22, 3, 3), exp(v)^T
    turn: Tensor  # (B, 3, 3), A^T
    layers: list[tuple[Tensor, ...]]  # per norm: input, mean, 1 / std, output


class Stepper:
    """Steps without autograd. ``spread`` (B, 50, 3): ``state.pelvis_offset`` at the joints, 0 elsewhere, or None."""

    def __init__(self, decoder: Decoder, spread: Tensor | None) -> None:
        self.decoder, self.spread = decoder, spread
        self.transposed = [weight.detach().mT.contiguous() for weight in decoder.weights]
        like = self.transposed[0]
        self.placed, self.centred, self.quaternion = (c.to(like) for c in (_PLACED, _CENTRED, _QUATERNION.view(16, 9)))
        self.still, self.turns = _TURN[0].reshape(9).to(like), _TURN[1:].reshape(2, 9).to(like)
        #: Added to the right axis on the floor: nothing, but where there is none the frame keeps its axes.
        self.ahead = like.new_tensor([1e-18, 0.0])
        self.tiny = torch.finfo(like.dtype).tiny ** 0.5

    def __call__(self, x: Tensor, shares: list[Tensor]) -> Step:
        """From states (B, 339) and the shares (B, out) of their z."""
        h, layers, batch = x, [], len(x)
        for weight, share, gain, shift in zip(
            self.transposed, shares, self.decoder.gains, self.decoder.shifts, strict=False
        ):
            h = torch.addmm(share, h, weight).view(batch * self.decoder.groups, -1)
            normed, mean, scale = torch.native_layer_norm(h, h.shape[-1:], None, None, self.decoder.eps)
            out = torch.addcmul(shift, normed.view(batch, -1), gain).relu_()
            layers.append((h, mean, scale, out))
            h = out
        raw = torch.addmm(shares[-1], h, self.transposed[-1])
        turned = self.exp(raw[:, SUM:ROT].unflatten(1, (22, 3)))
        matrices = x[:, SUM:].unflatten(1, (22, 3, 3)) @ turned
        after = torch.cat((x[:, :SUM] + raw[:, :SUM], matrices.flatten(1)), dim=1)
        right = self.ahead - after[:, SUM : SUM + 2]
        right = right / torch.linalg.vector_norm(right, dim=-1, keepdim=True)
        turn = torch.addmm(self.still, right, self.turns).view(-1, 3, 3)
        vectors = after[:, :VECTORS].unflatten(1, (50, 3))
        moved = torch.addcmul(vectors, self.placed, after[:, None, :3], value=-1)
        moved = moved @ turn if self.spread is None else (moved + self.spread) @ turn - self.spread
        return Step(after, torch.cat((moved.flatten(1), after[:, VECTORS:]), dim=1), raw, turned, turn, layers)

    def exp(self, v: Tensor) -> Tensor:
        """exp(v)^T (B, 22, 3, 3) by the quaternion (cos t/2, v sin(t/2) / t), t = |v|."""
        t = torch.linalg.vector_norm(v, dim=-1, keepdim=True).clamp_(min=self.tiny)
        half = 0.5 * t
        q = torch.cat((half.cos(), v * (half.sin() / t)), dim=-1)
        return ((q[..., :, None] * q[..., None, :]).flatten(-2) @ self.quaternion).unflatten(-1, (3, 3))


class Recursion(torch.autograd.Function):
    """All steps: first (B, 339), spread, shares (T, B, out) -> past, after (T, B, 339) and contact logits (T, B, 9)."""

    @staticmethod
    def forward(ctx, decoder: Decoder, first: Tensor, spread: Tensor | None, *tensors: Tensor):
        """``tensors``: the shares of the Linears, then the decoder's weights, gains and shifts."""
        shares, step = tensors[: len(decoder.weights)], Stepper(decoder, spread)
        x, past, steps = first, [], []
        for share in zip(*(each.unbind(0) for each in shares), strict=True):
            past.append(x)
            steps.append(step(x, share))
            x = steps[-1].moved
        after, raw = torch.stack([s.after for s in steps]), torch.stack([s.raw for s in steps])
        past = torch.stack(past)
        ctx.decoder, ctx.step, ctx.steps = decoder, step, steps
        ctx.past, ctx.after, ctx.raw = past, after, raw
        return past.clone(), after.clone(), raw[..., ROT:].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, d_past: Tensor, d_after: Tensor, d_logits: Tensor):
        """Gradients of first, spread, shares and, where asked for, weights, gains and shifts."""
        decoder, steps, spread = ctx.decoder, ctx.steps, ctx.step.spread
        count = len(d_past)
        d_past, d_after, d_logits = (d.unbind(0) for d in (d_past, d_after, d_logits))
        way = WayBack(ctx.step, steps, ctx.past, ctx.after, ctx.raw)
        d_x, d_spread = torch.zeros_like(d_past[0]), None if spread is None else torch.zeros_like(spread)
        d_shares, d_outs = [None] * count, [None] * count
        for t in reversed(range(count)):
            d = d_after[t]
            if t < count - 1:  # the last state's own frame is nobody's input
                d_angle, back = way.of_frame(t, d_x)
                if spread is not None:
                    d_spread += back - d_x[:, :VECTORS].unflatten(1, (50, 3))
                d = way.of_after(t, d, d_x, d_angle, back)
            d_shares[t], d_outs[t], d_x = way.of_step(t, d, d_logits[t])
            d_x = d_x + d_past[t]
        d_shares = [torch.stack(each) for each in zip(*d_shares, strict=True)]
        d_weights = [None] * (len(d_shares) + 2 * len(decoder.gains))
        if any(ctx.needs_input_grad[3 + len(d_shares) :]):
            d_weights = _of_weights(ctx, d_shares, [torch.stack(each) for each in zip(*d_outs, strict=True)])
        return None, d_x, d_spread, *d_shares, *d_weights


class WayBack:
    """The chain, walked backwards: what does not depend on the step before is computed for all steps at once.

    past, after (T, B, 339), raw (T, B, 216): of the steps.
    """

    def __init__(self, step: Stepper, steps: list[Step], past: Tensor, after: Tensor, raw: Tensor) -> None:
        self.decoder, self.steps, self.centred = step.decoder, steps, step.centred
        self.bend = rotation.left_jacobian(raw[..., SUM:ROT].unflatten(-1, (22, 3))).unbind(0)
        self.matrices = after[..., SUM:].unflatten(-1, (22, 3, 3)).unbind(0)
        self.swing, self.lever = (each.unbind(0) for each in _heading_slopes(past, after, step.spread))
        outs = [torch.stack([s.layers[k][-1] for s in steps]) for k in range(len(self.decoder.gains))]
        self.slopes = [((out > 0) * gain).unbind(0) for out, gain in zip(outs, self.decoder.gains, strict=True)]

    def of_frame(self, t: int, d_x: Tensor) -> tuple[Tensor, Tensor]:
        """From the next state in its own frame (B, 339): of the turn of that frame (B, 1) and of the vectors before it
        (B, 50, 3)."""
        vectors = d_x[:, :VECTORS]
        d_angle = (vectors * self.lever[t + 1]).sum(-1, keepdim=True)
        return d_angle, vectors.unflatten(1, (50, 3)) @ self.steps[t].turn.mT

    def of_after(self, t: int, d: Tensor, d_x: Tensor, d_angle: Tensor, back: Tensor) -> Tensor:
        """Of the next state in the old frame (B, 339): what it has already, and what comes through its own frame."""
        d = torch.addcmul(d, d_angle, self.swing[t])
        return d + torch.cat((back.flatten(1) @ self.centred, d_x[:, VECTORS:STATE]), dim=1)

    def of_step(self, t: int, d: Tensor, d_logits: Tensor) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """Of the shares, of the outputs of the norms and of the state (B, 339) that step t began with."""
        decoder, step = self.decoder, self.steps[t]
        d_matrices = d[:, SUM:].unflatten(1, (22, 3, 3))
        torque = torch.linalg.cross(self.matrices[t], d_matrices).sum(-2, keepdim=True)
        d_shares = [torch.cat((d[:, :SUM], (torque @ self.bend[t]).flatten(1), d_logits), dim=1)]
        d_h, d_outs = d_shares[0] @ decoder.weights[-1], []
        for k in reversed(range(len(decoder.gains))):
            h, mean, scale, _ = step.layers[k]
            d_outs.append(d_h)
            d_in = torch.ops.aten.native_layer_norm_backward(
                (d_h * self.slopes[k][t]).view_as(h), h, h.shape[-1:], mean, scale, None, None, [True, False, False]
            )[0]
            d_shares.append(d_in.view_as(d_h))
            d_h = d_shares[-1] @ decoder.weights[k]
        d_x = d_h + torch.cat((d[:, :SUM], (d_matrices @ step.turned.mT).flatten(1)), dim=1)
        return d_shares[::-1], d_outs[::-1], d_x


def _heading_slopes(past: Tensor, after: Tensor, spread: Tensor | None) -> tuple[Tensor, Tensor]:
    """Of the heading a = atan2(y, x) of the right axis on the floor: da/d(after), (T, B, 339), 0 where there is none;
    and d(the 50 vectors of past)/da, (T, B, 150)."""
    right = -after[..., SUM : SUM + 2]
    squared = right.square().sum(-1, keepdim=True)
    swing = torch.zeros_like(after)
    swing[..., SUM] = torch.where(squared == 0, 0.0, right / squared)[..., 1]
    swing[..., SUM + 1] = -torch.where(squared == 0, 0.0, right / squared)[..., 0]
    vectors = past[..., :VECTORS].unflatten(-1, (50, 3))
    x, y, z = (vectors if spread is None else vectors + spread).unbind(-1)
    return swing, torch.stack((y, -x, torch.zeros_like(z)), -1).flatten(-2)


def _of_weights(ctx, d_shares: list[Tensor], d_outs: list[Tensor]) -> list[Tensor]:
    """Gradients of weights, gains and shifts, from all steps at once."""
    layers = [[torch.stack(part) for part in zip(*(s.layers[k] for s in ctx.steps), strict=True)] for k in range(3)]
    inputs = [ctx.past, *(out for *_, out in layers)]
    weights = [d.flatten(0, 1).mT @ x.flatten(0, 1) for d, x in zip(d_shares, inputs, strict=True)]
    shifts = [d * (out > 0) for d, (*_, out) in zip(d_outs, layers, strict=True)]
    gains = [d * ((h - mean) * scale).view_as(d) for d, (h, mean, scale, _) in zip(shifts, layers, strict=True)]
    return [*weights, *(d.sum((0, 1)) for d in (*gains, *shifts))]
