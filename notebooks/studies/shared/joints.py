"""HuMoR's two tests in 3-D: joints with noise, and joints of which the low ones are hidden.

Source: HuMoR (Rempe et al. 2021), section 5.2.
"""

import torch

from motionlab.humor.evidence import Observation3D
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
