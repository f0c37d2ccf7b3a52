"""The roll-out as the official code does it: part by part, step by step, with its epsilons and its costs.

The same numbers as ``rollout.rollout`` up to the epsilons, and the reference for what that one saves. Kept as there: a
dict of small tensors per step; every part turned on its own, into the frame of the next step and back into that of the
first state; rotations by Rodrigues' formula with the angle |v + 1e-8|; the heading by acos of a guarded cosine; the
prior evaluated inside the loop, also when z is given. Whether the networks' weights get gradients, as they do in the
official fits, is the caller's choice: ``model.frozen()`` or not.

Differs: a model's ``skip``, where it has one, is added to what the decoder says.

Source: behaviour of the official HuMoR code (Rempe et al. 2021) at its last public version, written anew from golden
arrays; float64 values and gradients agree to rounding (``tests/test_humor_parity.py``).
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from motionlab.humor.priors import Cvae, Gaussian, Mlp
from motionlab.humor.rollout import Rollout
from motionlab.humor.state import DELTA_SHAPES, DELTA_SLICES, SHAPES, STATE, TURNED, unpack
from studies.official.rotation import alignment, axis_angle_to_matrix

State = dict[str, Tensor]  # parts (B, 1, D), each flat


def split(packed: Tensor) -> State:
    """Packed states (B, 339) as flat parts (B, 1, D), rotations row by row, not transposed."""
    return _parts(packed[:, None])


def _parts(packed: Tensor) -> State:
    """Packed states (B, T, 339) as flat parts (B, T, D)."""
    return {name: part.flatten(-len(SHAPES[name])) for name, part in unpack(packed).items()}


def _join(parts: State) -> Tensor:
    turned = {name: parts[name].unflatten(-1, (-1, 3, 3)).mT.flatten(-3) for name in TURNED}
    return torch.cat([turned[name] if name in TURNED else parts[name] for name in SHAPES], dim=-1)


def _turn(turn: Tensor, vectors: Tensor) -> Tensor:
    """Every 3-vector of (B, 1, 3 n) by a rotation (B, 3, 3)."""
    batch, steps, size = vectors.shape
    columns = vectors.reshape(batch, steps, size // 3, 3, 1)
    return torch.matmul(turn[:, None, None], columns).reshape(batch, steps, size)


def _move(parts: State, turn: Tensor, shift: Tensor, offset: Tensor) -> State:
    """World parts into a frame: turn (B, 3, 3), shift (B, 3), offset (B, 1, 1, 3)."""
    joints = parts["joints"].reshape(*parts["joints"].shape[:2], -1, 3)
    joints = (joints + shift[:, None, None] + offset).reshape(parts["joints"].shape)
    moved = _turn(turn, joints).reshape(*joints.shape[:2], -1, 3) - offset
    return _move_rest(parts, turn) | {
        "trans": _turn(turn, parts["trans"] + shift[:, None]),
        "joints": moved.reshape(joints.shape),
    }


def _move_back(parts: State, turn: Tensor, shift: Tensor, offset: Tensor) -> State:
    """The inverse of :func:`_move`."""
    back = turn.transpose(1, 2)
    joints = parts["joints"].reshape(*parts["joints"].shape[:2], -1, 3)
    turned = _turn(back, (joints + offset).reshape(parts["joints"].shape)).reshape(joints.shape)
    return _move_rest(parts, back) | {
        "trans": _turn(back, parts["trans"]) - shift[:, None],
        "joints": (turned - offset - shift[:, None, None]).reshape(parts["joints"].shape),
    }


def _move_rest(parts: State, turn: Tensor) -> State:
    root = parts["root_orient"].reshape(*parts["root_orient"].shape[:2], 3, 3)
    turned = {name: _turn(turn, parts[name]) for name in ("trans_vel", "root_orient_vel", "joints_vel")}
    return parts | turned | {"root_orient": torch.matmul(turn[:, None], root).reshape(parts["root_orient"].shape)}


def _trans_to_joint(parts: State) -> Tensor:
    """Minus the horizontal way from ``trans`` to the pelvis, (B, 1, 1, 3)."""
    trans, pelvis = parts["trans"][:, 0], parts["joints"][:, 0, :3]
    way = torch.cat((pelvis[:, :2] - trans[:, :2], torch.zeros_like(trans[:, 2:])), dim=1)
    return -way[:, None, None]


def _frame(parts: State, align: Callable[[Tensor], Tensor] = alignment) -> tuple[Tensor, Tensor]:
    """The turn of the heading (B, 3, 3), and the shift (B, 3) that puts ``trans`` above the origin."""
    trans = parts["trans"][:, 0]
    shift = torch.cat((-trans[:, :2], torch.zeros_like(trans[:, 2:])), dim=1)
    return align(parts["root_orient"][:, 0].reshape(-1, 3, 3)), shift


def _run(net: Mlp, x: Tensor) -> Tensor:
    """A network layer by layer, (N, inputs) -> (N, outputs), whatever ``Mlp`` itself does to be fast."""
    skip = x[:, x.shape[1] - net.again :]
    for i, layer in enumerate(net.net):
        if isinstance(layer, nn.GroupNorm):
            x = nn.functional.group_norm(x, layer.num_groups, layer.weight, layer.bias, layer.eps)
        else:
            x = layer(torch.cat((x, skip), dim=1) if i and net.again and isinstance(layer, nn.Linear) else x)
    return x


def _apply(parts: State, raw: Tensor) -> tuple[State, Tensor]:
    """The next state: sums, and rotations of the delta from the left; contact logits (B, 1, 9)."""
    delta = {name: raw[..., DELTA_SLICES[name]].unflatten(-1, shape) for name, shape in DELTA_SHAPES.items()}
    after = {}
    for name, now in parts.items():
        if name in ("root_orient", "pose_body"):
            turn = axis_angle_to_matrix(delta[name].reshape(-1, 3)).reshape(len(raw), 1, -1, 3, 3)
            after[name] = torch.matmul(turn, now.reshape(turn.shape)).reshape(now.shape)
        else:
            after[name] = now + delta[name].reshape(now.shape)
    return after, delta["contacts"][:, None]


def rollout(
    model: Cvae, first: Tensor, z: Tensor | None, *, steps: int | None = None, canonical: bool = False,
    align: Callable[[Tensor], Tensor] = alignment, prior_inside: bool = True,
) -> Rollout:  # fmt: skip
    """T transitions from first (B, 339), one after the other; arguments and result as ``rollout.rollout``.

    z: (B, T, 48), or None for the prior's mean in each of ``steps``. canonical: ``first`` is in its own heading frame
    already. align, prior_inside: not as the official code does it, for ``shared.savings``: another rotation (B, 3, 3)
    into the heading frame; the prior for all steps at once, after them (z must be given).
    """
    steps = steps if z is None else z.shape[1]
    parts = split(first)
    world = (*_frame(parts, align), _trans_to_joint(parts))
    if not canonical:
        parts = _move(parts, *world)
    offset = _trans_to_joint(parts | {"trans": torch.zeros_like(parts["trans"])})  # it is above the origin
    turn = torch.eye(3, dtype=first.dtype, device=first.device).expand(len(first), 3, 3)
    shift = first.new_zeros(len(first), 3)
    states, logits, latents, priors, pasts = [], [], [], [], []
    for t in range(steps):
        past = _join(parts)[:, 0]
        pasts.append(past)
        if prior_inside:
            prior = Gaussian(*_run(model.prior_net, past).chunk(2, dim=-1))
            priors.append(prior)
        now = prior.mean if z is None else z[:, t]
        raw = _run(model.decoder, torch.cat((past, now), dim=-1))
        after, contacts = _apply(parts, raw if model.skip is None else raw + model.skip(past))
        # the new state in the frame of the first one, and in its own for the next step
        states.append(_join(_move_back(after, turn, shift, offset)))
        logits.append(contacts), latents.append(now)
        next_turn, next_shift = _frame(after, align)
        parts = _move(after, next_turn, next_shift, offset)
        shift = shift + torch.matmul(turn.transpose(1, 2), next_shift[..., None])[..., 0]
        turn = torch.matmul(next_turn, turn)
    found = torch.cat(states, dim=1)
    if not canonical:
        found = _join(_move_back(_parts(found), *world))
    inside = Gaussian(*(torch.stack(x, dim=1) for x in zip(*priors, strict=True))) if prior_inside else None
    prior = inside or model.prior(torch.stack(pasts, dim=1))
    return Rollout(found, torch.cat(logits, dim=1), torch.stack(latents, dim=1), prior)


def infer(model: Cvae, states: Tensor) -> tuple[Gaussian, Gaussian]:
    """Posterior and prior (B, T - 1, 48) of every transition of world states (B, T, 339), as ``rollout.infer``."""
    batch, frames = states.shape[:2]
    offset = _trans_to_joint(split(states[:, 0])).repeat_interleave(frames - 1, 0)
    past, now = split(states[:, :-1].reshape(-1, STATE)), split(states[:, 1:].reshape(-1, STATE))
    frame = _frame(past)
    past, now = (_join(_move(parts, *frame, offset))[:, 0].unflatten(0, (batch, -1)) for parts in (past, now))
    return model.posterior(past, now), model.prior(past)
