"""Stage 3 by several solvers from the same stage 2: what each has found after how much processor time.

All lower the same energy, that of an exact roll-out (``stages.motion_terms``), in the same unknowns. Below: what
becomes of one nudge of one latent, in a plain roll-out and in one that steers itself.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from motionlab.humor import coordinates, feedback_solver, stages, testops, unknowns
from motionlab.humor import start as starts
from motionlab.humor.energies import Weights
from motionlab.humor.evidence import evidence
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import steered_rollout
from motionlab.humor.stages import Problem
from motionlab.humor.testops import Schedule
from motionlab.humor.unknowns import FIRST, Unknowns
from motionlab.motion import Motion
from motionlab.observation import Camera
from motionlab.optimise import minimise_batch

CM = 100.0
clock = time.process_time


@dataclass(frozen=True, eq=False)
class Task:
    """B clips of T frames at the end of stage 2.

    unknown, factors: of ``start.start_stage_3``. latent (B, T, 32): pose latents of stage 2. truth, rough: motions
    (B, T), the true one and stage 2's. seen (B, T, 22): the judge's mask of joints in view. seconds: processor time of
    stages 1 and 2.
    """

    name: str
    problem: Problem
    unknown: Unknowns
    factors: Tensor | None
    latent: Tensor
    truth: Motion
    rough: Motion
    seen: Tensor
    seconds: float = 0.0

    def rows(self, index: Sequence[int] | Tensor) -> Self:
        """Some clips, in the order of ``index``."""
        at = torch.as_tensor(index)
        return replace(
            self, problem=self.problem.rows(at), unknown=self.unknown.rows(at), factors=self.factors[at],
            latent=self.latent[at], truth=self.truth.clip(at), rough=self.rough.clip(at), seen=self.seen[at],
        )  # fmt: skip

    def begun(self, eager: float, trust: Tensor | None = None) -> Self:
        """The same at another start (``start.start_stage_3``), joints believed as the evidence has them or as told."""
        trust = self.problem.evidence.confidence_per_joint if trust is None else trust
        how = (trust, self.problem.priors, "lean", self.problem.weights.pull, eager)
        start, factors = starts.start_stage_3(self.rough, self.latent, self.unknown.shared(), *how)
        return replace(self, unknown=start.detached(), factors=factors)

    def energy(self, unknown: Unknowns) -> Tensor:
        """Stage 3's energy (B,) of unknowns, by a roll-out of their z."""
        with torch.no_grad():
            return sum(stages.motion_terms(self.problem, unknown).values())

    def motion(self, unknown: Unknowns) -> Motion:
        """What unknowns roll out to."""
        with torch.no_grad():
            body = unknowns.roll(unknown, self.problem.priors, self.problem.evidence).body
        return unknowns.motion_of(body, self.problem.evidence.fps)

    def error(self, motion: Motion) -> Tensor:
        """Mean distance of all joints from the true ones in the world (B,), cm."""
        return CM * (motion.positions - self.truth.positions).norm(dim=-1).mean((-1, -2))

    @property
    def nat(self) -> float:
        """Energy of one nat a frame: the prior's weight times the frames."""
        return self.problem.weights.of(3, frames=self.truth.frames)["motion_prior"] * self.truth.frames


def prepare(
    name: str, observation, priors: Priors, weights: Weights, truth: Motion, *,
    cameras: Sequence[Camera] | None = None, schedule: Schedule | None = None, seen: Tensor | None = None,
) -> Task:  # fmt: skip
    """Stages 1 and 2 and the calm start of stage 3, in lean mode, for clips with their truth."""
    began, schedule = clock(), schedule or Schedule.lean()
    views = evidence(observation, cameras=cameras)
    problem = Problem(views, priors, weights)
    unknown = testops.start_stage_1(problem)
    work = {"inner": schedule.inner, "tolerance": schedule.tolerance}
    for stage in (1, 2):
        unknown, _ = stages.stage_1_and_2(problem, unknown, stage, steps=schedule.steps[stage - 1], **work)
    with torch.no_grad():
        rough = unknowns.motion_of(unknowns.pose(unknown, priors, views), views.fps)
    unknown = unknown.detached()
    seen = torch.ones(truth.positions.shape[:-1], dtype=torch.bool) if seen is None else seen
    spent = clock() - began
    task = Task(name, problem, unknown, None, unknown.latent, truth, rough, seen, spent)
    return task.begun(starts.DAMPING_SHOOTING)


@dataclass(frozen=True, eq=False)
class Run:
    """What a solver did to one clip: lowest energies (N,) so far, and the processor seconds (N,) when each was known.

    kept: what it had by so many seconds, the last at the end. spent: in all.
    """

    energies: Tensor
    seconds: Tensor
    kept: list[tuple[float, Unknowns]]
    spent: float

    @property
    def end(self) -> float:
        """The lowest energy."""
        return self.energies[-1].item()

    def until(self, energy: float) -> float:
        """Seconds until the energy was as low; infinite where it never was."""
        low = self.energies <= energy
        return self.seconds[low.double().argmax()].item() if low.any() else float("inf")

    def at(self, seconds: float) -> Unknowns:
        """What it had after so many seconds; its start, before."""
        return [u for k, (now, u) in enumerate(self.kept) if now <= seconds or k == 0][-1]


@dataclass
class Log:
    """Keeps the lowest energy and its unknowns; what it does itself costs the contender microseconds."""

    began: float = field(default_factory=clock)
    energies: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    kept: list[tuple[float, Unknowns]] = field(default_factory=list)

    def note(self, found: Tensor, unknown: Unknowns) -> None:
        """An energy (1,) of the clip."""
        low = found.detach().nan_to_num(torch.inf, torch.inf, torch.inf).item()
        best = self.energies[-1] if self.energies else torch.inf
        self.energies.append(min(best, low))
        self.seconds.append(clock() - self.began)
        if low < best:
            self.kept.append((self.seconds[-1], unknown.detached()))

    def run(self) -> Run:
        """The whole run."""
        return Run(torch.tensor(self.energies), torch.tensor(self.seconds), self.kept, clock() - self.began)


@dataclass(frozen=True)
class Single:
    """How single shooting searches: iterations of its three parts (the first 15 frames; all, the first state frozen,
    without contacts; everything), pairs that L-BFGS remembers, and what share of the prior its start has. The default
    is that of ``testops.fit`` in lean mode."""

    iterations: tuple[int, int, int] = (20, 40, 660)
    memory: int = 100
    eager: float = starts.DAMPING_ROLLOUT


def single_shooting(task: Task, how: Single) -> Run:
    """Lean single shooting of one clip: L-BFGS on first state and z in the rounder coordinates of ``start_stage_3``."""
    log, task = Log(), task.begun(how.eager)
    every = (*FIRST, "z", "betas")
    short = min(15, task.unknown.z.shape[1] + 1)
    unknown = task.unknown
    head = replace(unknown, z=unknown.z[:, : short - 1])
    parts = [(every, {"grown": False}), (tuple(n for n in every if n not in FIRST), {"contacts": False}), (every, {})]
    for (moving, what), inner in zip(parts, how.iterations, strict=True):
        if inner > 0:
            found = _descended(task, head if what == {"grown": False} else unknown, moving, inner, how, log, what)
            unknown = replace(found, z=torch.cat((found.z, unknown.z[:, found.z.shape[1] :]), 1))
    return log.run()


def _descended(task: Task, unknown: Unknowns, moving, inner, how: Single, log: Log, what: dict) -> Unknowns:
    """One part of single shooting; notes the whole energy wherever the part sees all frames."""
    new, old = stages.preconditioned_motion(unknown, moving, task.factors)
    short = {"grown": False} if "grown" in what else {}

    def energy(at: dict[str, Tensor], rows: Tensor) -> Tensor:
        here = old(at, rows)
        terms = stages.motion_terms(task.problem.rows(rows), here, **short)
        if not short:
            log.note(sum(terms.values()), here)
        kept = terms if what.get("contacts", True) else terms.keys() - {"contact_vel", "contact_height"}
        return sum(x for n, x in terms.items() if n in kept)

    with torch.no_grad():
        begun = sum(stages.motion_terms(task.problem, old(new, slice(None)), **what).values())
    enough = 1e-5 * begun.abs().nan_to_num(0.0, 0.0, 0.0)  # of its own first energy, as in ``testops.fit``
    fit = minimise_batch(energy, new, steps=1, inner=inner, memory=how.memory, tolerance_change=enough)
    return old(fit.variables, slice(None)).detached()


def shooting(task: Task, work: Schedule) -> Run:
    """Stage 3 of one clip as the product does it (``testops.fit``, solver "shooting")."""
    began, plan, rival = clock(), work.shooting, None
    start = task.begun(starts.DAMPING_SHOOTING).unknown
    if work.guesses and task.problem.evidence.hides_feet.any():
        plan = replace(plan, trial_rounds=max(plan.trial_rounds, testops._WEIGHED))
        rival = _seated(task)
    kept, seconds = [], []

    def linearise(problem: Problem, unknown: Unknowns, **how) -> coordinates.Whitening:
        kept.append((clock() - began, unknown.map(lambda x: x.detach().clone())))
        return coordinates.linearised(problem, unknown, **how)

    how = {"linearise": linearise, "note": lambda: seconds.append(clock() - began)}
    found, fits = feedback_solver.solve(task.problem, start, plan, second_start=rival, **how)
    kept.append((clock() - began, found.detached()))
    spent = clock() - began
    energies = torch.cat([fit.history for fit in fits]).nan_to_num(torch.inf).amin(1).cummin(0).values

    def lower(unknown: Unknowns) -> Unknowns:  # of the rows of one clip's unknowns
        energy = task.rows([0] * len(unknown.z)).energy(unknown)
        return unknown.rows(energy.argmin()[None])

    return Run(energies, torch.tensor(seconds[: len(energies)]), [(now, lower(u)) for now, u in kept], spent)


def _seated(task: Task) -> Unknowns:
    """The product's second start, where no foot is seen: somebody who sits where stage 2 is."""
    trust = task.problem.evidence.confidence_per_joint.clone()
    trust[..., starts.SITTING_LEGS] = 1.0
    sits = starts.seated(task.rough)
    with torch.no_grad():
        latent = task.problem.priors.pose.encode(sits.rot[:, :, 1:]).mean
    return replace(task, rough=sits, latent=latent).begun(starts.DAMPING_SHOOTING, trust).unknown


# ------------------------------------------------------------------------------------------------------- a nudge
class Nudged(NamedTuple):
    """Motions (T,) of the roll-out as it was, and nudged without and with feedback; apart: how far the nudged ones are
    from it, mean over joints, cm (T,), by way."""

    before: Motion
    after: dict[str, Motion]
    apart: dict[str, Tensor]


def nudged(task: Task, unknown: Unknowns, number: int, sigmas: float) -> Nudged:
    """Adds so many of the prior's standard deviations to all of z_number of one clip, in random directions, and rolls
    out with the other latents held (open loop) or answering (closed loop)."""
    white = coordinates.linearised(task.problem, unknown, stride=4)
    with torch.no_grad():
        first, z = unknowns.first_state(unknown, task.problem.priors), unknown.z
        plain, _ = steered_rollout(task.problem.priors.motion, first, z)
        push = torch.zeros_like(z)
        sign = torch.randn(z.shape[-1], generator=torch.Generator().manual_seed(number)).sign()
        push[0, number - 1] = sigmas * sign * (0.5 * plain.prior.log_var[0, number - 1]).exp()
        ways = {"open loop": (z + push, None), "closed loop": (white.base + push, white.gains.transpose(0, 1))}
        rolled = {way: steered_rollout(task.problem.priors.motion, first, *how)[0] for way, how in ways.items()}
        bodies = {
            way: unknowns.motion_of(unknowns.rolled_from(first, r, unknown, task.problem.evidence).body, 30.0).clip(0)
            for way, r in {"before": plain, **rolled}.items()
        }
    before = bodies.pop("before")
    apart = {way: CM * (m.positions - before.positions).norm(dim=-1).mean(-1) for way, m in bodies.items()}
    return Nudged(before, bodies, apart)
