"""HuMoR's two tests in 3-D: joints with noise, and joints of which the low ones are hidden.

Source: HuMoR (Rempe et al. 2021), section 5.2.
Differs: the hidden keypoints are joints of the 22 here, not vertices of a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from motionlab.humor.case_trials import two_stages
from motionlab.humor.observed import Observation3D
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.humor.weights import Weights
from motionlab.motion import Motion

NOISE, HEIGHT = 0.04, 0.9  # metres


def noisy(truth: Motion, generator: torch.Generator) -> Observation3D:
    """All 22 joints with N(0, 4 cm) on every coordinate."""
    points = truth.positions
    points = points + NOISE * torch.randn(points.shape, generator=generator, dtype=points.dtype)
    return Observation3D(points, torch.ones(points.shape[:-1], dtype=torch.bool), truth.fps, "noisy joints")


def low_hidden(truth: Motion) -> Observation3D:
    """Exact joints, those below 0.9 m hidden."""
    points = truth.positions
    return Observation3D(points, points[..., 2] >= HEIGHT, truth.fps, "low joints hidden")


def tuned(
    practice: Observation3D,
    truth: Motion,
    priors: Priors,
    weights: Weights,
    schedule: Schedule,
    factors: Sequence[float] = (0.1, 1.0, 10.0),
) -> Weights:
    """The weights whose smoothness, times one of the factors, gives stage 2 its least mean error in the world."""
    first, second, last = weights.joints3d_smooth
    tried = [replace(weights, joints3d_smooth=(f * first, f * second, last)) for f in factors]

    def error(weights: Weights) -> float:
        found = fit(practice, priors, weights=weights, schedule=two_stages(schedule)).stages[2].positions
        return float((found - truth.positions).norm(dim=-1).mean())

    return min(tried, key=error)
