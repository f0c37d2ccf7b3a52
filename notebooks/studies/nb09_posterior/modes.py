"""The other foot forward: is there a second mode, what does the energy think of it, and what lies between?

Where legs are hidden from the first frame on, both phases of a walk explain the image. A fit finds one. Here stage 3
starts again from its result, as it is and with left and right leg exchanged, and the energy is followed along the
straight way between the two results. The highest point of that way is an upper bound of the barrier that walkers around
one of them would have to cross: a way that bends may be lower, and none was searched for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.humor import stages
from motionlab.humor import start as starts
from motionlab.humor.energies import RGB_LIGHT, Weights
from motionlab.humor.evidence import evidence
from motionlab.humor.priors import Priors
from motionlab.humor.stages import Problem, motion_terms
from motionlab.humor.testops import Fitted, Schedule
from motionlab.humor.unknowns import Unknowns, motion_of, roll
from motionlab.metrics import gait
from motionlab.metrics.gait import right_foot
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Observation2D
from motionlab.skeleton import STANDARD

_PARTS = ("hip", "knee", "ankle", "foot")
_BELOW = tuple(
    i for i, n in enumerate(BODY_25) if n.split("_", 1)[-1] in ("knee", "ankle", "big_toe", "small_toe", "heel")
)


def without_legs(observation: Observation2D) -> Observation2D:
    """Nothing detected from the knees down."""
    confidence = observation.confidence.index_fill(-1, torch.tensor(_BELOW), 0.0)
    return replace(observation, confidence=confidence)


def exchanged(motion: Motion) -> Motion:
    """Each leg turned as the other one is, in the mirror of the pelvis; all else stays."""
    left, right = (STANDARD.indices([f"{side}_{part}" for part in _PARTS]) for side in ("left", "right"))
    flip = motion.rot.new_tensor([-1.0, 1.0, 1.0])
    rot = motion.rot.clone()
    rot[..., left, :, :] = flip[:, None] * motion.rot[..., right, :, :] * flip
    rot[..., right, :, :] = flip[:, None] * motion.rot[..., left, :, :] * flip
    return replace(motion, rot=rot)


@dataclass(frozen=True, eq=False)
class Modes:
    """Two results per clip (G), the one begun from the fit and the one begun from its legs exchanged: motions (G, T),
    each clip's problem and unknowns, energies (2, G) in nats of the motion prior."""

    motions: tuple[Motion, Motion]
    problems: tuple[list[Problem], list[Problem]]
    unknowns: tuple[list[Unknowns], list[Unknowns]]
    energies: Tensor

    def between(self, index: int, share: Tensor) -> Tensor:
        """Energy (S,) of one clip along the straight way from the first result (0) to the second (1), nats. Its highest
        point bounds the barrier from above and says nothing from below."""
        a, b = (each[index].named() for each in self.unknowns)
        problem = self.problems[0][index]
        unknown = {n: torch.stack([torch.lerp(a[n][0], b[n][0], float(s)) for s in share]) for n in a}
        many = problem.rows(torch.zeros(len(share), dtype=torch.long))
        with torch.no_grad():
            return sum(motion_terms(many, Unknowns(**unknown)).values()).double() / problem.weights.motion_prior[2]

    def apart(self) -> Tensor:
        """Share of frames (G,) in which the two results have different feet forward."""
        first, second = (gait.ahead(motion) for motion in self.motions)
        return (first * second < 0).float().mean(-1)


def other_foot(
    fitted: Fitted, observation: Observation2D, priors: Priors, *, schedule: Schedule, weights: Weights = RGB_LIGHT
) -> Modes:
    """Stage 3 once more from a fit (G clips, lean mode, one window): as it is, and with the legs exchanged."""
    seen = evidence(observation, cameras=fitted.cameras)
    count = len(fitted.betas)
    twice = torch.arange(count).repeat(2)
    problem = Problem(seen.rows(twice), priors, weights)
    begin, other = fitted.motion, exchanged(fitted.motion)
    offsets = begin.skeleton.offsets.expand(count, 1, -1, -1)[twice]
    begin = replace(
        begin, skeleton=replace(begin.skeleton, offsets=offsets), root=begin.root[twice],
        rot=torch.cat((begin.rot, other.rot)), contacts=None,
    )  # fmt: skip
    with torch.no_grad():
        latent = priors.pose.encode(begin.rot[:, :, 1:]).mean
    shared = {"betas": fitted.betas[twice], "camera": torch.zeros(2 * count, 3)}
    trust = torch.ones_like(problem.evidence.trust)  # the legs it starts from are what we want it to follow
    unknown, factors = starts.start_stage_3(
        begin, latent, shared, trust, priors, (0,), begin.frames, "lean", weights.pull
    )
    found, _ = stages.stage_3(
        problem, unknown, factors, steps=schedule.steps[2], short=schedule.short, refine=schedule.refine,
        inner=schedule.inner, tolerance=schedule.tolerance,
    )  # fmt: skip
    with torch.no_grad():
        motion = motion_of(roll(found, priors, problem.evidence).body, seen.fps)
        energy = sum(motion_terms(problem, found).values()).double() / weights.motion_prior[2]
    both = [problem.rows(torch.tensor([i])) for i in range(2 * count)]
    unknowns = [found.rows(slice(i, i + 1)) for i in range(2 * count)]
    return Modes(
        (motion.clip(slice(0, count)), motion.clip(slice(count, None))), (both[:count], both[count:]),
        (unknowns[:count], unknowns[count:]), energy.unflatten(0, (2, count)),
    )  # fmt: skip


def chosen(modes: Modes, truth: Motion) -> Tensor:
    """Share of frames (G,) with the true foot forward in whichever result has the lower energy."""
    both = torch.stack([right_foot(motion, truth) for motion in modes.motions])
    return both.gather(0, modes.energies.argmin(0)[None])[0]


def rows(modes: Modes, truth: Motion, share: Tensor, names: Sequence[str]) -> list[dict[str, object]]:
    """A table: for each clip the energies of both results, the highest on the straight way between, which is an upper
    bound of the barrier, and which of the two has the true foot forward."""
    found = []
    for i, name in enumerate(names):
        way = modes.between(i, share)
        low = min(float(way[0]), float(way[-1]))
        found.append(
            {
                "clip": name,
                "frames with the other foot forward, %": f"{100 * modes.apart()[i]:.0f}",
                "energy of the second less the first, nats": f"{modes.energies[1, i] - modes.energies[0, i]:+.0f}",
                "highest point between, nats (the barrier is no higher)": f"{float(way.max()) - low:.0f}",
                "true foot forward in the first, %": f"{100 * right_foot(modes.motions[0], truth)[i]:.0f}",
                "in the second, %": f"{100 * right_foot(modes.motions[1], truth)[i]:.0f}",
            }
        )
    return found
