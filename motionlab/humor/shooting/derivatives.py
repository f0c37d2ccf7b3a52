"""Computes the derivatives of transitions and of the prior, for all frames of all clips at once.

A small change of a frame is 210 numbers: its state's in its own heading frame,

    xi 207 = trans | trans_vel | root_orient_vel | joints 66 | joints_vel 66 | omega 66

where omega turns the 22 rotations from the left, R -> exp(omega) R, and gamma = (turn, x, y), how its heading frame
itself turns about z and moves on the floor, in its own axes. Networks are differentiated layer by layer, forward
where there are fewer inputs than outputs (the decoder) and backward where there are more (the prior's mean).

Source: HuMoR (Rempe et al. 2021), the networks and ``roll_out``; derivatives by hand.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.humor import state
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.state import ADDED, CHANGES
from motionlab.humor.transition import DecoderLayers

XI, GAMMA, LATENTS = 207, 3, 48
CHANGE = XI + GAMMA
_PIECE = 16  # frames at a time
_POSITIONS = torch.zeros(47, dtype=torch.bool)  # of the 47 vectors of xi those that are places: trans, joints
_POSITIONS[0] = _POSITIONS[3:25] = True


class TransitionSlopes(NamedTuple):
    """Derivatives of frame t + 1 in z and in a small change of frame t, N transitions.

    of_change (N, 210, 210) and of_z (N, 210, 48): columns are causes. turn (N, 3, 3): from the axes of frame t to
    those of frame t + 1 (as row vectors from the right, ``transition.Step.turn``).
    """

    of_change: Tensor
    of_z: Tensor
    turn: Tensor


def about_z(v: Tensor) -> Tensor:
    """Computes e_z x v (..., 3)."""
    return torch.stack((-v[..., 1], v[..., 0], torch.zeros_like(v[..., 0])), -1)


def transition_slopes(decoder: DecoderLayers, x: Tensor, z: Tensor, slopes: Tensor | None = None) -> TransitionSlopes:
    """Computes the derivatives of N transitions in state and z from states (N, 339), own frames, and latents z (N, 48).

    slopes: of the decoder (``decoder_slopes``), or what shall stand for them; changed in place.
    """
    raw, slopes = _raw(decoder, x, z), decoder_slopes(decoder, x, z) if slopes is None else slopes
    v = raw[:, ADDED:CHANGES].unflatten(1, (22, 3))
    turned = rotation.exp(v)
    root = turned[:, 0] @ x[:, ADDED : ADDED + 9].unflatten(1, (3, 3)).mT
    after = x[:, :ADDED] + raw[:, :ADDED]
    turn, of_root, of_raw, centre = _into_new_frame(after, root, rotation.left_jacobian(v))
    slopes[:, :ADDED, :ADDED].diagonal(dim1=-2, dim2=-1).add_(1.0)
    out = of_raw.mT @ slopes.mT  # (N, 210, 255)
    out[..., ADDED : ADDED + 3] += of_root.mT @ turned[:, 0]  # what turns a joint before the step turns it after
    body = torch.arange(1, 22, device=x.device)
    blocks = out[:, ADDED:XI, ADDED:XI].unflatten(1, (22, 3)).unflatten(3, (22, 3))
    blocks[:, body, :, body] += turned[:, 1:].transpose(0, 1)
    of_change = x.new_zeros(len(x), CHANGE, CHANGE)
    of_change[..., :XI] = out[..., :XI]
    of_change[:, XI, XI] = 1.0
    of_change[:, XI + 1 :, XI] = (about_z(centre)[:, None] @ turn)[:, 0, :2]
    of_change[:, XI + 1 :, XI + 1 :] = turn[:, :2, :2].mT
    return TransitionSlopes(of_change, out[..., XI:], turn)


def _into_new_frame(after: Tensor, root: Tensor, bend: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What small changes in the old axes become in the frame of the new state, which they move.

    after (N, 141): its vectors in the old axes. root (N, 3, 3): its orientation. bend (N, 22, 3, 3): from changes of
    the rotation vectors to omega.

    Returns:
        turn (N, 3, 3); maps from the right to changes (..., 210), of the root's omega (N, 3, 210) and of the raw
        changes (N, 207, 210); and the new frame's place (N, 3) in the old axes.
    """
    axis, places = -root[:, :, 0], _POSITIONS.to(after.device)
    flat = axis[:, :2].square().sum(-1, keepdim=True).clamp(min=1e-18)
    turn = _rotation_z(*(axis[:, :2] / flat.sqrt()).unbind(-1))  # row vectors: v @ turn is in the new axes
    angle = torch.cat((-axis[:, 2:] * axis[:, :2] / flat, torch.ones_like(flat)), -1)  # of the frame, per omega
    centre = torch.cat((after[:, :2], torch.zeros_like(after[:, :1])), 1)
    own = (after.unflatten(1, (47, 3)) - places[:, None] * centre[:, None]) @ turn
    of_root = after.new_zeros(len(after), 3, CHANGE)
    of_root[..., :ADDED] = -angle[..., None] * about_z(own).flatten(1)[:, None]
    of_root[..., ADDED : ADDED + 3] = turn
    of_root[..., ADDED + 2] -= angle
    of_root[..., XI] = angle
    of_raw, each = after.new_zeros(len(after), XI, CHANGE), torch.arange(47, device=after.device)
    vectors = of_raw[:, :ADDED, :ADDED].unflatten(1, (47, 3)).unflatten(3, (47, 3))
    vectors[:, each, :, each] = turn
    vectors[:, 0, :2] -= places[:, None] * turn[:, :2, None]  # positions: from the new frame's place
    of_raw[:, :2, XI + 1 :] = turn[:, :2, :2]
    body, bent = each[1:22], bend.mT
    of_raw[:, ADDED:, ADDED:XI].unflatten(1, (22, 3)).unflatten(3, (22, 3))[:, body, :, body] = bent[:, 1:].transpose(
        0, 1
    )
    of_raw[:, ADDED : ADDED + 3] = bent[:, 0] @ of_root
    return turn, of_root, of_raw, centre


def _rotation_z(cos: Tensor, sin: Tensor) -> Tensor:
    """Matrices (N, 3, 3) that take row vectors, from the right, into axes turned by the angle about z."""
    o, one = torch.zeros_like(cos), torch.ones_like(cos)
    return torch.stack((cos, -sin, o, sin, cos, o, o, o, one), -1).unflatten(-1, (3, 3))


# ------------------------------------------------------------------------------------------------------ the networks
def _rotation_inputs(x: Tensor) -> Tensor:
    """How the 22 transposed matrices of states (N, 339) change with omega: (22, N 3, 9)."""
    m = x[:, ADDED:].unflatten(1, (22, 3, 3))
    basis = rotation.skew(torch.eye(3, dtype=x.dtype, device=x.device))
    change = -m[:, :, None] @ basis  # R -> (1 + [w]) R is M -> M (1 - [w])
    return change.transpose(0, 1).flatten(1, 2).flatten(-2)


def _norm_slope(h: Tensor, gain: Tensor, shift: Tensor, groups: int, eps: float):
    """relu(norm(h)) (N, C), and what applies its derivative to rows (N, R, C): the scale (N, C), what gathers means (N,
    C, 2 G), and what is taken off for each (N, 2 G, C)."""
    grouped = h.unflatten(-1, (groups, -1))
    mean, variance = grouped.mean(-1, keepdim=True), grouped.var(-1, keepdim=True, correction=0)
    scale = (variance + eps).rsqrt()
    normed = (grouped - mean) * scale
    out = torch.addcmul(shift, normed.flatten(-2), gain)
    alive = ((out > 0) * gain).unflatten(-1, (groups, -1)) * scale
    size, eye = grouped.shape[-1], torch.eye(groups, dtype=h.dtype, device=h.device)

    def spread(*parts: Tensor) -> Tensor:  # two of (N, G, s) -> (N, C, 2 G), block diagonal
        return torch.cat([(part[..., None] * eye[:, None]).flatten(1, 2) for part in parts], -1)

    gather, taken = spread(torch.ones_like(normed), normed) / size, spread(alive, alive * normed).mT
    return out.relu(), alive.flatten(-2), gather, taken


def _through(rows: Tensor, scale: Tensor, gather: Tensor, taken: Tensor) -> Tensor:
    """Directional derivatives (N, R, C) through norm and ReLU."""
    return (rows * scale[:, None]).baddbmm_(rows @ gather, taken, alpha=-1)


def _back_through(rows: Tensor, scale: Tensor, gather: Tensor, taken: Tensor) -> Tensor:
    """Adjoints (N, R, C) back through norm and ReLU."""
    return (rows * scale[:, None]).baddbmm_(rows @ taken.mT, gather.mT, alpha=-1)


def _raw(decoder: DecoderLayers, x: Tensor, z: Tensor) -> Tensor:
    """Raw changes (N, 216)."""
    h, (*shares, last) = x, decoder.shares(z)
    for weight, share, gain, shift in zip(decoder.weights, shares, decoder.gains, decoder.shifts, strict=False):
        grouped = (h @ weight.mT + share).unflatten(-1, (decoder.groups, -1))
        normed = torch.nn.functional.layer_norm(grouped, grouped.shape[-1:], eps=decoder.eps).flatten(-2)
        h = torch.addcmul(shift, normed, gain).relu()
    raw = h @ decoder.weights[-1].mT + last
    return raw + x @ decoder.skip.mT if decoder.skip.numel() else raw


def decoder_slopes(decoder: DecoderLayers, x: Tensor, z: Tensor) -> Tensor:
    """Computes the derivatives (N, 207 + 48, 207) of the first 207 raw changes in xi and z; rows are causes."""
    return torch.cat([_decoder_slopes(decoder, *piece) for piece in zip(x.split(_PIECE), z.split(_PIECE), strict=True)])


def _decoder_slopes(decoder: DecoderLayers, x: Tensor, z: Tensor) -> Tensor:
    first = decoder.weights[0]
    count = len(x)
    turns = (_rotation_inputs(x) @ first[:, ADDED:].mT.unflatten(0, (22, 9))).unflatten(1, (count, 3))
    rows = torch.cat(
        (
            first[:, :ADDED].mT.expand(count, -1, -1),
            turns.transpose(0, 1).flatten(1, 2),
            decoder.z_weights[0].mT.expand(count, -1, -1),
        ),
        1,
    )
    shares = decoder.shares(z)
    h = x @ first.mT + shares[0]
    norm = partial(_norm_slope, groups=decoder.groups, eps=decoder.eps)
    for k, (gain, shift) in enumerate(zip(decoder.gains, decoder.shifts, strict=True), start=1):
        out, *slope = norm(h, gain, shift)
        weight, keep = decoder.weights[k], CHANGES if k == len(decoder.gains) else None
        rows = _through(rows, *slope) @ weight[:keep].mT
        rows[:, XI:] += decoder.z_weights[k][:keep].mT
        h = out @ weight.mT + shares[k]
    if decoder.skip.numel():
        past = decoder.skip[:CHANGES]
        turned = _rotation_inputs(x) @ past[:, ADDED:].mT.unflatten(0, (22, 9))
        rows[:, :ADDED] += past[:, :ADDED].mT
        rows[:, ADDED:XI] += turned.unflatten(1, (count, 3)).transpose(0, 1).flatten(1, 2)
    return rows


def prior_slopes(model: Cvae, x: Tensor) -> tuple[Gaussian, Tensor]:
    """Computes p(z | x) at N states (N, 339) in their own heading frames, and the derivatives (N, 96, 207) in xi of its
    mean and of its log variance. In pieces, for the cache."""
    means, variances, rows = zip(*(_prior_slopes(model, piece) for piece in x.split(_PIECE)), strict=True)
    return Gaussian(torch.cat(means), torch.cat(variances)), torch.cat(rows)


def _prior_slopes(model: Cvae, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    linear = [layer for layer in model.prior_net.net if isinstance(layer, torch.nn.Linear)]
    norms = [layer for layer in model.prior_net.net if isinstance(layer, torch.nn.GroupNorm)]
    h, slopes = x, []
    for layer, norm in zip(linear, norms, strict=False):
        h, *slope = _norm_slope(layer(h), norm.weight, norm.bias, norm.num_groups, norm.eps)
        slopes.append(slope)
    prior = Gaussian(*linear[-1](h).chunk(2, -1))
    rows = linear[-1].weight.expand(len(x), -1, -1)
    for layer, slope in zip(reversed(linear[:-1]), reversed(slopes), strict=True):
        rows = _back_through(rows, *slope) @ layer.weight
    turns = rows[..., ADDED:].unflatten(-1, (22, 9)).permute(2, 0, 1, 3)  # (22, N, 96, 9)
    inputs = _rotation_inputs(x).unflatten(1, (len(x), 3))  # (22, N, 3, 9)
    omega = (turns @ inputs.mT).permute(1, 2, 0, 3).flatten(2)
    return *prior, torch.cat((rows[..., :ADDED], omega), -1)


# ------------------------------------------------------------------------------------------------ changes of states
def state_change(states: Tensor, others: Tensor) -> Tensor:
    """Computes the change (..., 210) that takes others to states (..., 339), world; of first order in rotations."""
    ours, theirs = state.heading(states), state.heading(others)
    x, y = state.localise(states, ours), state.localise(others, theirs)
    spin = x[..., ADDED:].unflatten(-1, (22, 3, 3)).mT @ y[..., ADDED:].unflatten(-1, (22, 3, 3))  # R_x R_y^T
    spin = (spin - spin.mT) / 2
    omega = torch.stack((spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]), -1)
    cross = theirs.turn @ ours.turn.mT
    angle = torch.atan2(cross[..., 1, 0], cross[..., 0, 0])
    way = (theirs.turn @ (theirs.shift - ours.shift)[..., None])[..., :2, 0]
    return torch.cat((x[..., :ADDED] - y[..., :ADDED], omega.flatten(-2), angle[..., None], way), -1)
