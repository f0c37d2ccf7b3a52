"""Stage 3 by several solvers from the same stages 1 and 2: what energy each has reached after how much processor time.

All of them lower the same energy, that of an exact roll-out (``stages.motion_terms``), in the same unknowns, from a
start of ``start.start_stage_3`` or, by ``shooting``, from two. Nothing that is measured here depends on wall time: the
processor's time of this process counts, with one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor import stages, testops, unknowns
from motionlab.humor import start as starts
from motionlab.humor.energies import Weights
from motionlab.humor.evidence import evidence
from motionlab.humor.priors import Priors
from motionlab.humor.shooting import coordinates, feedback_solver
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
    (B, T), the true one and stage 2's. seconds: processor time of stages 1 and 2 and the start.
    """

    name: str
    problem: Problem
    unknown: Unknowns
    factors: Tensor | None
    latent: Tensor
    truth: Motion
    rough: Motion
    seconds: float = 0.0

    def __len__(self) -> int:
        return len(self.latent)

    def rows(self, index: Sequence[int] | Tensor) -> Task:
        """Some clips, in the order of ``index``."""
        at = torch.as_tensor(index)
        return replace(
            self, problem=self.problem.rows(at), unknown=self.unknown.rows(at), factors=self.factors[at],
            latent=self.latent[at], truth=self.truth.clip(at), rough=self.rough.clip(at),
        )  # fmt: skip

    def begun(self, eager: float, trust: Tensor | None = None) -> Task:
        """The same at another start (``start.start_stage_3``), joints believed as the evidence has them or as told."""
        trust = self.problem.evidence.trust if trust is None else trust
        how = (trust, self.problem.priors, (0,), self.truth.frames, "lean", self.problem.weights.pull, eager)
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
        """Distance of all joints from the true ones in the world, mean over joints and frames (B,), cm."""
        return CM * (motion.positions - self.truth.positions).norm(dim=-1).mean((-1, -2))


def prepare(
    name: str,
    observation,
    priors: Priors,
    weights: Weights,
    truth: Motion,
    *,
    cameras: Sequence[Camera] | None = None,
    schedule: Schedule | None = None,
) -> Task:
    """Stages 1 and 2 and the start of stage 3, in lean mode and calm, for clips with their truth."""
    began, schedule = clock(), schedule or Schedule.lean()
    seen = evidence(observation, cameras=cameras)
    problem = Problem(seen, priors, weights)
    unknown = testops.start_stage_1(problem)
    for stage in (1, 2):
        unknown, _ = stages.stage_1_and_2(
            problem, unknown, stage, steps=schedule.steps[stage - 1], inner=schedule.inner, tolerance=schedule.tolerance
        )
    with torch.no_grad():
        rough = unknowns.motion_of(unknowns.pose(unknown, priors, seen), seen.fps)
    unknown = unknown.detached()
    task = Task(name, problem, unknown, None, unknown.latent[:, 0], truth, rough)
    return replace(task.begun(starts.CALM), seconds=clock() - began)


@dataclass(frozen=True, eq=False)
class Run:
    """What a solver did: the lowest energies (N, B) so far, and the processor time at which each was known: seconds
    (N,) of the whole batch, or (N, B) where clips were run one at a time.

    unknown: what it ended with, and its energy ``end`` (B,) by a roll-out of its own. spent: seconds of the whole run,
    or (B,) of each clip's; linearised: of them in linearisations.
    """

    energies: Tensor
    seconds: Tensor
    unknown: Unknowns
    end: Tensor
    spent: float | Tensor
    linearised: float | Tensor = 0.0

    @property
    def each(self) -> Tensor:
        """The seconds of every clip (N, B)."""
        return self.seconds if self.seconds.ndim == 2 else self.seconds[:, None].expand_as(self.energies)

    def within(self, best: Tensor, share: float, size: Tensor | None = None) -> Tensor:
        """Seconds (B,) until the energy is within ``share`` of a size (B,), else of |best|, of the best (B,); inf where
        it never is."""
        good = self.energies <= best + share * (best.abs() if size is None else size)
        seconds = self.each.gather(0, good.double().argmax(0)[None])[0]
        return torch.where(good.any(0), seconds, torch.inf)

    def at(self, seconds: Tensor | float) -> Tensor:
        """The lowest energy (B,) that was known after so many seconds; inf before the first."""
        count = (self.each <= seconds).sum(0)
        known = self.energies.gather(0, (count - 1).clamp(min=0)[None])[0]
        return torch.where(count > 0, known, torch.inf)


def so_far(energies: Tensor) -> Tensor:
    """The lowest of energies (N, B) up to each; what is not a number is infinite."""
    return energies.detach().nan_to_num(torch.inf, torch.inf, torch.inf).cummin(0).values


@dataclass
class Log:
    """Notes lowest energies and the time; what it does itself costs the contender microseconds."""

    clips: int
    limit: float = torch.inf
    began: float = field(default_factory=clock)
    energies: list[Tensor] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def note(self, found: Tensor, rows: Tensor) -> None:
        """Energies (n,) of some clips."""
        before = self.energies[-1] if self.energies else torch.full((self.clips,), torch.inf)
        found = found.detach().to(before).nan_to_num(torch.inf, torch.inf, torch.inf)
        self.seconds.append(clock() - self.began)
        self.energies.append(before.index_copy(0, rows, torch.minimum(before[rows], found)))

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return clock() - self.began > self.limit

    def run(self, task: Task, unknown: Unknowns, spent: float) -> Run:
        """The whole run."""
        found = unknown.detached()
        energies = torch.stack(self.energies)
        return Run(energies, torch.tensor(self.seconds).double(), found, task.energy(found), spent)


# --------------------------------------------------------------------------------------------------- the contenders
@dataclass(frozen=True)
class Single:
    """How single shooting searches: iterations of its three parts (the first 15 frames; all, the first state frozen,
    without contacts; everything), pairs that L-BFGS remembers, and the share of its own first energy that an iteration
    must gain. The default is that of ``testops.fit`` in lean mode."""

    iterations: tuple[int, int, int] = (20, 40, 660)
    memory: int = 100
    tolerance: float = 1e-5

    @classmethod
    def budget(cls, iterations: int) -> Single:
        """So many iterations in all, in the default's parts where there are enough of them."""
        first, second = min(20, iterations // 4), min(40, iterations // 4)
        return cls((first, second, iterations - first - second))

    @property
    def patient(self) -> Single:
        """The same with neither an end to its iterations nor a tolerance: only time stops it, or the lack of gain."""
        return replace(self, iterations=(*self.iterations[:2], 10**6), tolerance=0.0)


def single_shooting(task: Task, how: Single | None = None, *, seconds: float = torch.inf) -> Run:
    """Lean single shooting: L-BFGS on first state and z in the rounder coordinates of ``start.start_stage_3``.

    seconds: after which it stops. The first part sees 15 frames only and has no energy to note.
    """
    how, log = how or Single(), Log(len(task), seconds)
    camera = ("camera",) if task.unknown.camera is not None and task.problem.evidence.view.free else ()
    every = (*FIRST, "z", "betas", *camera)
    frames = task.unknown.z.shape[2] + 1
    short = min(15, frames)
    head = replace(task.unknown, z=task.unknown.z[:, :, : short - 1])
    parts = [(every, {"grown": False}), (tuple(n for n in every if n not in FIRST), {"contacts": False}), (every, {})]
    unknown = task.unknown
    for (moving, what), inner in zip(parts, how.iterations, strict=True):
        if inner <= 0:
            continue
        first = "grown" in what
        found = _descended(task, head if first else unknown, moving, inner, how, log, what)
        unknown = replace(found, z=torch.cat((found.z, unknown.z[:, :, short - 1 :]), 2)) if first else found
    return log.run(task, unknown, clock() - log.began)


def _descended(task: Task, unknown: Unknowns, moving, inner, how: Single, log: Log, what: dict) -> Unknowns:
    """One part of single shooting; notes the whole energy wherever the part sees all frames."""
    new, old = stages.rounded_motion(unknown, moving, task.factors)

    short, calls = {"grown": False} if "grown" in what else {}, []

    def energy(at: dict[str, Tensor], rows: Tensor) -> Tensor:
        calls.append(1)
        if len(calls) > 1 and log.late:
            raise KeyboardInterrupt  # what stops a search at its best point
        terms = stages.motion_terms(task.problem.rows(rows), old(at, rows), **short)
        if not short:
            log.note(sum(terms.values()), rows)
        return sum(
            x for n, x in terms.items() if n not in ("contact_vel", "contact_height") or what.get("contacts", True)
        )

    point = {n: x.clone().requires_grad_() for n, x in new.items()}
    with torch.no_grad():
        begun = sum(stages.motion_terms(task.problem, old(point, slice(None)), **what).values())
    fit = minimise_batch(
        energy, point, steps=1, inner=inner, memory=how.memory, rows=True,
        tolerance_change=how.tolerance * begun.abs().nan_to_num(0.0, 0.0, 0.0),
    )  # fmt: skip
    return old(fit.variables, slice(None)).detached()


def shot(
    task: Task,
    plan: feedback_solver.Plan | None = None,
    start: Unknowns | None = None,
    *,
    change: Callable[[coordinates.Loop, Unknowns], coordinates.Loop] | None = None,
) -> Run:
    """Closed-loop Gauss-Newton (``shooting``) from the task's start and the eager one, or from another alone.

    change: what becomes of the coordinates of every linearisation, for ablations.
    """

    def linearise(problem: Problem, unknown: Unknowns, **how) -> coordinates.Loop:
        loop = coordinates.linearised(problem, unknown, **how)
        return change(loop, unknown) if change else loop

    began, report = clock(), feedback_solver.ShootingReport(clock=clock)
    both = start is None and (plan or feedback_solver.Plan()).trial
    rival = task.begun(starts.EAGER).unknown if both else None
    ready = clock() - began
    unknown, _ = feedback_solver.solve(
        task.problem, start or task.unknown, plan, report, rival=rival, linearise=linearise
    )
    spent = clock() - began
    energies = torch.stack(report.history)
    seconds = ready + torch.tensor(report.seconds).double()
    if len(energies) != len(seconds):
        raise DataError(f"{len(seconds)} times for {len(energies)} closures", remedy="note every closure once")
    unknown = unknown.detached()
    end, derived = task.energy(unknown), sum(report.linearised)
    return Run(so_far(energies), seconds, unknown, end, spent, derived)


def without_feedback(loop: coordinates.Loop, unknown: Unknowns) -> coordinates.Loop:
    """The same shapers, but z = z^ + L^-T nu: later latents do not answer to what earlier ones changed."""
    z = unknown.z[:, 0]
    return loop._replace(base=z, gains=torch.zeros_like(loop.gains), shared=torch.zeros_like(loop.shared))


def without_shape(loop: coordinates.Loop, unknown: Unknowns) -> coordinates.Loop:
    """The same feedback, but nu moves z in the prior's own units: every shaper is one number times 1."""
    size = loop.shapers.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    eye = torch.eye(loop.shapers.shape[-1], dtype=size.dtype, device=size.device)
    return loop._replace(shapers=(size * eye).expand_as(loop.shapers).contiguous())
