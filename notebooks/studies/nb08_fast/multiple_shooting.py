"""Stage 3 by multiple shooting: states and latents are unknowns both, and the dynamics begin soft.

It starts from stage 2's motion, which meets what was seen already, and the posterior's latents; a roll-out of these
starts wherever its first frames lead. Each iteration differentiates all T transitions in one batch, and finds the least
of

    the Gauss-Newton model of the merit (``free_states``)   along   y_t = A_t y_{t-1} + B_t dz_t + e_t

by one Riccati sweep with controls dz_t and e_t, the latter held by rho W; gradients are exact. The step is walked by a
feedback roll-out, x_t = f(x_{t-1}, z_t) + c_t + e_t, so that gaps become what the sweep made of them, however bent f
is: with x_t + y_t instead, steps shrink as rho grows. Levenberg and Marquardt's damping and the length of the step
are each clip's own. rho grows from iteration to iteration; at the end an exact roll-out is steered along the states by
the last gains, and ``shooting.solver.solve`` can finish it.

Source: thesis 3.3.4 (open); Bock and Plitt 1984 (multiple shooting); Mastalli et al. 2020 (feedback roll-outs with
gaps); Nocedal and Wright 2006, chapter 17 (multipliers).
Differs: changes live in the tangent space of ``shooting.derivatives``; the first state keeps its own unknowns and has
no gap.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab.errors import NotConverged, ShapeError, check_shape
from motionlab.heading import Frame
from motionlab.humor import energies, state
from motionlab.humor.rollout import infer
from motionlab.humor.shooting import coordinates, derivatives, gauss_newton
from motionlab.humor.shooting.derivatives import CHANGE, LATENTS, XI, own_frames, own_state_change
from motionlab.humor.stages import Problem, motion_terms
from motionlab.humor.transition import DecoderLayers
from motionlab.humor.unknowns import Unknowns, first_state
from studies.nb08_fast.affine_sweep import Affine, affine_sweep
from studies.nb08_fast.free_states import (
    DEVIATION,
    Measured,
    Penalty,
    Point,
    Slopes,
    derived,
    freedom,
    measured,
    merit,
    retracted,
)

#: Lengths of a step that are tried, and what each makes of the damping; one that fails makes ten times of it.
LENGTHS = {1.0: 0.2, 0.4: 1.0, 0.15: 3.0}
_INFORMATION = 0.75 * 0.5  # of log sigma^2, beside the loop's: free states feel all of Fisher's


@dataclass(frozen=True)
class Plan:
    """How much work.

    stiffness: rho of every iteration, in turn, where 1 weighs a whitened gap as the prior weighs a whitened latent.
    multipliers: with lambda += rho W c wherever rho grows. damping: of the first iteration. attempts: sweeps of an
    iteration at most, while some clip finds no lower merit. stride: frames between those at which the networks are
    differentiated.
    """

    stiffness: tuple[float, ...] = (0.1, 0.1, 1.0, 1.0, 10.0, 10.0, 100.0, 100.0)
    multipliers: bool = False
    damping: float = 1e-2
    attempts: int = 3
    stride: int = 1

    def __post_init__(self) -> None:
        if min(self.attempts, self.stride) < 1 or not all(rho > 0 for rho in self.stiffness) or not self.stiffness:
            raise ValueError(f"stiffness, attempts and stride: expected some, above nought, got {self}")


@dataclass
class Report:
    """Before each iteration and after the last: E (B,) of the free states, whitened root mean square gaps (B,), and
    the seconds until then by ``clock``. linearised: seconds of all Gauss-Newton models. end (B,): energies of the exact
    roll-out at the end."""

    energies: list[Tensor] = field(default_factory=list)
    gaps: list[Tensor] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    linearised: list[float] = field(default_factory=list)
    end: Tensor | None = None
    clock: Callable[[], float] = time.perf_counter
    began: float = 0.0

    def note(self, found: Measured) -> None:
        """What an iteration starts from."""
        white = found.gaps / torch.tensor(DEVIATION).to(found.gaps)
        self.energies.append(found.energy), self.gaps.append(white.square().mean((1, 2)).sqrt())
        self.seconds.append(self.clock() - self.began)

    def timed(self, model: Callable[..., Model], *given) -> Model:
        """A Gauss-Newton model, its seconds noted."""
        began, found = self.clock(), model(*given)
        self.linearised.append(self.clock() - began)
        return found


def start(
    problem: Problem, unknown: Unknowns, states: Tensor, plan: Plan | None = None, report: Report | None = None
) -> dict[str, Tensor]:
    """Unknowns (B, 1, ...) of an exact roll-out, from those of stage 3's start and the states (B, T, 339) of stage 2.

    The first state and what is shared begin as they are in ``unknown``, z at the posterior's means of ``states``. A
    clip whose roll-out ends above the energy of ``unknown`` keeps that.

    Raises:
        ShapeError: recordings in several windows, of one frame, or states that do not fit them.
        NotConverged: no clip has a finite merit.
    """
    plan, report = plan or Plan(), report or Report()
    report.began = report.clock()
    point, kept = _begun(problem, unknown, states), unknown.map(lambda x: x.detach().clone())
    penalty, damping = Penalty.of(problem, point), point.states.new_full((len(states),), plan.damping)
    for rho in plan.stiffness:
        if plan.multipliers and 0 < penalty.rho < rho:
            penalty = penalty.raised(measured(problem, point).gaps)
        penalty = penalty._replace(rho=rho)
        slope, found, before = derived(problem, point, penalty)
        report.note(found)
        if not before.isfinite().any():
            raise NotConverged("no clip has a finite merit", before.tolist())
        model = report.timed(modelled, problem, point, found, plan.stride)
        point, damping = _lower(problem, point, model, slope, found, before, penalty, damping, plan)
    return _exact(problem, point, kept, penalty, damping, plan, report)


def _begun(problem: Problem, unknown: Unknowns, states: Tensor) -> Point:
    frames = check_shape(states, f"B T {state.STATE}", "states")["T"]
    if unknown.z.shape[1] != 1:
        raise ShapeError(f"z: expected one window per recording, got {unknown.z.shape[1]}")
    if frames < 2 or unknown.z.shape[0] != len(states) or unknown.z.shape[2] != frames - 1:
        raise ShapeError(f"states: expected {unknown.z.shape[2] + 1} frames, 2 or more, got {tuple(states.shape)}")
    with torch.no_grad():
        z = infer(problem.priors.motion, states)[0].mean
    return Point(replace(unknown.detached(), z=z[:, None]), states[:, 1:].detach())


@torch.no_grad()
def _lower(
    problem: Problem, point: Point, model: Model, slope: Slopes, found: Measured, before: Tensor, penalty: Penalty,
    damping: Tensor, plan: Plan,
) -> tuple[Point, Tensor]:  # fmt: skip
    """The length of a step that lowers the merit most, clip by clip; and the damping (B,) of the next."""
    best, value = point, before
    for _ in range(plan.attempts):
        way = swept(problem, point, model, slope, penalty, damping)
        waits, factor = value >= before, torch.full_like(before, 10.0)
        for length, new in zip(LENGTHS, steered(problem, point, model, way, found.gaps, tuple(LENGTHS)), strict=True):
            now = merit(problem, new, penalty)
            good = waits & (now < value)
            best, value = new.where(good, best), torch.where(good, now, value)
            factor = torch.where(good, LENGTHS[length], factor)
        damping = torch.where(waits, factor * damping, damping)
        if not (value >= before).any():
            break
    return best, damping


@torch.no_grad()
def _exact(
    problem: Problem,
    point: Point,
    kept: Unknowns,
    penalty: Penalty,
    damping: Tensor,
    plan: Plan,
    report: Report,
) -> dict[str, Tensor]:
    """The lowest exact roll-out of those steered along the states, with all, half and nothing of a last step."""
    slope, found, _ = derived(problem, point, penalty)
    report.note(found)
    model = report.timed(modelled, problem, point, found, plan.stride)
    way = swept(problem, point, model, slope, penalty, damping)
    best, value = Point(kept, point.states), sum(motion_terms(problem, kept).values())
    for new in steered(problem, point, model, way, None, (1.0, 0.5, 0.0)):
        now = sum(motion_terms(problem, new.unknown).values())
        good = (now < value) | (value.isnan() & now.isfinite())
        best, value = new.where(good, best), torch.where(good, now, value)
    report.end = value
    return best.unknown


# ------------------------------------------------------------------------------------------------------- the iteration
class Model(NamedTuple):
    """The Gauss-Newton model around free states, B clips: what ``affine_sweep`` takes.

    of_frame (B, T, n, n). a (B, T - 1, n, n), b (B, T - 1, n, 48), free (B, T - 1, n, 207): what e may be. before,
    after (B, T - 1, k, n): rows of neighbours. toward (B, T - 1, 144, n + 48): the prior's.
    """

    of_frame: Tensor
    a: Tensor
    b: Tensor
    free: Tensor
    before: Tensor
    after: Tensor
    toward: Tensor


@torch.no_grad()
def modelled(problem: Problem, point: Point, found: Measured, stride: int) -> Model:
    """Computes the model as ``coordinates.linearised`` does, around states that need not follow from each other."""
    unknown, z, model = point.unknown, point.unknown.z[:, 0], problem.priors.motion
    clips, frames = z.shape[0], z.shape[1] + 1
    x, frame = own_frames(point.all_states(problem))
    past, keys = x[:, :-1], coordinates.key_frames(frames - 1, stride).to(z.device)
    some, spread = past[:, keys].flatten(0, 1), partial(coordinates.between_keys, keys=keys, clips=clips)
    decoder = DecoderLayers.of(model)
    decoded = spread(derivatives.decoder_slopes(decoder, some, z[:, keys].flatten(0, 1)))
    moves = derivatives.transition_slopes(decoder, past.flatten(0, 1), z.flatten(0, 1), decoded)
    weights = problem.weights.of(3, frames=frames)
    rows = gauss_newton.residual_rows(
        x, frame.turn, frame.shift, frame.turn[:, :-1] @ frame.turn[:, 1:].mT, unknown.betas, unknown.camera,
        energies.contact_probabilities(found.logits), problem.evidence, weights,
    )  # fmt: skip
    n = rows.of_frame.shape[-1]
    a, b = coordinates.padded_moves(moves, clips, n)
    bend = spread(derivatives.prior_slopes(model, some)[1])
    pull = weights.get("motion_prior", 0.0)
    toward = coordinates.prior_rows(z.flatten(0, 1), found.prior, bend, n, pull)
    bent = F.pad((_INFORMATION * pull) ** 0.5 * bend[:, LATENTS:], (0, toward.shape[-1] - XI))
    toward = torch.cat((toward, bent), 1)
    of_frame = rows.of_frame.mT @ rows.of_frame
    return Model(of_frame, a, b, freedom(x[:, 1:], n), rows.before, rows.after, toward.unflatten(0, (clips, -1)))


class Way(NamedTuple):
    """Where the model is least: the change (B, f) of the first state and what is shared, and the sweep, whose controls
    are dz 48 and e 207."""

    change: Tensor
    swept: Affine


@torch.no_grad()
def swept(problem: Problem, point: Point, model: Model, slope: Slopes, penalty: Penalty, damping: Tensor) -> Way:
    """One sweep; damping (B,) of whitened changes of states and of z, in units of the prior's weight."""
    frames, shared = model.of_frame.shape[1], model.a.shape[-1] - CHANGE
    white = F.pad(penalty.white, (0, shared))
    weights = problem.weights.of(3, frames=frames)
    b = torch.cat((model.b, model.free), -1)
    pairs = torch.cat((model.after @ model.a + model.before, model.after @ b), -1)
    rows = torch.cat((pairs, F.pad(model.toward, (0, pairs.shape[-1] - model.toward.shape[-1]))), -2)
    held = b.new_zeros(*b.shape[:2], b.shape[-1], b.shape[-1])
    held.diagonal(dim1=-2, dim2=-1)[..., :LATENTS] = (damping * weights.get("motion_prior", 0.0) + 1e-6)[:, None, None]
    held[..., LATENTS:, LATENTS:] = model.free.mT @ (penalty.rho * white[:, None] * model.free)
    of_frame = model.of_frame + damping[:, None, None, None] * torch.diag(white)
    along, of_z = F.pad(slope.y, (0, shared, 1, 0)), F.pad(slope.z, (0, b.shape[-1] - LATENTS))
    found = affine_sweep(of_frame, model.a, b, rows, held, along, of_z)
    shaper, *_ = coordinates.first_shaper(problem, point.unknown, found.first, frames)
    first = coordinates.first_slopes(problem, point.unknown, shaper.shape[-1])  # (B, n, f)
    down = slope.first + (found.slope[:, None] @ first)[:, 0]
    return Way(-(shaper @ (shaper.mT @ down[..., None]))[..., 0], found)


@torch.no_grad()
def steered(
    problem: Problem, point: Point, model: Model, way: Way, gaps: Tensor | None, lengths: tuple[float, ...]
) -> list[Point]:
    """Feedback roll-outs, one for each length: after so much of the first state's change, with y what x is from x^,

    (dz, e) = length k + K y,    z = z^ + dz,    x' = f(x, z) moved by c + e;    without gaps x' = f(x, z).
    """
    net, share = problem.priors.motion, point.states.new_tensor(lengths)[:, None, None]
    change = share * way.change  # (L, B, f)
    unknowns = [coordinates.moved(point.unknown, each) for each in change]
    now = torch.stack([first_state(each, problem.priors) for each in unknowns])
    offsets, shared = share[..., None] * way.swept.offsets, change[..., sum(coordinates.FIRST_SIZES.values()) :]
    old, found = own_frames(point.all_states(problem)), ([], [])
    for t, z in enumerate(point.unknown.z[:, 0].unbind(1)):
        x, frame = own_frames(now)
        y = own_state_change(x, frame, old[0][:, t], Frame(old[1].turn[:, t], old[1].shift[:, t]))
        u = offsets[:, :, t] + (way.swept.gains[:, t] @ torch.cat((y, shared), -1)[..., None])[..., 0]
        z, local = z + u[..., :LATENTS], x
        now = state.globalise(state.apply(local, net.decode(local, z))[0], frame)
        if gaps is not None:
            now = retracted(now, gaps[:, t] + (model.free[:, t] @ u[..., LATENTS:, None])[..., :CHANGE, 0])
        found[0].append(z), found[1].append(now)
    z, states = (torch.stack(each, 2) for each in found)
    return [Point(replace(each, z=z[k][:, None]), states[k]) for k, each in enumerate(unknowns)]
