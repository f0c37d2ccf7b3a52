"""Stage 3 with its chain cut: a persistent sequence of states beside the latents, and short roll-outs from all of them.

Unknowns are x_{0:T}, z_{1:T} and the shape. From every state at once K transitions are decoded, and frame t of the k-th
decoded sequence is what min(k, t) steps make of the state so many frames before:

    x^k_t = f(... f(x_{t-k}, z_{t-k+1}) ..., z_t),      x^0 = x,      E = 1/(K+1) sum_k E_3(x^k) + w C(x, x^1..x^K)

with E_3 the energy of stage 3 and C the consistency. At an exact roll-out C = 0 and E = E_3.

Source: thesis 3.3.1, Figs. 3.8 and 3.9; 3.3.2 for the representation.
Differs: x is 273 numbers in the world, rotations 6 of them; what is compared are the 339 numbers of a state, rotation
matrices among them. The first k frames of the k-th sequence, which the thesis leaves out, are the roll-out from x_0.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.humor import stages, state
from motionlab.humor.evidence import Evidence
from motionlab.humor.priors import Cvae, Gaussian
from motionlab.humor.rollout import Rollout, rollout
from motionlab.humor.stages import Problem, Terms
from motionlab.humor.state import SHAPES
from motionlab.humor.unknowns import Rolled, Unknowns, rolled_from

TURNS = {"root_orient": 1, "pose_body": 21}
_SIZES = {n: 6 * TURNS[n] if n in TURNS else torch.Size(shape).numel() for n, shape in SHAPES.items()}
Unknown = Mapping[str, Tensor]


def to_persistent(states: Tensor) -> Tensor:
    """States (..., 339) as persistent ones (..., 273)."""
    parts = state.unpack(states)
    numbers = {n: rotation.matrix_to_sixd(x) if n in TURNS else x for n, x in parts.items()}
    return torch.cat([x.reshape(*states.shape[:-1], -1) for x in numbers.values()], -1)


def to_states(x: Tensor) -> Tensor:
    """Persistent states (..., 273) as states (..., 339), their rotations orthonormal."""
    parts = dict(zip(SHAPES, x.split(list(_SIZES.values()), -1), strict=True))
    turned = {n: rotation.sixd_to_matrix(parts[n].unflatten(-1, (-1, 6))).mT.flatten(-3) for n in TURNS}
    return torch.cat([turned[n] if n in TURNS else parts[n] for n in SHAPES], -1)


class Sequences(NamedTuple):
    """The decoded sequences x^1..x^K: states (B, K, T, 339), contact_logits (B, K, T - 1, 9)."""

    states: Tensor
    contact_logits: Tensor


def sequences(model: Cvae, states: Tensor, z: Tensor, steps: int = 1) -> Sequences:
    """K transitions from every state at once, sorted into sequences of T frames.

    states (B, T, 339), world; z (B, T - 1, 48). The first frame of every sequence is that of ``states``.
    """
    batch, frames = states.shape[:2]
    at = (torch.arange(frames - 1)[:, None] + torch.arange(steps)).clamp(max=frames - 2)
    found = rollout(model, states[:, :-1].flatten(0, 1), z[:, at].flatten(0, 1), with_prior=False)
    t, k = torch.arange(1, frames), torch.arange(1, steps + 1)[:, None]
    start = (t - k).clamp(min=0)
    after, logits = (x.unflatten(0, (batch, frames - 1))[:, start, t - start - 1] for x in found[:2])
    first = states[:, None, :1].expand(-1, steps, -1, -1)
    return Sequences(torch.cat((first, after), 2), logits)


@dataclass(frozen=True)
class Form:
    """Which energy. steps: K, or None for that of whole roll-outs, in which only the first state of x counts.
    detached: the consistency does not move z. weight: w, one number or one per clip (B,)."""

    steps: int | None = 1
    weight: float | Tensor = 1.0
    detached: bool = False


def terms(problem: Problem, unknown: Unknown, form: Form) -> tuple[Terms, Sequences]:
    """The weighted terms (B,) of E by name, "consistency" among them; and the decoded sequences.

    unknown: "x" (B, T, 273), "z" (B, T - 1, 48), "betas" (B, 8).
    """
    if form.steps is None:
        found, rolled = whole(problem, unknown)
        return found, Sequences(rolled.states[:, None], rolled.rollout.contact_logits[:, None])
    states, z = to_states(unknown["x"]), unknown["z"]
    decoded = sequences(problem.priors.motion, states, z, form.steps)
    every = torch.cat((states[:, None], decoded.states), 1)
    logits = torch.cat((decoded.contact_logits[:, :1], decoded.contact_logits), 1)
    found = _objective(problem, every, logits, z, unknown["betas"])
    compared = decoded
    if form.detached and z.requires_grad:
        compared = sequences(problem.priors.motion, states, z.detach(), form.steps)
    found["consistency"] = form.weight * consistency(states, compared.states)
    return found, decoded


def consistency(states: Tensor, decoded: Tensor) -> Tensor:
    """C (B,): sum of |x_t - x^k_t| over frames and the 339 numbers of a state, mean over k.

    states (B, T, 339), decoded (B, K, T, 339). Source: thesis 3.3.3, the L1 loss.
    """
    return (states[:, None] - decoded).abs().sum((-1, -2)).mean(1)


def _objective(problem: Problem, every: Tensor, logits: Tensor, z: Tensor, betas: Tensor) -> Terms:
    """The terms of stage 3, means over sequences (B, N, T, 339); the prior of z is that of the persistent states."""
    batch, count = every.shape[:2]
    prior = prior_of(problem.priors.motion, every[:, 0])
    many = replace(problem, evidence=problem.evidence.rows(torch.arange(batch).repeat_interleave(count)))
    spread = [x[:, None].expand(-1, count, -1, -1).flatten(0, 1) for x in (z, *prior)]
    rolled = Rollout(every[:, :, 1:].flatten(0, 1), logits.flatten(0, 1), spread[0], Gaussian(*spread[1:]))
    body = posed(every.flatten(0, 1), betas.repeat_interleave(count, 0), many.evidence, rolled)
    found = stages.rolled_terms(many, body)
    return {name: x.unflatten(0, (batch, count)).mean(1) for name, x in found.items()}


def prior_of(model: Cvae, states: Tensor) -> Gaussian:
    """p(z_t | x_{t-1}) of every transition, (B, T - 1, 48), of states (B, T, 339)."""
    past = states[:, :-1]
    return model.prior(state.localise(past, state.heading(past)))


def posed(states: Tensor, betas: Tensor, evidence: Evidence, rolled: Rollout | None = None) -> Rolled:
    """The body in states (B, T, 339), of people with shapes (B, 8), as a roll-out with free first states has it; a
    camera stays where it is."""
    first, rolled = states[:, 0], rolled or Rollout(states[:, 1:], None, None, None)
    rows = Unknowns(first[..., :3], first[..., :0], first[..., :0], betas=betas, camera=betas.new_zeros(len(betas), 3))
    return rolled_from(first, rolled, rows, evidence)


def whole(problem: Problem, unknown: Unknown) -> tuple[Terms, Rolled]:
    """The weighted terms (B,) of stage 3 of the exact roll-out of x_0 and z, and that roll-out: what every variant is
    judged by."""
    first = to_states(unknown["x"][:, 0])
    rolled = rollout(problem.priors.motion, first, unknown["z"])
    states = torch.cat((first[:, None], rolled.states), 1)
    body = posed(states, unknown["betas"], problem.evidence, rolled)
    return stages.rolled_terms(problem, body), body
