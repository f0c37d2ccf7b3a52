"""Roll-outs of the prior: from a first state and latents to a motion. The lean form, with nothing computed twice.

Every step happens in the canonical frame of its own newest state. Of that state only the pose, 189 numbers, and 50
vectors remain to be handled, and turning them is one matrix product; the prior, which does not feed the recursion, is
evaluated for all steps at once when the states are known.

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
from motionlab.humor.state import DELTA_SLICES, SLICES, STATE, globalise, heading, localise

#: Where the lean layout [50 vectors | pose] takes its entries from a packed state: trans, trans_vel,
#: root_orient_vel, the three columns of root_orient, joints, joints_vel.
_START = {name: part.start for name, part in SLICES.items()}
_VECTORS = [
    *(_START[name] + i for name in ("trans", "trans_vel", "root_orient_vel") for i in range(3)),
    *(_START["root_orient"] + 3 * row + column for column in range(3) for row in range(3)),
    *(_START[name] + i for name in ("joints", "joints_vel") for i in range(66)),
]
LEAN = torch.tensor([*_VECTORS, *range(SLICES["pose_body"].start, SLICES["pose_body"].stop)])
_BACK = torch.argsort(LEAN)
_DELTA = {name: list(range(part.start, part.stop)) for name, part in DELTA_SLICES.items()}
#: The raw output likewise: 47 vectors, 22 rotation vectors, 9 logits.
_ORDER = ("trans", "trans_vel", "root_orient_vel", "joints", "joints_vel", "root_orient", "pose_body", "contacts")
_LEAN_DELTA = torch.tensor([i for name in _ORDER for i in _DELTA[name]])


class Rollout(NamedTuple):
    """states (B, T, 339), t = 1..T; contact_logits (B, T, 9); z (B, T, 48); prior of each z, or None."""

    states: Tensor
    contact_logits: Tensor
    z: Tensor
    prior: Gaussian | None


class _LeanDecoder:
    """The decoder with its first columns and last rows in the lean order."""

    def __init__(self, model: Cvae) -> None:
        net = model.decoder.net
        first, last = net[0], net[-1]
        self.state_weight = first.weight[:, :STATE][:, LEAN.to(first.weight.device)]
        self.z_weight, self.bias = first.weight[:, STATE:], first.bias
        pick = _LEAN_DELTA.to(first.weight.device)
        self.last_weight, self.last_bias = last.weight[pick], last.bias[pick]
        self.middle = [net[i] for i in range(1, len(net) - 1)]
        self.z_in = [layer.weight[:, layer.in_features - model.latent :] for layer in self.middle if _linear(layer)]
        self.x_in = [layer.weight[:, : layer.in_features - model.latent] for layer in self.middle if _linear(layer)]

    def prepare(self, z: Tensor) -> list[tuple[Tensor, ...]]:
        """What z adds to each Linear, for all steps at once: per step a tuple of (B, out)."""
        biases = [layer.bias for layer in self.middle if _linear(layer)]
        shares = [F.linear(z, self.z_weight, self.bias)]
        shares += [F.linear(z, weight, bias) for weight, bias in zip(self.z_in, biases, strict=True)]
        hidden = self.last_weight.shape[1] - z.shape[-1]
        shares.append(F.linear(z, self.last_weight[:, hidden:], self.last_bias))
        return list(zip(*(share.unbind(-2) for share in shares), strict=True))

    def __call__(self, x: Tensor, shares: tuple[Tensor, ...]) -> Tensor:
        h, used = torch.addmm(shares[0], x, self.state_weight.mT), 0
        for layer in self.middle:
            if _linear(layer):
                h = torch.addmm(shares[used + 1], h, self.x_in[used].mT)
                used += 1
            else:
                h = layer(h)
        return torch.addmm(shares[-1], h, self.last_weight[:, : h.shape[-1]].mT)


def _linear(layer: torch.nn.Module) -> bool:
    return isinstance(layer, torch.nn.Linear)


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
        first: (B, 339) states, world coordinates. z: (B, T, 48).
        offset: (B, 3) from ``state.pelvis_offset`` where ``trans`` is not the pelvis.
        with_prior: evaluate p(z_t | x_{t-1}) of every step, in one batch.

    Returns:
        states in the coordinates of ``first``.
    Raises:
        ShapeError: first and z do not fit each other.
    """
    check_shape(first, f"B {STATE}", "first")
    check_shape(z, f"B T {model.latent}", "z")
    if len(first) != len(z):
        raise ShapeError(f"first has {len(first)} rows, z {len(z)}")
    start = heading(first)
    x = localise(first, start, offset)
    decode = _LeanDecoder(model)
    c = None if offset is None else torch.nn.functional.pad(offset[:, None].expand(-1, 22, -1), (0, 0, 6, 22))
    vectors, pose = x[:, LEAN[:150]].unflatten(-1, (50, 3)), x[:, LEAN[150:]].unflatten(-1, (21, 3, 3))
    past, after, logits, turns, shifts = [], [], [], [], []
    for shares in decode.prepare(z):
        lean = torch.cat((vectors.flatten(1), pose.flatten(1)), dim=-1)
        raw = decode(lean, shares)
        vectors, pose = _transition(vectors, pose, raw)
        past.append(lean)
        after.append(torch.cat((vectors.flatten(1), pose.flatten(1)), dim=-1))
        logits.append(raw[:, -9:])
        turn, shift = _heading(vectors)
        moved = vectors + shift if c is None else vectors + shift + c
        vectors = moved @ turn.mT if c is None else moved @ turn.mT - c
        turns.append(turn)
        shifts.append(shift[:, 0])
    back = _BACK.to(first.device)
    local = torch.stack(after, 1)[..., back]  # each in the frame of the step before
    frames = _chain(torch.stack(turns, 1), torch.stack(shifts, 1))
    spread = None if offset is None else offset[:, None]
    inside = globalise(local, frames, spread)  # in the frame of the first state
    states = globalise(inside, Frame(start.turn[:, None], start.shift[:, None]), spread)
    prior = model.prior(torch.stack(past, 1)[..., back]) if with_prior else None
    return Rollout(states, torch.stack(logits, 1), z, prior)


_MOVES = torch.zeros(50, 1)
_MOVES[0] = _MOVES[6:28] = 1  # positions; all other vectors are only turned


def _transition(vectors: Tensor, pose: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
    added = raw[:, :141].unflatten(-1, (47, 3))
    turned = _small_exp(raw[:, 141:207].unflatten(-1, (22, 3)))
    # the columns of the root's matrix are vectors 3..5: R' = E R, column by column
    columns = vectors[:, 3:6] @ turned[:, 0].mT
    vectors = torch.cat((vectors[:, :3] + added[:, :3], columns, vectors[:, 6:] + added[:, 3:]), dim=1)
    return vectors, turned[:, 1:] @ pose


def _small_exp(tangent: Tensor) -> Tensor:
    return rotation.exp(tangent)


def _heading(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """turn (B, 3, 3) and shift (B, 50, 3) of the newest state; ``frames.heading_frame`` in the lean layout."""
    right = -vectors[:, 3, :2]
    right = right / right.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    x, y = right.unbind(-1)
    o, one = torch.zeros_like(x), torch.ones_like(x)
    turn = torch.stack((x, y, o, -y, x, o, o, o, one), -1).unflatten(-1, (3, 3))
    on_floor = torch.stack((-vectors[:, 0, 0], -vectors[:, 0, 1], o), -1)
    return turn, on_floor[:, None] * _MOVES.to(vectors)


def _chain(turns: Tensor, shifts: Tensor) -> Frame:
    """Frames (B, T), relative to the first state, of the state that step t = 1..T starts from.

    x_{k+1} = A_k (x_k + s_k), so that x_k = turn_k (x_0 + shift_k) with turn_{k+1} = A_k turn_k and
    shift_{k+1} = shift_k + turn_k^T s_k.
    """
    angle = torch.atan2(turns[..., 1, 0], turns[..., 0, 0])
    total = (angle.cumsum(1) - angle)[..., None, None]  # before the step
    x, y, o = total.cos(), total.sin(), torch.zeros_like(total)
    turn = torch.cat((torch.cat((x, -y, o), -1), torch.cat((y, x, o), -1), torch.cat((o, o, o + 1), -1)), -2)
    way = (turn.mT @ shifts[..., None])[..., 0]
    return Frame(turn, way.cumsum(1) - way)


def sample(
    model: Cvae, first: Tensor, steps: int, *, generator: torch.Generator | None = None, offset: Tensor | None = None
) -> Rollout:
    """Roll out with z from the prior: drawn where a generator is given, else its mean. Gradients are not kept.

    first: (B, 339) states, world coordinates.
    """
    check_shape(first, f"B {STATE}", "first")
    states, logits, zs, means, variances = [], [], [], [], []
    x = first
    with torch.no_grad():
        for _ in range(steps):
            prior = model.prior(localise(x, heading(x), offset))
            z = prior.mean if generator is None else prior.sample(generator)
            step = rollout(model, x, z[:, None], offset=offset, with_prior=False)
            x = step.states[:, 0]
            states.append(x), logits.append(step.contact_logits[:, 0]), zs.append(z)
            means.append(prior.mean), variances.append(prior.log_var)
    stack = [torch.stack(each, 1) for each in (states, logits, zs, means, variances)]
    return Rollout(*stack[:3], Gaussian(*stack[3:]))


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
