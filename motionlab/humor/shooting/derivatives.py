"""Computes the derivatives of transitions and of the prior, for all frames of all clips at once.

A small change of a frame is 210 numbers: its state's in its own heading frame,

    xi 207 = trans | trans_vel | root_orient_vel | joints 66 | joints_vel 66 | omega 66

where omega turns the 22 rotations from the left, R -> exp(omega) R, and gamma = (turn, x, y), how its heading frame
itself turns about z and moves on the floor, in its own axes. By autograd: networks backward, which have fewer outputs
than inputs.

Source: HuMoR (Rempe et al. 2021), the networks and ``roll_out``.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.heading import Frame
from motionlab.humor import state
from motionlab.humor.cvae import Cvae
from motionlab.humor.state import ADDED, CHANGES

XI, GAMMA, LATENTS = 207, 3, 48
CHANGE = XI + GAMMA
_ROOT = [0, 1, 2, ADDED, ADDED + 1, ADDED + 2, XI, XI + 1, XI + 2]  # of a change: trans, the root's omega, gamma
_PIECE = 16  # frames at a time, for the cache


class TransitionSlopes(NamedTuple):
    """Derivatives of frame t + 1 in z and in a small change of frame t, N transitions.

    of_change (N, 210, 210) and of_z (N, 210, 48): columns are causes. turn (N, 3, 3): from the axes of frame t to
    those of frame t + 1 (as row vectors from the right, ``transition.Step.turn``).
    """

    of_change: Tensor
    of_z: Tensor
    turn: Tensor


def decoder_slopes(model: Cvae, x: Tensor, z: Tensor) -> Tensor:
    """Computes the derivatives (N, 207, 255) of the raw changes in xi and z, of states (N, 339), latents z (N, 48)."""

    def raw(both: Tensor, x: Tensor, z: Tensor) -> Tensor:
        return model.decode(_changed(x, both), z + both[:, XI:])[:, :CHANGES]

    return _rows(raw, XI + LATENTS, x, z)


def prior_slopes(model: Cvae, x: Tensor) -> Tensor:
    """Computes the derivatives (N, 96, 207) in xi of mean and log variance of p(z | x), from states (N, 339)."""
    return _rows(lambda xi, x: torch.cat(model.prior(_changed(x, xi)), -1), XI, x)


def _rows(of: Callable[..., Tensor], count: int, *rows: Tensor) -> Tensor:
    """Jacobians (N, out, count) of what comes of N rows and of small changes of each, (N, count) and nought here."""
    found = []
    for piece in zip(*(x.split(_PIECE) for x in rows), strict=True):
        change, out = _traced(of, count, piece)
        unit = torch.eye(out.shape[1]).to(out)[:, None].expand(-1, *out.shape)
        found.append(torch.autograd.grad(out, change, unit, is_grads_batched=True)[0].transpose(0, 1))
    return torch.cat(found)


def columns(of: Callable[..., Tensor], count: int, *rows: Tensor) -> Tensor:
    """Computes the Jacobians (N, out, count) of few causes: N rows and small changes (N, count) of each -> (N, out).

    Forward, by going back twice: J^T c is linear in c.
    """
    change, out = _traced(of, count, rows)
    with torch.enable_grad():
        c = torch.zeros_like(out, requires_grad=True)
        (pulled,) = torch.autograd.grad(out, change, c, create_graph=True)
    unit = torch.eye(count).to(out)[:, None].expand(-1, *pulled.shape)
    return torch.autograd.grad(pulled, c, unit, is_grads_batched=True)[0].permute(1, 2, 0)


def _traced(of: Callable[..., Tensor], count: int, rows: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Changes of nought (N, count), and what comes of them."""
    with torch.enable_grad():
        change = rows[0].new_zeros(len(rows[0]), count, requires_grad=True)
        return change, of(change, *rows)


def _changed(x: Tensor, xi: Tensor) -> Tensor:
    """States (..., 339), own frames, after small changes (..., 207 or more), of first order in rotations."""
    m, omega = x[..., ADDED:].unflatten(-1, (22, 3, 3)), xi[..., ADDED:XI].unflatten(-1, (22, 3))
    return torch.cat((x[..., :ADDED] + xi[..., :ADDED], (m - m @ rotation.skew(omega)).flatten(-3)), -1)


def transition_slopes(model: Cvae, x: Tensor, z: Tensor, slopes: Tensor | None = None) -> TransitionSlopes:
    """Computes the derivatives of N transitions in state and z from states (N, 339), own frames, and latents z (N, 48).

    slopes: of the decoder (``decoder_slopes``), or what shall stand for them; changed in place.
    """
    raw, slopes = model.decode(x, z), decoder_slopes(model, x, z) if slopes is None else slopes
    after, _ = state.apply(x, raw)
    v, bent = raw[:, ADDED:CHANGES].unflatten(1, (22, 3)), slopes[:, ADDED:].unflatten(1, (22, 3))
    bent.copy_(rotation.left_jacobian(v) @ bent)
    slopes[:, :ADDED, :ADDED].diagonal(dim1=-2, dim2=-1).add_(1.0)
    _blocks(slopes[:, ADDED:, ADDED:XI]).add_(rotation.exp(v))  # what turns a joint before the step turns it after

    # and into the frame of the new state, which its root moves; all else is turned with that frame, or stays
    turn, few = state.heading(after).turn, torch.tensor(_ROOT, device=x.device)
    own = x.new_zeros(len(x), CHANGE, CHANGE)
    _blocks(own[:, :ADDED, :ADDED]).copy_(turn[:, None])
    own[:, ADDED:XI, ADDED:XI].diagonal(dim1=-2, dim2=-1).fill_(1.0)

    def change(part: Tensor, after: Tensor) -> Tensor:
        whole = part.new_zeros(len(part), CHANGE).index_copy(1, few, part)
        frame = Frame(rotation.rotation_about("z", -whole[:, XI]), -F.pad(whole[:, XI + 1 :], (0, 1)))
        return state_change(state.globalise(_changed(after, whole), frame), after)

    own[..., few] = columns(change, len(few), after)
    out = own[..., :XI] @ slopes
    return TransitionSlopes(torch.cat((out[..., :XI], own[..., XI:]), -1), out[..., XI:], turn.mT)


def _blocks(x: Tensor) -> Tensor:
    """The 3 x 3 blocks on the diagonal of matrices (N, 3 k, 3 k): a view (N, k, 3, 3)."""
    return x.unflatten(2, (-1, 3)).unflatten(1, (-1, 3)).diagonal(dim1=1, dim2=3).movedim(-1, 1)


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
