"""A fit to be timed: full-size networks, a person seen by a camera, the official schedule.

What a closure costs does not depend on the networks' values, so that they are random here; nor does it on what was
detected, so that the detections are the person's own with a few pixels of noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.errors import check_shape
from motionlab.humor import stages, state, variables
from motionlab.humor.cvae import Cvae
from motionlab.humor.init_gmm import SIZE, InitGmm
from motionlab.humor.observed import IGNORED, LEVEL, Evidence, View
from motionlab.humor.pose_prior import PosePrior
from motionlab.humor.priors import Priors
from motionlab.humor.shape import from_skeleton, landmarks
from motionlab.humor.testops import Schedule
from motionlab.humor.weights import RGB
from motionlab.motion import Motion

#: Of the official video demo.
OFFICIAL = Schedule(steps=(30, 80, 70))
_FOCAL, _SIZE = 1060.0, (1920, 1080)  # pixels; the official default
_AWAY = 4.0  # metres from camera to person
_NOISE = 3.0  # pixels


def random_priors(generator: torch.Generator, width: int = 1024) -> Priors:
    """Priors of the official size (or narrower) with small random weights, which require gradients."""
    models = Cvae(width), PosePrior()
    with torch.no_grad():
        for model in models:
            for weight in model.parameters():
                weight.copy_((weight.ndim == 1) * 0.02 + 0.02 * torch.randn(weight.shape, generator=generator))
    means = torch.randn(12, SIZE, generator=generator)
    return Priors(
        models[0].eval(),
        models[1].eval(),
        InitGmm(torch.full((12,), 1 / 12), means, torch.eye(SIZE).expand(12, -1, -1).clone()),
    )


def scene(motion: Motion, priors: Priors, generator: torch.Generator) -> tuple[stages.Problem, dict[str, Tensor]]:
    """The stage-3 problem of B people seen by a camera each, and unknowns near the truth, as a fit has them midway.

    motion (B, T): 22 joints, world; about 30 frames per second.
    """
    check_shape(motion.root, "B T 3", "motion.root")
    batch, frames = motion.root.shape[:2]

    def noise(*shape: int, scale: float) -> Tensor:
        return scale * torch.randn(*shape, generator=generator)

    betas = from_skeleton(motion.skeleton).expand(batch, -1)
    joints, turns = motion.world
    centre = motion.root[:, 0] * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, -_AWAY, 1.2])
    k = torch.tensor([[_FOCAL, 0.0, _SIZE[0] / 2], [0.0, _FOCAL, _SIZE[1] / 2], [0.0, 0.0, 1.0]])
    view = View(k.expand(batch, 3, 3), LEVEL.expand(batch, 3, 3), centre, _SIZE, free=True)
    pixels = view.pixels(landmarks(joints, turns, betas), torch.zeros(batch, 3))
    weight = 0.5 + 0.5 * torch.rand(batch, frames, 25, generator=generator)
    weight[..., list(IGNORED)] = 0.0
    evidence = Evidence(pixels + noise(*pixels.shape, scale=_NOISE), weight, motion.fps, view)
    first = state.unpack(state.from_motion(motion)[:, None, 0])
    unknown = {
        "trans": first["trans"],
        "orient": variables.from_matrix(first["root_orient"], "lean"),
        "latent": noise(batch, 1, 32, scale=0.5),
        "trans_vel": first["trans_vel"],
        "root_orient_vel": first["root_orient_vel"],
        "joints_vel": first["joints_vel"].flatten(-2),
        "z": noise(batch, 1, frames - 1, priors.motion.latent, scale=0.3),
        "betas": betas + noise(*betas.shape, scale=0.1),
        "camera": noise(batch, 3, scale=0.02),
    }
    problem = stages.Problem(evidence, priors, RGB)
    return problem, {name: x.detach().clone().requires_grad_() for name, x in unknown.items()}


def with_vectors(unknown: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same unknowns with rotation vectors for the 6 numbers, as the faithful rungs have them."""
    turn = variables.to_matrix(unknown["orient"].detach())
    return {**unknown, "orient": variables.from_matrix(turn, "faithful").requires_grad_()}


def poses(motion: Motion, generator: torch.Generator) -> dict[str, Tensor]:
    """The unknowns of stages 1 and 2 (G, 1, T, ...), of the same people, with rotation vectors."""
    batch, frames = motion.root.shape[:2]
    unknown = {
        "trans": motion.root[:, None],
        "orient": variables.from_matrix(motion.rot[:, None, :, 0], "faithful"),
        "latent": 0.5 * torch.randn(batch, 1, frames, 32, generator=generator),
        "betas": from_skeleton(motion.skeleton).expand(batch, -1),
        "camera": torch.zeros(batch, 3),
    }
    return {name: x.detach().clone().requires_grad_() for name, x in unknown.items()}


@dataclass(frozen=True)
class Phase:
    """A part of a fit in which every closure costs the same: its name, stage, frames and number of closures."""

    name: str
    stage: int
    frames: int
    closures: int


def phases(schedule: Schedule = OFFICIAL, frames: int = 60) -> list[Phase]:
    """The budget of closures: each outer step may take 5/4 of its iterations, torch's default limit."""
    each = schedule.inner * 5 // 4
    one, two, three = schedule.steps
    begin, end = (min(step, three) for step in schedule.refine)
    table = [
        ("stage 1", 1, frames, one),
        ("stage 2", 2, frames, two),
        (f"stage 3, first {schedule.short} frames", 3, min(schedule.short, frames), begin),
        ("stage 3, first state fixed", 3, frames, end - begin),
        ("stage 3, everything", 3, frames, three - end),
    ]
    return [Phase(name, stage, length, each * steps) for name, stage, length, steps in table if steps]
