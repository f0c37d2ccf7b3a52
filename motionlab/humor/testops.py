"""HuMoR's test-time optimisation (TestOps): the motion of a person from 2-D keypoints or 3-D joints, in three stages.

1. root position and orientation of every frame;
2. and pose (through a pose prior) and shape, smooth in time;
3. a first state and latents whose roll-out by the motion prior explains the observation.

Source: HuMoR (Rempe et al. 2021), section 4 and its official code; thesis 3.1.2.
Differs, in "lean" mode: rotations are 6 numbers; joints come from forward kinematics alone; the start is found in
closed form and interpolated where nothing was seen; stage 1 is smooth; transitions of which nothing was seen start at
the prior's mean. "official" mode has the official code's unknowns, start and missing masks. Stage 3 has two solvers:
"rollout", the original sub-stages, and in lean mode the faster "shooting". Either takes a recording whole, where the
official code cuts windows of 60 frames; ``footage`` cuts what is longer than 6 s.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Self

import torch
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor import energies, stages, state, unknowns
from motionlab.humor import start as starts
from motionlab.humor.body_shape import landmarks
from motionlab.humor.energies import JOINTS, RGB, RGB_LIGHT, Weights
from motionlab.humor.evidence import Evidence, Observation3D, evidence
from motionlab.humor.feedback_solver import Plan, solve
from motionlab.humor.priors import Priors
from motionlab.humor.stages import Problem
from motionlab.humor.unknowns import Rolled, Unknowns
from motionlab.motion import FPS, Motion
from motionlab.observation import Camera, Observation2D
from motionlab.optimise import begins
from motionlab.parallel import threads_for
from motionlab.skeleton import STANDARD, fk

MODES = ("lean", "official")
SOLVERS = ("rollout", "shooting")
_WEIGHED = 4  # rounds after which a start that sits is judged: after 2, some that stood up sat to the end
_NAMES = ("stage 1 of 3: where they are", "stage 2 of 3: pose and size", "stage 3 of 3: motion")
#: From here on a fit is doubtful. On practice clips latent_chi2 was below 0.47 and misfit 13 pixels of 1280, or 7 cm.
MAX_LATENT_CHI2, MISFIT_METRES, MISFIT_WIDTH = 0.5, 0.12, 1 / 64  # the last of the image's width: 20 pixels of 1280


@dataclass(frozen=True)
class Schedule:
    """How much work a fit does. Source: the official configurations.

    steps: outer steps of the three stages, each up to ``inner`` iterations of L-BFGS. short: frames of stage 3's first
    sub-stage. refine: stage-3 steps at which all frames join (x0 frozen, no contact terms), and at which everything
    moves. tolerance: a recording is done with a stage when an iteration gains less than this share of its own energy at
    the stage's start. shooting: the work of that solver in stage 3, instead of short, refine and the third number of
    steps (which, at 0, still leaves stage 3 out). guesses: begin stage 3 with the floor below stage 2's feet, where its
    height is not known; and with shooting from one start, or, where no foot was seen, also from one that sits.
    """

    steps: tuple[int, int, int] = (30, 70, 70)
    inner: int = 20
    short: int = 15
    refine: tuple[int, int] = (30, 55)
    tolerance: float = 1e-5
    shooting: Plan = field(default_factory=Plan)
    guesses: bool = False

    @classmethod
    def lean(cls) -> Self:
        """Returns what lean mode needs, with its start near the goal and preconditioning: less than half."""
        return cls(steps=(5, 10, 36), refine=(1, 3))

    @classmethod
    def official(cls, *, keypoints: bool) -> Self:
        """Returns the official configuration for keypoints (its video demo) or for 3-D joints."""
        return cls(steps=(30, 80, 70) if keypoints else (30, 70, 70))

    def without_stage_3(self) -> Self:
        """Returns the same schedule with stages 1 and 2 alone."""
        return replace(self, steps=(*self.steps[:2], 0))

    @classmethod
    def quick(cls) -> Self:
        """Returns few steps, for tests and a first try."""
        return cls(steps=(2, 3, 3), inner=8, refine=(1, 2), shooting=Plan(rounds=2, closures=8, trial_rounds=1))


@dataclass(frozen=True, eq=False)
class FitDiagnostics:
    """How well a fit of stage 3 agrees with the prior and with what was seen, per clip (B,).

    latent_chi2: mean square of (z - mu) / sigma over transitions and latents: 1 for motion drawn from the prior, less
    for motion like that of its training, large where a motion is not one that it would make. misfit: root mean square
    distance of what was seen, metres or pixels; above ``bound`` it is doubtful.
    """

    latent_chi2: Tensor
    misfit: Tensor
    bound: float
    pixels: bool

    @property
    def doubtful(self) -> Tensor:
        """(B,) true where either is not finite or above its bound."""
        return ~((self.latent_chi2 <= MAX_LATENT_CHI2) & (self.misfit <= self.bound))

    def sentences(self) -> tuple[str, ...]:
        """Returns a sentence for every clip that is doubtful."""
        chi2, misfit, unit = self.latent_chi2.tolist(), self.misfit.tolist(), "{:.0f} px" if self.pixels else "{:.2f} m"
        return tuple(
            f"stage 3 doubts clip {k}: latent chi2 {chi2[k]:.2f} (up to {MAX_LATENT_CHI2:g} is usual), "
            f"what was seen is missed by {unit.format(misfit[k])}"
            for k in self.doubtful.nonzero()[:, 0].tolist()
        )


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a fit found; G recordings of T frames, world coordinates.

    motion (G, T): of the last stage, each on its own skeleton, with contact labels. stages: after stage 1, 2, 3.
    contacts (G, T, 9): probabilities, in the order of ``STANDARD.contact_names``; zeros where no stage 3 ran.
    z (G, T - 1, 48) and first (G, 339): latents and first states. betas (G, 8): shape in standard deviations. cameras:
    one per recording, as found; None for 3-D observations. energies: per stage, each term weighted, (G,). results: the
    optimiser's reports of each stage. notes: what was assumed, left out or is doubtful. diagnostics: of stage 3 (G,),
    or None. problem, unknown: what shooting minimised, and where it ended (``posterior``); None after the other solver.
    """

    motion: Motion
    stages: dict[int, Motion]
    contacts: Tensor
    z: Tensor
    first: Tensor
    betas: Tensor
    cameras: list[Camera] | None
    energies: dict[int, dict[str, Tensor]]
    results: dict[int, list[object]]
    notes: tuple[str, ...] = ()
    diagnostics: FitDiagnostics | None = None
    problem: Problem | None = None
    unknown: Unknowns | None = None

    @property
    def stopped(self) -> bool:
        """Whether a person stopped a stage."""
        return _stopped(self.results)


def _stopped(results: dict[int, list[object]]) -> bool:
    return any(stages.interrupted(each) for found in results.values() for each in found)


def fit(
    observation: Observation2D | Observation3D, priors: Priors, *, weights: Weights | None = None,
    schedule: Schedule | None = None, mode: str = "lean", solver: str = "rollout",
    cameras: Sequence[Camera] | None = None, floor: str | None = None, size: tuple[int, int] | None = None,
    progress: bool | str = False, watch: Callable[[int, dict[str, Tensor]], None] | None = None,
) -> Fitted:  # fmt: skip
    """Fits every recording of a batch. Ctrl-C keeps the best so far. On the observation's device, where the priors and
    the cameras have to be, too.

    What was not seen has no weight. Unseen joints: the priors decide. Unseen frames: the start is interpolated and held
    at the ends (of keypoints, in lean mode alone); smoothness and the motion prior decide from there. Where no frame
    shows 3 joints that give an orientation, or 4 keypoints, the start stands upright at the origin (same exception).
    One frame has no stage 3, and a note says so.

    Args:
        observation: keypoints (G, T, K, 2) seen by one static camera each, or joints (G, T, 22, 3) in the world; the
            batch axis may be left out.
        weights: default ``JOINTS``, or for keypoints ``RGB_LIGHT`` in lean, ``RGB`` in official mode. schedule: default
            ``Schedule.lean()`` in lean, ``Schedule.official`` in official mode.
        solver: of stage 3: "rollout", whose numbers most notebooks hold, for clips of a few seconds, or in lean mode
            "shooting", which is faster and keeps 3 MB of a frame. ``footage`` cuts what is longer.
        cameras, floor, size: of keypoints, as ``evidence`` takes them.
        progress: show bars with the energy; or "lines": say which stage begins, on stderr.
        watch: called with the stage and its weighted terms (G',) of the recordings that still move, at every
            evaluation; not by solver "shooting".

    Raises:
        DataError: nothing to fit, or a frame rate other than the prior's.
        ShapeError: arrays that do not fit each other.
        ValueError: no such mode or solver, or shooting in another than lean mode.
    """
    if mode not in MODES:
        raise ValueError(f"mode: expected one of {', '.join(MODES)}, got {mode!r}")
    if solver not in SOLVERS or (solver == "shooting" and mode != "lean"):
        raise ValueError(f"solver: expected one of {', '.join(SOLVERS)}, the last in lean mode alone, got {solver!r}")
    seen = evidence(observation, cameras=cameras, floor=floor, size=size)
    if abs(seen.fps - FPS) > 0.02 * FPS:
        what = f"{seen.fps:g} frames per second; the motion prior knows {FPS:g}"
        raise DataError(what, remedy="resample the observation first")
    schedule = schedule or (Schedule.lean() if mode == "lean" else Schedule.official(keypoints=seen.view is not None))
    weights = weights or (JOINTS if seen.view is None else RGB_LIGHT if mode == "lean" else RGB)
    problem = Problem(seen, priors, weights, mode)
    with threads_for(len(seen.values)):
        unknown = start_stage_1(problem)
        track = _Track(schedule, progress, watch)
        for stage in (1, 2):
            if not _stopped(track.results):
                unknown = track.pose_stage(problem, unknown, stage)
        if seen.values.shape[1] < 2 or _stopped(track.results) or not schedule.steps[2]:
            return track.without_stage_3(problem, unknown)
        return track.motion_stage(problem, unknown, solver)


def start_stage_1(problem: Problem) -> Unknowns:
    """Computes the unknowns of stage 1: the mean pose, laid onto the observation."""
    seen, priors = problem.evidence, problem.priors
    groups, frames = seen.values.shape[:2]
    latent = seen.values.new_zeros(groups, frames, 32)
    shape = seen.values.new_zeros(groups, 8)
    with torch.no_grad():
        decoded = priors.pose.decode(latent[0, 0])
        body = torch.cat((torch.eye(3).to(decoded)[None], decoded))
        joints, turns = fk(STANDARD, body.new_zeros(3), body)
        if seen.view is not None:
            joints = landmarks(joints[None, None], turns[None, None], shape[:1])[0, 0]
        if seen.view is not None and problem.mode != "lean":
            trans, turn = starts.start_facing(seen, joints)
        else:
            found = (starts.start_3d if seen.view is None else starts.start_2d)(seen, joints)
            trans, turn = starts.interpolate_unseen(*found, seen.fps)
    orient = unknowns.from_matrix(turn, problem.mode)
    camera = None if seen.view is None else seen.values.new_zeros(groups, 3)
    return Unknowns(trans, orient, latent, betas=shape, camera=camera)


class _Track:
    """The way of one fit: runs its stages and keeps what they found."""

    def __init__(self, schedule: Schedule, progress: bool | str, watch: Callable | None) -> None:
        self.schedule, self.progress, self.watch = schedule, progress, watch
        self.stages: dict[int, Motion] = {}
        self.energies: dict[int, dict[str, Tensor]] = {}
        self.results: dict[int, list[object]] = {}

    def _budget(self, stage: int) -> dict[str, object]:
        name = begins(_NAMES[stage - 1], self.progress)
        how = {"inner": self.schedule.inner, "tolerance": self.schedule.tolerance, "progress": name}
        return how | {"watch": self.watch and partial(self.watch, stage)}

    def pose_stage(self, problem: Problem, unknown: Unknowns, stage: int) -> Unknowns:
        steps = self.schedule.steps[stage - 1]
        unknown, report = stages.stage_1_and_2(problem, unknown, stage, steps=steps, **self._budget(stage))
        self.results[stage] = [report]
        with torch.no_grad():
            self.energies[stage] = stages.pose_terms(problem, unknown, stage)
            body = unknowns.pose(unknown, problem.priors, problem.evidence)
        self.stages[stage] = unknowns.motion_of(body, problem.evidence.fps)
        return unknown

    def motion_stage(self, problem: Problem, unknown: Unknowns, solver: str) -> Fitted:
        s, seen, plan, budget = self.schedule, problem.evidence, self.schedule.shooting, self._budget(3)
        begun = self._begun(problem, unknown, self.stages[2], unknown.latent, seen.confidence_per_joint)
        if solver == "shooting":
            start, second_start = starts.start_stage_3(*begun, damping=starts.DAMPING_SHOOTING)[0], None
            if not s.guesses and plan.trial_rounds:
                second_start = starts.start_stage_3(*begun)[0]
            elif s.guesses and seen.hides_feet.any():
                plan = replace(plan, trial_rounds=max(plan.trial_rounds, _WEIGHED))
                sits = self._seated(problem, unknown).named()
                who = {name: seen.hides_feet.reshape(-1, *(1,) * (x.ndim - 1)) for name, x in sits.items()}
                second_start = Unknowns(**{n: torch.where(who[n], x, getattr(start, n)) for n, x in sits.items()})
            end, found = solve(problem, start, plan, second_start=second_start, progress=budget["progress"])
        else:
            start, factors = starts.start_stage_3(*begun)
            work = {"steps": s.steps[2], "short": s.short, "refine": s.refine}
            end, found = stages.stage_3(problem, start, factors, **work, **budget)
        self.results[3] = found
        with torch.no_grad():
            self.energies[3] = stages.motion_terms(problem, end)
            rolled = unknowns.roll(end, problem.priors, seen)
        contacts = energies.contact_probabilities(rolled.rollout.contact_logits)
        self.stages[3] = unknowns.motion_of(rolled.body, seen.fps, contacts=(contacts > 0.5).to(contacts))
        says = diagnosed(rolled, seen)
        kept = (problem, end.detached()) if solver == "shooting" else (None, None)
        return self._fitted(problem, end, contacts, end.z, rolled.states[:, 0], says.sentences(), says, *kept)

    def _begun(self, problem: Problem, unknown: Unknowns, motion: Motion, latent: Tensor, confidence: Tensor) -> tuple:
        """What stage 3 begins with; the floor is guessed below the feet of ``motion`` where its height is not known."""
        shared, view = unknown.shared(), problem.evidence.view
        if self.schedule.guesses and view is not None and view.free:
            up = torch.nn.functional.pad(-starts.above_floor(motion.positions)[:, None], (2, 0))
            motion, shared["camera"] = replace(motion, root=motion.root + up[:, None]), shared["camera"] + up
        return motion, latent, shared, confidence, problem.priors, problem.mode, problem.weights.pull

    def _seated(self, problem: Problem, unknown: Unknowns) -> Unknowns:
        """The start of stage 3 of somebody who sits where stage 2 is."""
        sits, confidence = starts.seated(self.stages[2]), problem.evidence.confidence_per_joint.clone()
        confidence[..., starts.SITTING_LEGS] = 1.0
        latent = problem.priors.pose.encode(sits.rot[:, :, 1:]).mean
        begun = self._begun(problem, unknown, sits, latent, confidence)
        return starts.start_stage_3(*begun, damping=starts.DAMPING_SHOOTING)[0]

    def without_stage_3(self, problem: Problem, unknown: Unknowns) -> Fitted:
        one = problem.evidence.values.shape[1] < 2
        why = "interrupted" if _stopped(self.results) else "one frame has no transition" if one else "no steps for it"
        motion = self.stages[max(self.stages)]
        contacts = motion.root.new_zeros(*motion.root.shape[:2], 9)
        first = state.from_motion(motion, causal=problem.priors.motion.causal)[:, 0]
        z = contacts.new_zeros(len(contacts), 0, problem.priors.motion.latent)
        return self._fitted(problem, unknown, contacts, z, first, (f"stage 3 left out: {why}",))

    def _fitted(self, problem: Problem, unknown: Unknowns, contacts, z, first, notes: tuple[str, ...], *more) -> Fitted:
        view = problem.evidence.view
        cameras = None if view is None else view.cameras(unknown.camera)
        return Fitted(
            self.stages[max(self.stages)], self.stages, contacts, z, first, unknown.betas, cameras,
            self.energies, self.results, (*problem.evidence.notes, *notes), *more,
        )  # fmt: skip


@torch.no_grad()
def diagnosed(rolled: Rolled, evidence: Evidence) -> FitDiagnostics:
    """Computes how well roll-outs of B rows agree with the prior and with what was seen."""
    prior, weight = rolled.rollout.prior, (evidence.weight > 0).to(rolled.states)
    latent_chi2 = ((rolled.rollout.z - prior.mean).square() * (-prior.log_var).exp()).mean((1, 2))
    off = (rolled.body.observed - evidence.values).square().sum(-1)
    missed = torch.where(weight > 0, off, 0.0).sum((1, 2)) / weight.sum((1, 2)).clamp(min=1)
    bound = MISFIT_METRES if evidence.view is None else MISFIT_WIDTH * evidence.view.size[0]
    return FitDiagnostics(latent_chi2, missed.sqrt(), bound, evidence.view is not None)
