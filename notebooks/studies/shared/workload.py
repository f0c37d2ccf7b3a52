"""A fit to be timed: full-size networks, and a person seen by a camera.

What a closure costs does not depend on the networks' values, so that they are random here; nor does it on what was
detected, so that the detections are the person's own with a few pixels of noise.
"""

from collections.abc import Callable
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from motionlab.humor import stages, state, unknowns
from motionlab.humor.body_shape import from_skeleton, landmarks
from motionlab.humor.energies import RGB, UNUSED_BODY_25
from motionlab.humor.evidence import LEVEL, Evidence, View
from motionlab.humor.priors import FIRST_STATE_SIZE, Cvae, InitGmm, PosePrior, Priors, reorder
from motionlab.humor.rollout import infer
from motionlab.humor.unknowns import Unknowns
from motionlab.motion import Motion
from studies.shared import savings
from studies.shared.savings import LEAN, Mark, Savings

_FOCAL, _SIZE = 1060.0, (1920, 1080)  # pixels; the official default
_AWAY = 4.0  # metres from camera to person
_PIXELS = 3.0  # noise of the detections
Noise = Callable[..., Tensor]


def random_priors(generator: torch.Generator, width: int = 1024) -> Priors:
    """Priors of the official size (or narrower) with small random weights, frozen."""
    models = Cvae(width).eval(), PosePrior().eval()
    with torch.no_grad():
        for model in models:
            for weight in model.parameters():
                weight.copy_((weight.ndim == 1) * 0.02 + 0.02 * torch.randn(weight.shape, generator=generator))
    reorder(models[0])  # they are drawn as official weights
    means, unit = torch.randn(12, FIRST_STATE_SIZE, generator=generator), torch.eye(FIRST_STATE_SIZE).repeat(12, 1, 1)
    return Priors(
        *(model.eval().requires_grad_(False) for model in models), InitGmm(torch.full((12,), 1 / 12), means, unit)
    )


class Part(NamedTuple):
    """Which closure: of stage 1, 2 or 3, over how many frames. Of stage 3: x0 fixed, or the contact terms left out."""

    stage: int
    frames: int
    first_fixed: bool = False
    contacts: bool = True


@dataclass(frozen=True, eq=False)
class Workload:
    """Closures of a fit of B people for T frames, midway: its unknowns are near the truth.

    still: the unknowns of stages 1 and 2. moving: those of stage 3. Rotations as 6 numbers.
    """

    problem: stages.Problem
    still: Unknowns
    moving: Unknowns

    @property
    def frames(self) -> int:
        """T."""
        return self.problem.evidence.values.shape[1]

    def to(self, dtype: torch.dtype) -> Self:
        """The same in another precision, with priors of its own; their mixture keeps its precision."""
        priors, seen = self.problem.priors, self.problem.evidence
        own = [deepcopy(model).to(dtype) for model in (priors.motion, priors.pose)]
        view = replace(seen.view, **{n: getattr(seen.view, n).to(dtype) for n in ("intrinsics", "rotation", "centre")})
        seen = replace(seen, values=seen.values.to(dtype), weight=seen.weight.to(dtype), view=view)
        still, moving = (each.map(lambda x: x.to(dtype)) for each in (self.still, self.moving))
        return Workload(replace(self.problem, evidence=seen, priors=Priors(*own, priors.initial)), still, moving)

    def unknowns(self, part: Part, on: Savings) -> Unknowns:
        """Leaves for a closure; as rotation vectors where the form of this part is written in them."""
        found = (self.moving if part.stage == 3 else self.still).named()
        if part.stage == 3:
            found["z"] = found["z"][:, : part.frames - 1]
        if not on.matrices if part.stage == 3 else on != LEAN:
            found["orient"] = unknowns.from_matrix(unknowns.to_matrix(found["orient"]), "official")
        free = {"trans", "orient"} if part.stage == 1 else found.keys() - (unknowns.FIRST if part.first_fixed else ())
        return Unknowns(**{name: x.detach().clone().requires_grad_(name in free) for name, x in found.items()})

    def closure(self, part: Part, on: Savings = LEAN, unknown: Unknowns | None = None) -> Callable[..., Tensor]:
        """What an optimiser calls again and again: ``closure(mark=...)`` -> energies (B,), gradients in ``.grad``.

        unknown: :meth:`unknowns` of this part, where somebody moves them. Stages 1 and 2 know two forms only: lean
        where ``on`` is ``savings.LEAN``, else faithful.
        """
        unknown = self.unknowns(part, on) if unknown is None else unknown
        if part.stage == 3:
            how = {"grown": part.frames == self.frames, "contacts": part.contacts}
            return lambda mark=nullcontext: savings.closure(self.problem, unknown, on, mark=mark, **how)
        problem = replace(self.problem, **({} if on == LEAN else savings.OFFICIAL))

        def pose(mark: Mark = nullcontext) -> Tensor:
            with savings.gradients(problem, unknown, on):
                with mark("body"):
                    value = sum(stages.pose_terms(problem, unknown, part.stage).values())
                with mark("backward"):
                    value.sum().backward()
            return value.detach()

        return pose


def workload(
    clip: Motion, priors: Priors, generator: torch.Generator, batch: int = 1, *, inferred: bool = False
) -> Workload:
    """The same person ``batch`` times over, each time with detections and unknowns of its own.

    clip (T,): 22 joints, world; about 30 frames per second.
    inferred: latents as the encoders of trained priors find them in the clip; otherwise noise.
    """
    motion = replace(clip, root=clip.root.repeat(batch, 1, 1), rot=clip.rot.repeat(batch, 1, 1, 1, 1), contacts=None)

    def noise(*shape: int, scale: float) -> Tensor:
        return scale * torch.randn(*shape, generator=generator)

    betas = from_skeleton(motion.skeleton).expand(batch, -1)
    states = state.from_motion(motion, causal=priors.motion.causal)
    shared = {"betas": betas + noise(*betas.shape, scale=0.1), "camera": noise(batch, 3, scale=0.02)}
    still = {"trans": motion.root, "orient": unknowns.from_matrix(motion.rot[:, :, 0], "lean")}
    still["latent"] = noise(batch, motion.frames, 32, scale=0.5)
    moving = {"latent": noise(batch, 32, scale=0.5)}
    moving["z"] = noise(batch, motion.frames - 1, priors.motion.latent, scale=0.3)
    if inferred:
        with torch.no_grad():
            still["latent"] = priors.pose.encode(motion.rot[..., 1:, :, :]).mean
            moving["latent"] = still["latent"][:, 0]
            moving["z"] = infer(priors.motion, states)[0].mean
    problem = stages.Problem(_evidence(motion, betas, noise, generator), priors, RGB)
    return Workload(problem, Unknowns(**still, **shared), unknowns.of_first_state(states[:, 0], **moving, **shared))


def _evidence(motion: Motion, betas: Tensor, noise: Noise, generator: torch.Generator) -> Evidence:
    batch, frames = motion.root.shape[:2]
    centre = motion.root[:, 0] * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, -_AWAY, 1.2])
    k = torch.tensor([[_FOCAL, 0.0, _SIZE[0] / 2], [0.0, _FOCAL, _SIZE[1] / 2], [0.0, 0.0, 1.0]])
    view = View(k.expand(batch, 3, 3), LEVEL.expand(batch, 3, 3), centre, _SIZE, free=True)
    pixels = view.pixels(landmarks(*motion.world, betas), torch.zeros(batch, 3))
    weight = 0.5 + 0.5 * torch.rand(batch, frames, 25, generator=generator)
    weight[..., list(UNUSED_BODY_25)] = 0.0
    return Evidence(pixels + noise(*pixels.shape, scale=_PIXELS), weight, motion.fps, view)
