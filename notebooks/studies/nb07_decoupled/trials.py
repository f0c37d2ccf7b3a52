"""What the decoupled stage 3 is tried on, how its settings are chosen, and how it is judged.

The judge is the same for all variants: the exact roll-out of the x_0 and z that were found.
Source: thesis 3.3.3.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from data_synth import scenes
from data_synth.scenes import Scene
from motionlab import metrics
from motionlab.bench import person_windows
from motionlab.humor import state, testops
from motionlab.humor.energies import JOINTS, RGB_LIGHT
from motionlab.humor.evidence import Observation2D, Observation3D, evidence
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import infer, rollout
from motionlab.humor.stages import Problem
from motionlab.humor.testops import Schedule
from motionlab.humor.unknowns import motion_of
from motionlab.motion import Motion
from studies.nb07_decoupled.energy import Unknown, posed, prior_of, to_persistent, to_states, whole
from studies.nb07_decoupled.search import Found, Plan, search
from studies.shared.clips import part, recorded
from studies.shared.joints import noisy
from studies.shared.one_step import decode_ahead
from studies.shared.sitting import seated


@dataclass(frozen=True, eq=False)
class Case:
    """B clips at the end of stage 2.

    problem: the energy of stage 3. start: the persistent states of stage 2, the posterior's mean for each of its
    transitions, its shape. truth, stage_2: motions (B, T).
    """

    problem: Problem
    start: dict[str, Tensor]
    truth: Motion
    stage_2: Motion

    def rows(self, index: Tensor) -> Self:
        """Some of the clips, or some several times, in the order of ``index``."""
        start = {n: x[index] for n, x in self.start.items()}
        return Case(self.problem.rows(index), start, self.truth.clip(index), self.stage_2.clip(index))


def case(scene: Scene, priors: Priors, schedule: Schedule, frames: int) -> Case:
    """The first ``frames`` of a filmed scene, after stages 1 and 2."""
    seen = part(scene.observation, slice(None), slice(frames))
    return _begun(seen, scene.truth.cut(0, frames), priors, schedule, cameras=scene.cameras)


def people(folder: Path | None, source: str, part: str, count: int, seed: int, frames: int) -> Motion:
    """Motions (B, T): ``count`` synthetic people who walk, or whatever is in the middle window of each recorded person
    of a part (on the standard body)."""
    if source == "synthetic":
        return scenes.film("walking", count, seed=seed, frames=frames).truth
    takes = recorded(folder).part(part)
    return person_windows([take for take in takes if take.source == "cmu_library"], frames, 1).motion


def tracked(truth: Motion, hidden: int, priors: Priors, schedule: Schedule, generator: torch.Generator) -> Case:
    """Clips (B, T) whose joints are measured in 3-D, 4 cm of noise on each, but for so many frames in the middle."""
    seen = noisy(truth, generator)
    visible = seen.visible.clone()
    visible[:, (truth.frames - hidden) // 2 : (truth.frames + hidden) // 2] = False
    return _begun(replace(seen, visible=visible), truth, priors, schedule)


def _begun(seen: Observation2D | Observation3D, truth: Motion, priors: Priors, schedule: Schedule, **how) -> Case:
    begun = testops.fit(seen, priors, schedule=schedule.without_stage_3(), **how)
    states = state.from_motion(begun.stages[2])
    with torch.no_grad():
        z = infer(priors.motion, states)[0].mean
    problem = Problem(evidence(seen, **how), priors, RGB_LIGHT if how else JOINTS)
    return Case(problem, {"x": to_persistent(states), "z": z, "betas": begun.betas}, truth, begun.stages[2])


def solved(scene: Scene, priors: Priors, schedule: Schedule, frames: int) -> dict[str, Tensor]:
    """What a whole fit by shooting finds, as decoupled unknowns: the states of its roll-out, its z, its shape."""
    how = {"schedule": schedule, "solver": "shooting", "cameras": scene.cameras}
    fitted = testops.fit(part(scene.observation, slice(None), slice(frames)), priors, **how)
    first, z = fitted.first, fitted.z
    with torch.no_grad():
        states = torch.cat((first[:, None], rollout(priors.motion, first, z, with_prior=False).states), 1)
    return {"x": to_persistent(states), "z": z, "betas": fitted.betas}


# ------------------------------------------------------------------------------------------------------- the judge
@torch.no_grad()
def motions(known: Case, unknown: Unknown) -> dict[str, Motion]:
    """ "x": the persistent states as they are. "roll-out": the exact roll-out of x_0 and z."""
    kept = posed(to_states(unknown["x"]), unknown["betas"], known.problem.evidence)
    _, rolled = whole(known.problem, unknown)
    return {name: motion_of(found.body, known.truth.fps) for name, found in (("x", kept), ("roll-out", rolled))}


@torch.no_grad()
def energy(known: Case, unknown: Unknown) -> dict[str, Tensor]:
    """The energy (B,) of stage 3, of the exact roll-out, nats."""
    return {"energy": sum(whole(known.problem, unknown)[0].values()) / known.problem.weights.motion_prior[2]}


def judged(known: Case, unknown: Unknown, frames: int | None = None) -> dict[str, Tensor]:
    """Measures (B,) of what was found, of the exact roll-out and, "x ...", of the persistent states.

    "energy": of stage 3, nats. "error": of the joints in the world, cm. "legs": of knees, ankles and feet, pelvis on
    the true one, cm. "sits": 1 where somebody sits in the last ten frames. "gap": between the two, joints, cm.
    "first legs": as "x legs", of the first ``frames``, which clips of two lengths share.
    """
    x, rolled = motions(known, unknown).values()
    end = torch.zeros(rolled.root.shape[:-1], dtype=torch.bool)
    end[:, -10:] = True
    found = energy(known, unknown) | {"gap": 100 * metrics.mpjpe(x.positions, rolled.positions, align="none")}
    for name, motion in (("", rolled), ("x ", x)):
        found[f"{name}error"] = 100 * metrics.mpjpe(motion.positions, known.truth.positions, align="none")
        found[f"{name}legs"] = legs(known, motion)
        found[f"{name}sits"] = seated(motion, end).double()
    return found | {"first legs": legs(known, x, frames)}


def legs(known: Case, motion: Motion, frames: int | None = None) -> Tensor:
    """Error (B,) in cm of knees, ankles and feet, pelvis on the true one, over the first ``frames`` or all."""
    error = metrics.joint_errors(motion.positions, known.truth.positions, align="root")
    return 100 * error[:, :frames, metrics.legs(known.truth)].mean((-1, -2))


def found_again(
    known: Case, solution: Unknown, plan: Plan, evaluations: int
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """x and shape fixed at a solution, z searched from stage 2's and from the next clip's: mean absolute difference of
    every clip's z from every clip's solution (looks, B, B); and the same (B, B) of what needs no search.

    Source: thesis Fig. 3.13, "latent_motion error".
    """
    wanted, x = solution["z"], to_states(solution["x"])

    def apart(z: Tensor) -> Tensor:
        return (z[:, None] - wanted).abs().mean((-1, -2))

    model = known.problem.priors.motion
    with torch.no_grad():
        free = {"prior's mean": prior_of(model, x), "encoder's mean": infer(model, x)[0]}
    found = {}
    for name, z in {"from stage 2's z": known.start["z"], "from the next person's z": wanted.roll(-1, 0)}.items():
        how = {"watch": lambda unknown: {"z": apart(unknown["z"])}, "at": looks(evaluations)}
        run = search(known.problem, {**solution, "z": z}, plan, evaluations, **how)
        found[name] = torch.stack([seen["z"] for seen in run.watched.values()])
    return found, {name: apart(says.mean) for name, says in free.items()}


def flexion(known: Case, z: Tensor) -> Tensor:
    """Knee flexion (B,) that z says: summed over one-step decodes from the states of stage 2, degrees, mean of legs."""
    skeleton, fps, states = known.stage_2.skeleton, known.truth.fps, to_states(known.start["x"])
    with torch.no_grad():
        after = decode_ahead(known.problem.priors.motion, states[:, :-1], z)
    before, after = (metrics.tilt_and_bend(state.to_motion(x, skeleton, fps))[1] for x in (states[:, :-1], after))
    return (after - before).mean(-1).sum(-1)


def searched(known: Case, plan: Plan, evaluations: int, at: Sequence[int] = ()) -> Found:
    """A search from the start; watched after ``at`` evaluations: the energy of the exact roll-out."""
    return search(known.problem, known.start, plan, evaluations, watch=partial(energy, known), at=at)


def chosen(
    practice: Case, plan: Plan, evaluations: int, grid: Mapping[str, Sequence[float]], measure: str = "energy"
) -> Plan:
    """A plan with the settings of a grid ("rate", "weight", "share") that serve practice clips best: one batch, a row
    for every setting and clip. Whole roll-outs have no springs, and so no weight."""
    grid = {name: x for name, x in grid.items() if plan.form.steps or name != "weight"}
    settings, clips = list(product(*grid.values())), len(practice.start["x"])
    column = dict(zip(grid, torch.tensor(settings).repeat_interleave(clips, 0).T, strict=True))
    many = practice.rows(torch.arange(clips).repeat(len(settings)))
    found = search(many.problem, many.start, _set(plan, column), evaluations)
    values = judged(many, found.unknown)[measure].nan_to_num(torch.inf).view(len(settings), clips).mean(1)
    return _set(plan, dict(zip(grid, settings[int(values.argmin())], strict=True)))


def _set(plan: Plan, values: Mapping[str, object]) -> Plan:
    rest = {n: x for n, x in values.items() if n != "weight"}
    form = replace(plan.form, weight=values["weight"]) if "weight" in values else plan.form
    return replace(plan, form=form, **rest)


def settings(plans: Mapping[str, Plan]) -> list[dict[str, object]]:
    """Rows of a table: what was chosen for every search."""
    return [
        {"search": name, "step": plan.rate, "w": plan.form.weight if plan.form.steps else "-", "share": plan.share}
        for name, plan in plans.items()
    ]


def looks(evaluations: int) -> list[int]:
    """When a search is watched: often at its beginning, then after every twelfth part of what went before."""
    at = [0]
    while at[-1] < evaluations:
        at.append(min(evaluations, at[-1] + max(1, at[-1] // 12)))
    return at


def arrived(runs: Mapping[str, Found], share: float) -> dict[str, Tensor]:
    """By method: evaluations (B,) until the roll-out's energy has made ``share`` of the way from where it was first to
    the lowest that any method saw; inf where it never has."""
    energies = {name: torch.stack([seen["energy"] for seen in run.watched.values()]) for name, run in runs.items()}
    goal = torch.cat(list(energies.values())).nan_to_num(torch.inf).amin(0)
    found = {}
    for name, x in energies.items():
        at = torch.tensor([float(n) for n in runs[name].watched])
        found[name] = torch.where(x <= x[0] + share * (goal - x[0]), at[:, None], torch.inf).amin(0)
    return found


def row(found: Mapping[str, Tensor]) -> dict[str, object]:
    """The measures of :func:`judged` as cells of a table: medians over clips, and counts."""
    middle, count = {n: x.median().item() for n, x in found.items()}, len(found["sits"])
    return {
        "energy, nats": f"{middle['energy']:,.0f}",
        "legs of roll-out, cm": f"{middle['legs']:.1f}",
        "it sits": f"{found['sits'].sum():.0f} of {count}",
        "legs of x, cm": f"{middle['x legs']:.1f}",
        "x sits": f"{found['x sits'].sum():.0f} of {count}",
        "x to roll-out, cm": f"{middle['gap']:.1f}",
    }
