"""Computes one transition x_t -> x_{t+1} fast, and its derivative by hand; ``state.apply`` is the plain form.

    raw = decoder(x, z);   x' = x + raw,  M' = M exp(v)^T;   then every vector into the heading frame of x'

``Stepper`` records nothing for autograd. Going backwards, what does not depend on the step before is computed for all
steps at once, and only the chain itself is walked.

Source: HuMoR (Rempe et al. 2021), ``roll_out`` of the official code; thesis 3.1.1. Derivatives by hand.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.humor.cvae import Cvae
from motionlab.humor.state import ADDED, CHANGES, JOINT_COUNT, STATE, VECTORS

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
    def of(cls, model: Cvae) -> DecoderLayers:
        """Takes a model's decoder apart, without its gradients."""
        linear = [layer for layer in model.decoder.net if isinstance(layer, torch.nn.Linear)]
        norms = [layer for layer in model.decoder.net if isinstance(layer, torch.nn.GroupNorm)]
        weights = [layer.weight.detach() for layer in linear]
        return cls(
            [weight[:, : -model.latent] for weight in weights],
            [weight[:, -model.latent :] for weight in weights],
            [layer.bias.detach() for layer in linear],
            [norm.weight.detach() for norm in norms],
            [norm.bias.detach() for norm in norms],
            norms[0].num_groups,
            norms[0].eps,
            weights[-1][:, :0] if model.skip is None else model.skip.weight.detach(),
        )

    def shares(self, z: Tensor) -> list[Tensor]:
        """Computes what latents z (..., 48) add to each Linear (..., out), for all steps at once."""
        return [torch.nn.functional.linear(z, w, b) for w, b in zip(self.z_weights, self.biases, strict=True)]


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
        if self.skip.numel():
            raw = torch.addmm(raw, x, self.skip)
        turned = self.exp(raw[:, ADDED:CHANGES].unflatten(1, (JOINT_COUNT, 3)))
        matrices = x[:, ADDED:].unflatten(1, (JOINT_COUNT, 3, 3)) @ turned
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


class WayBack:
    """Computes the gradients of a chain of T steps, from the last step to the first.

    past, after (T, B, 339), raw (T, B, 216): the states that the steps begin with, their results and raw changes.
    """

    def __init__(self, step: Stepper, steps: list[Step], past: Tensor, after: Tensor, raw: Tensor) -> None:
        self.decoder, self.steps, self.centred = step.decoder, steps, step.centred
        self.bend = rotation.left_jacobian(raw[..., ADDED:CHANGES].unflatten(-1, (JOINT_COUNT, 3))).unbind(0)
        self.matrices = after[..., ADDED:].unflatten(-1, (JOINT_COUNT, 3, 3)).unbind(0)
        self.swing, self.lever = (each.unbind(0) for each in _heading_slopes(past, after))
        outs = [torch.stack([s.layers[k][-1] for s in steps]) for k in range(len(self.decoder.gains))]
        self.slopes = [((out > 0) * gain).unbind(0) for out, gain in zip(outs, self.decoder.gains, strict=True)]

    def of_frame(self, t: int, d_x: Tensor) -> tuple[Tensor, Tensor]:
        """Computes from the gradient of the next state in its own frame (B, 339) those of the turn of that frame (B, 1)
        and of the vectors before the turn (B, 50, 3)."""
        vectors = d_x[:, :VECTORS]
        d_angle = (vectors * self.lever[t + 1]).sum(-1, keepdim=True)
        return d_angle, vectors.unflatten(1, (50, 3)) @ self.steps[t].turn.mT

    def of_after(self, t: int, d: Tensor, d_x: Tensor, d_angle: Tensor, back: Tensor) -> Tensor:
        """Computes the gradient of the next state in the old frame (B, 339): what it has already, and what comes
        through its own frame."""
        d = torch.addcmul(d, d_angle, self.swing[t])
        return d + torch.cat((back.flatten(1) @ self.centred, d_x[:, VECTORS:STATE]), dim=1)

    def of_step(self, t: int, d: Tensor, d_logits: Tensor) -> tuple[list[Tensor], Tensor]:
        """Computes the gradients of the shares and of the state (B, 339) that step t began with."""
        decoder, step = self.decoder, self.steps[t]
        d_matrices = d[:, ADDED:].unflatten(1, (JOINT_COUNT, 3, 3))
        torque = torch.linalg.cross(self.matrices[t], d_matrices).sum(-2, keepdim=True)
        d_shares = [torch.cat((d[:, :ADDED], (torque @ self.bend[t]).flatten(1), d_logits), dim=1)]
        d_h = d_shares[0] @ decoder.weights[-1]
        for k in reversed(range(len(decoder.gains))):
            h, mean, scale, _ = step.layers[k]
            d_in = torch.ops.aten.native_layer_norm_backward(
                (d_h * self.slopes[k][t]).view_as(h), h, h.shape[-1:], mean, scale, None, None, [True, False, False]
            )[0]
            d_shares.append(d_in.view_as(d_h))
            d_h = d_shares[-1] @ decoder.weights[k]
        if decoder.skip.numel():
            d_h = torch.addmm(d_h, d_shares[0], decoder.skip)
        return d_shares[::-1], d_h + torch.cat((d[:, :ADDED], (d_matrices @ step.turned.mT).flatten(1)), dim=1)


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
