"""HuMoR's two tests in 3-D: joints with noise, and joints of which the low ones are hidden.

Source: HuMoR (Rempe et al. 2021), section 5.2.
Differs: the hidden keypoints are joints of the 22 here, not vertices of a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from motionlab.humor.energies import Weights
from motionlab.humor.evidence import Observation3D
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.motion import Motion


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
        found = fit(practice, priors, weights=weights, schedule=schedule.without_stage_3()).stages[2].positions
        return float((found - truth.positions).norm(dim=-1).mean())

    return min(tried, key=error)
