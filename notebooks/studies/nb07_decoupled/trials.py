"""What the decoupled stage 3 is tried on, and how it is judged.

Source: thesis 3.3.3. The judge is the same for all variants: the exact roll-out of the x_0 and z that were found.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from motionlab.humor import state, testops
from motionlab.humor.cvae import Cvae
from motionlab.humor.energies import RGB_LIGHT
from motionlab.humor.evidence import evidence
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import decode_ahead, infer, rollout
from motionlab.humor.stages import Problem
from motionlab.humor.testops import Fitted, Schedule
from motionlab.humor.unknowns import motion_of
from motionlab.metrics import gait, intervals, pose
from motionlab.motion import Motion
from studies.nb07_decoupled.energy import Unknown, posed, rolled_out, to_persistent, to_states
from studies.nb07_decoupled.search import Found, Plan, adam, lbfgs
from studies.shared.contenders import CM, Seen

Method = Callable[[Problem, Unknown, Plan, int], Found]


class Filmed(Seen):
    """A scene with its truth (B, T) of the 22 joints."""

    truth: Motion


@dataclass(frozen=True, eq=False)
class Case:
    """B clips at the end of stage 2.

    problem: the energy of stage 3. start: the persistent states of stage 2, the posterior's mean for each of its
    transitions, its shape. truth, stage_2: motions (B, T). fitted: what a whole fit made of the clips, and in how many
    seconds of processor time, where one was asked for.
    """

    problem: Problem
    start: dict[str, Tensor]
    truth: Motion
    stage_2: Motion
    fitted: Fitted | None = None
    seconds: float = 0.0

    def __len__(self) -> int:
        return len(self.start["x"])

    def rows(self, index: Tensor) -> Case:
        """Some of the clips, or some several times, in the order of ``index``; without the whole fit."""
        return Case(
            self.problem.rows(index), {n: x[index] for n, x in self.start.items()}, self.truth.clip(index),
            self.stage_2.clip(index),
        )  # fmt: skip

    @property
    def model(self) -> Cvae:
        """The motion prior."""
        return self.problem.priors.motion


def case(scene: Filmed, priors: Priors, schedule: Schedule, *, frames: int, solver: str | None = None) -> Case:
    """The first ``frames`` of a scene with its camera known, after stages 1 and 2; with a ``solver`` fitted whole, too:
    by "rollout", which is single shooting, or by "shooting", which is faster.

    Raises:
        KeyboardInterrupt: somebody stopped a fit; half of one is none to compare with.
    """
    seen = replace(
        scene.observation,
        keypoints=scene.observation.keypoints[:, :frames],
        confidence=scene.observation.confidence[:, :frames],
    )
    schedule, how = replace(schedule, window=frames), {"cameras": scene.cameras}
    begun = _to_the_end(testops.fit(seen, priors, schedule=schedule.without_stage_3(), **how))
    states = state.from_motion(begun.stages[2])
    with torch.no_grad():
        z = infer(priors.motion, states)[0].mean
    start = {"x": to_persistent(states), "z": z, "betas": begun.betas}
    problem, truth = Problem(evidence(seen, **how), priors, RGB_LIGHT), scene.truth.cut(0, frames)
    if solver is None:
        return Case(problem, start, truth, begun.stages[2])
    began = time.process_time()
    fitted = _to_the_end(testops.fit(seen, priors, schedule=schedule, solver=solver, **how))
    return Case(problem, start, truth, begun.stages[2], fitted, time.process_time() - began)


def _to_the_end(fitted: Fitted) -> Fitted:
    if fitted.stopped:
        raise KeyboardInterrupt
    return fitted


def reference(known: Case) -> dict[str, Tensor]:
    """What the whole fit found, as decoupled unknowns: the states of its roll-out, its z, its shape."""
    with torch.no_grad():
        first, z = known.fitted.first[:, 0], known.fitted.z[:, 0]
        states = torch.cat((first[:, None], rollout(known.model, first, z, with_prior=False).states), 1)
    return {"x": to_persistent(states), "z": z, "betas": known.fitted.betas}


# ------------------------------------------------------------------------------------------------------- the judge
def motions(known: Case, unknown: Unknown) -> dict[str, Motion]:
    """ "kept": the persistent states as they are. "rolled": the exact roll-out of x_0 and z."""
    fps = known.truth.fps
    with torch.no_grad():
        kept = posed(to_states(unknown["x"]), unknown["betas"], known.problem.evidence)
        _, rolled = rolled_out(known.problem, unknown)
    return {"kept": motion_of(kept, fps), "rolled": motion_of(rolled.body, fps)}


def judged(known: Case, unknown: Unknown) -> dict[str, Tensor]:
    """Measures (B,) of what was found.

    "energy": of stage 3, of the exact roll-out. "legs", "kept legs": error in cm of knees, ankles and feet, pelvis on
    the true one, of the exact roll-out and of the persistent states. "sits", "kept sits": 1 where somebody sits in the
    last ten frames. "gap": mean distance in cm of the joints of the two, in the world.
    """
    energies, _ = rolled_out(known.problem, unknown)
    found = motions(known, unknown)
    return {
        "energy": sum(energies.values()),
        "legs": legs(known, found["rolled"]),
        "sits": gait.sits(found["rolled"]),
        "kept legs": legs(known, found["kept"]),
        "kept sits": gait.sits(found["kept"]),
        "gap": CM * pose.mpjpe(found["kept"].positions, found["rolled"].positions, align="none"),
    }


def legs(known: Case, motion: Motion, frames: int | None = None) -> Tensor:
    """Error (B,) in cm of knees, ankles and feet, pelvis on the true one, over the first ``frames`` or all."""
    error = pose.joint_errors(motion.positions, known.truth.positions, align="root")
    return CM * error[:, :frames, gait.legs(known.truth)].mean((-1, -2))


#: The thesis's premise (3.3.3): z "encode a sitting motion". Half of the flexion from which on somebody sits, degrees.
ENCODES = 30.0


def bending(known: Case, z: Tensor, states: Tensor | None = None) -> Tensor:
    """Knee flexion (B,) that z says: summed over one-step decodes from states (B, T, 339), degrees, mean of legs.

    states: unless given those of stage 2.
    """
    skeleton, fps = known.stage_2.skeleton, known.truth.fps
    states = to_states(known.start["x"]) if states is None else states
    with torch.no_grad():
        after = decode_ahead(known.model, states[:, :-1], z)[:, :, 0]
    before, after = (gait.tilt_and_bend(state.to_motion(x, skeleton, fps))[1] for x in (states[:, :-1], after))
    return (after - before).mean(-1).sum(-1)


def searched(
    known: Case, start: Unknown, plan: Plan, evaluations: int, *, method: Method = adam, at: Sequence[int] = ()
) -> Found:
    """A search, watched by :func:`judged`: Adam and L-BFGS after ``at`` evaluations, turns after every block."""
    look = {"watch": partial(judged, known)} | ({"at": at} if method in (adam, lbfgs) else {})
    return method(known.problem, start, plan, evaluations, **look)


def gone(watched: Mapping[int, Mapping[str, Tensor]], goal: Tensor, share: float) -> Tensor:
    """Evaluations (B,) until the roll-out's energy was seen to have made ``share`` of the way from where it was first
    to a goal (B,); inf where it never was. As coarse as what was watched."""
    energy = torch.stack([seen["energy"] for seen in watched.values()])
    at = torch.tensor([float(n) for n in watched], device=energy.device)
    there = energy <= energy[0] + share * (goal - energy[0])
    return torch.where(there, at[:, None], torch.inf).amin(0)


def whole_energies(known: Case) -> dict[int, dict[str, Tensor]]:
    """Energies of the whole fit's stage 3, as a search's ``watched``: of its start, and of its last sub-stage alone, as
    those before see fewer frames or terms; their evaluations count."""
    *early, last = known.fitted.results[3]
    before = sum(result.closures for result in early)
    lowest = last.history.cummin(0).values
    return {0: judged(known, known.start)} | {before + k + 1: {"energy": row} for k, row in enumerate(lowest)}


def to_tolerance(history: Tensor, share: float = 0.99) -> Tensor:
    """Evaluations (B,) after which a clip's lowest energy so far has made ``share`` of its whole fall."""
    lowest = history.cummin(0).values
    reached = lowest[0] - lowest >= share * (lowest[0] - lowest[-1])
    return 1.0 + reached.double().argmax(0)


def text(values: Tensor, generator: torch.Generator, statistic: str = "median", digits: int = 1) -> str:
    """A statistic of clips with its 95 % bootstrap interval, as a person reads it."""
    middle, low, high = intervals.interval(values, statistic, generator)
    return f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def row(found: Mapping[str, Tensor], generator: torch.Generator) -> dict[str, str]:
    """The measures of :func:`judged` as cells of a table: medians over clips with intervals, and counts."""
    return {
        "energy of the roll-out": text(found["energy"], generator, digits=0),
        "its legs, cm": text(found["legs"], generator),
        "it sits": f"{found['sits'].sum():.0f} of {len(found['sits'])}",
        "legs of x, cm": text(found["kept legs"], generator),
        "x sits": f"{found['kept sits'].sum():.0f} of {len(found['sits'])}",
        "from x to roll-out, cm": text(found["gap"], generator),
    }


# ------------------------------------------------------------------------------------------------ one of the two fixed
def with_z_fixed(known: Case, z: Tensor, plan: Plan, evaluations: int, at: Sequence[int], frames: int) -> Found:
    """x from that of stage 2 on, z fixed; watched: :func:`judged`, and "first legs", the same as "kept legs" but of the
    first ``frames`` alone, so that a long clip can be compared with a short one where both have frames."""

    def look(unknown: Unknown) -> dict[str, Tensor]:
        return judged(known, unknown) | {"first legs": legs(known, motions(known, unknown)["kept"], frames)}

    return adam(known.problem, {**known.start, "z": z}, plan, evaluations, watch=look, at=at)


def latent_error(z: Tensor, wanted: Tensor) -> Tensor:
    """Mean absolute difference (..., B) of latents (..., B, T, 48): "latent_motion error". Source: thesis Fig. 3.13."""
    return (z - wanted).abs().mean((-1, -2))


def towards(known: Case, plan: Plan, iterations: int, at: Sequence[int]) -> tuple[Found, Tensor]:
    """x and shape fixed at the solution of single shooting, z from the posterior's mean of stage 2 on.

    Also, as a control beside them, the latent errors (2, len(at), B) over the search: from the z of the clip's own
    solution, and from that of the next clip's, with which this x has nothing to do.
    """
    solution = reference(known)
    wanted = torch.stack((solution["z"], solution["z"].roll(-1, 0)))
    start = {**solution, "z": known.start["z"]}
    found = adam(
        known.problem, start, plan, iterations,
        watch=lambda u: {"error": latent_error(u["z"], wanted)}, at=at,
    )  # fmt: skip
    return found, torch.stack([found.watched[i]["error"] for i in at], 1)
