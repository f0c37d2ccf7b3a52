"""Stage 3's energy of states that need not follow from each other, and the gaps that they leave.

    c_t = x_t - f(x_{t-1}, z_t),        merit = E(x_{0:T}, z_{1:T}) + sum_t  rho / 2 |c_t|^2_W + lambda_t . c_t

in the changes of ``shooting.derivatives``: 210 numbers, a state's in its own heading frame and how that frame itself
moves, with rotations in their tangent space. W whitens one-step residuals. Where all gaps are nought, E is that of the
roll-out.

Source: Bock and Plitt 1984 (multiple shooting); Nocedal and Wright 2006, chapter 17 (penalties, multipliers).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.heading import Frame
from motionlab.humor import state, unknowns
from motionlab.humor.body_shape import BETAS
from motionlab.humor.cvae import Gaussian
from motionlab.humor.rollout import Rollout
from motionlab.humor.shooting import coordinates
from motionlab.humor.shooting.derivatives import CHANGE, GAMMA, XI, own_frames, state_change
from motionlab.humor.stages import Problem, rolled_terms
from motionlab.humor.state import ADDED
from motionlab.humor.unknowns import Unknowns

#: Standard deviations of a change: root mean squares of what the posterior's mean misses in one step of exact motion
#: (six practice clips), not below 1e-3; trans, its velocity, the root's, joints, theirs, omega root and body, gamma.
DEVIATION = (
    *(1e-3,) * 3, *(3e-3,) * 3, *(8e-3,) * 3, *(1e-3,) * 66, *(1.7e-2,) * 66, *(1e-3,) * 3, *(3.6e-3,) * 63,
    *(1e-3,) * 3,
)  # fmt: skip
_PITCH, _YAW = ADDED, ADDED + 2  # of the root's omega: about x, about z
#: Of the 210 numbers of a change those that are free: a state stands above the origin of its own frame and faces +y.
KEPT = torch.tensor([k for k in range(CHANGE) if k not in (0, 1, _YAW)])


class Point(NamedTuple):
    """Unknowns (B, 1, ...) of the first state, z and what is shared; world states (B, T - 1, 339) of later frames."""

    unknown: Unknowns
    states: Tensor

    def moved(self, first: Tensor, y: Tensor, dz: Tensor) -> Point:
        """After changes (B, f) of the first state and what is shared, (B, T - 1, 210) of states, and of z."""
        at = coordinates.moved(self.unknown, first)
        return Point(replace(at, z=at.z + dz[:, None]), retracted(self.states, y))

    def where(self, kept: Tensor, other: Point) -> Point:
        """This one's clips where kept (B,), else the other's."""

        def pick(ours: Tensor, theirs: Tensor) -> Tensor:
            return torch.where(kept.reshape(-1, *(1,) * (ours.ndim - 1)), ours, theirs)

        theirs = other.unknown.named()
        unknown = {n: pick(x, theirs[n]) for n, x in self.unknown.named().items()}
        return Point(Unknowns(**unknown), pick(self.states, other.states))

    def all_states(self, problem: Problem) -> Tensor:
        """(B, T, 339), the first one in front."""
        return torch.cat((unknowns.first_state(self.unknown, problem.priors)[:, None], self.states), 1)


def retracted(states: Tensor, y: Tensor) -> Tensor:
    """World states (..., 339) after small changes (..., 210); rotations stay rotations."""
    x, frame = own_frames(states)
    turned = x[..., ADDED:].unflatten(-1, (22, 3, 3)) @ rotation.exp(y[..., ADDED:XI].unflatten(-1, (22, 3))).mT
    x = torch.cat((x[..., :ADDED] + y[..., :ADDED], turned.flatten(-3)), -1)
    way = (frame.turn.mT @ F.pad(y[..., XI + 1 : XI + GAMMA], (0, 1))[..., None])[..., 0]
    placed = Frame(rotation.rotation_about("z", -y[..., XI]) @ frame.turn, frame.shift - way)
    return state.globalise(x, placed)


def freedom(x: Tensor, n: int) -> Tensor:
    """Changes (..., n, 207) that leave states (..., 339) in their own heading frames: where the root turns about x, it
    turns about z with it, by the slope of its right axis, whose part on the floor is along x."""
    right = -x[..., ADDED : ADDED + 3]
    out, columns = x.new_zeros(*x.shape[:-1], n, len(KEPT)), torch.arange(len(KEPT))
    out[..., KEPT, columns] = 1.0
    out[..., _YAW, int((KEPT == _PITCH).nonzero())] = right[..., 2] / right[..., :2].norm(dim=-1).clamp(min=1e-9)
    return out


class Measured(NamedTuple):
    """E (B,) and the gaps c (B, T - 1, 210); contact logits and the prior of every transition."""

    energy: Tensor
    gaps: Tensor
    logits: Tensor
    prior: Gaussian


def measured(problem: Problem, point: Point) -> Measured:
    """Every term as ``stages.rolled_terms`` has it; contacts and prior are what each state alone leads to."""
    z, past = point.unknown.z[:, 0], point.all_states(problem)[:, :-1]
    frame = state.heading(past)
    local = state.localise(past, frame)
    after, logits = state.apply(local, problem.priors.motion.decode(local, z))
    rollout = Rollout(point.states, logits, z, problem.priors.motion.prior(local))
    rolled = unknowns.rolled_from(past[:, 0], rollout, point.unknown, problem.evidence)
    energy = sum(rolled_terms(problem, point.unknown, rolled).values())
    return Measured(energy, state_change(point.states, state.globalise(after, frame)), logits, rollout.prior)


class Penalty(NamedTuple):
    """white (210,): w W, in the energy's units; rho; multipliers lambda (B, T - 1, 210)."""

    white: Tensor
    rho: float
    multipliers: Tensor

    @classmethod
    def of(cls, problem: Problem, point: Point) -> Penalty:
        """Of a whitened gap beside a whitened latent: w is the motion prior's weight, 1 where that is 0. As yet no
        multipliers."""
        deviation = torch.tensor(DEVIATION).to(point.states)
        weight = problem.weights.of(3).get("motion_prior", 0.0) or 1.0
        return cls(weight / deviation.square(), 0.0, torch.zeros_like(point.states[..., :CHANGE]))

    def cost(self, gaps: Tensor) -> Tensor:
        """rho / 2 |c|^2_W + lambda . c, (B,)."""
        return (gaps * (0.5 * self.rho * self.white * gaps + self.multipliers)).sum((1, 2))

    def raised(self, gaps: Tensor) -> Penalty:
        """With lambda += rho W c: what pulls at the gaps now does so also where there are none."""
        return self._replace(multipliers=(self.multipliers + self.rho * self.white * gaps).detach())


def merit(problem: Problem, point: Point, penalty: Penalty) -> Tensor:
    """(B,): what an iteration lowers."""
    found = measured(problem, point)
    return found.energy + penalty.cost(found.gaps)


class Slopes(NamedTuple):
    """Gradients of the merit: of the first state and what is shared (B, f), of changes (B, T - 1, 210), of z."""

    first: Tensor
    y: Tensor
    z: Tensor


def derived(problem: Problem, point: Point, penalty: Penalty) -> tuple[Slopes, Measured, Tensor]:
    """Exact gradients, by autograd at the free states, what was measured there, and the merit (B,)."""
    view, clips = problem.evidence.view, len(point.states)
    count = sum(coordinates.FIRST_SIZES.values()) + BETAS + (3 if view is not None and view.free else 0)
    nothing = (point.states.new_zeros(clips, count), torch.zeros_like(point.states[..., :CHANGE]))
    leaves = [x.requires_grad_() for x in (*nothing, torch.zeros_like(point.unknown.z[:, 0]))]
    with torch.enable_grad():
        found = measured(problem, point.moved(*leaves))
        value = found.energy + penalty.cost(found.gaps)
        slopes = Slopes(*torch.autograd.grad(value.sum(), leaves))
    prior = Gaussian(*(x.detach() for x in found.prior))
    return slopes, Measured(found.energy.detach(), found.gaps.detach(), found.logits.detach(), prior), value.detach()
