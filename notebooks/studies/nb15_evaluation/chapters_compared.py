"""The two chapters on the same clips: legs that nobody saw, by test-time optimisation and by motion diffusion.

Both get the same: noisy places of the joints above the knees, and where the floor is. TestOps' stages 1 and 2 turn
them into a pose per frame, which is what an image pipeline would have. From there stage 3 goes on by HuMoR's prior, and
a diffusion model by taking root and upper body as known; so do regression and nearest neighbour.

Source: thesis 3.2.5 and 5: HuMoR is promising but too slow; diffusion was chosen "due to the large potential speedup".
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.baselines import smoothed
from motionlab.bench import cases
from motionlab.bench.rivals import Rivals
from motionlab.diffusion.inpainting import Way, repair
from motionlab.diffusion.model import Trained
from motionlab.errors import DataError
from motionlab.humor.energies import KEYPOINTS, Weights
from motionlab.humor.evidence import Observation3D
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, Schedule, fit
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

Method = Callable[[Motion], Motion]


def above_the_knees(truth: Motion, noise: float, generator: torch.Generator) -> Observation3D:
    """Joints of clips (B, T) with N(0, noise) metres on every coordinate; knees, ankles and feet are never seen."""
    points = truth.positions
    points = points + noise * torch.randn(points.shape, generator=generator).to(points)
    visible = torch.ones(points.shape[:-1], dtype=torch.bool)
    visible[..., truth.skeleton.indices(cases.LOWER)] = False
    return Observation3D(torch.where(visible[..., None], points, 0.0), visible, truth.fps, "legs hidden")


@dataclass(frozen=True, eq=False)
class Optimised:
    """What TestOps found: motions (B, T) after stages 2 and 3, and the wall seconds of the whole batch.

    before: of stages 1 and 2. after: of stage 3. left: share of stage 3's gain in energy that its last tenth of
    iterations brought, (B,): what more work would still have changed.
    """

    stages: dict[int, Motion]
    before: float
    after: float
    left: Tensor


def optimised(seen: Observation3D, priors: Priors, schedule: Schedule, weights: Weights = KEYPOINTS) -> Optimised:
    """TestOps, lean mode, on a batch of clips."""
    found = fit(seen, priors, schedule=schedule, weights=weights)
    spent = {stage: sum(report.seconds for report in reports) for stage, reports in found.results.items()}
    if 3 not in spent:
        raise DataError(
            "no stage 3: " + "; ".join(found.notes), remedy="give a schedule with steps for it, clips of two frames"
        )
    return Optimised({k: found.stages[k] for k in (2, 3)}, spent[1] + spent[2], spent[3], _left(found))


def _left(found: Fitted) -> Tensor:
    """Of the last sub-stage of stage 3, in which everything moves."""
    energy = found.results[3][-1].history.double()  # (iterations, B), what a finished clip does not add is NaN
    filled = torch.where(energy.isfinite(), energy, torch.inf).cummin(0).values
    late = filled[-1 - max(1, len(filled) // 10)] if len(filled) > 1 else filled[0]
    return (late - filled[-1]) / (filled[0] - filled[-1]).clamp_min(1e-12)


def known_above(stage: Motion) -> Motion:
    """A pose estimate (B, T) on the standard body with its lengths, contacts not known (zeros): what is known is its
    root and the rotations above the legs; those of the legs are there, and nobody reads them."""
    contacts = stage.root.new_zeros(*stage.root.shape[:-1], len(STANDARD.contact_names))
    return Motion(STANDARD, stage.root, stage.rot, stage.fps, contacts, stage.name)


def best_window(
    practice: Motion,
    seen: Observation3D,
    priors: Priors,
    schedule: Schedule,
    *,
    weights: Weights = KEYPOINTS,
    windows: Sequence[int] = (0, 5, 7, 9, 13),
) -> int:
    """Frames of the Savitzky-Golay filter that brings stage 2 of other clips nearest to the truth where it was seen, on
    the standard body; 0: none. Jitter in what counts as known is passed on to the legs."""
    rough = fit(seen, priors, schedule=schedule.without_stage_3(), weights=weights).stages[2]

    def error(window: int) -> float:
        found = known_above(smoothed(rough, window)).positions
        return float((found - practice.positions).norm(dim=-1)[seen.visible].mean())

    return min(windows, key=error)


def by_diffusion(model: Trained, way: Way, generator: torch.Generator) -> Method:
    """Legs by a diffusion model, told or not."""

    def method(start: Motion) -> Motion:
        known = cases.columns(model.layout, cases.legs(*start.root.shape[:2]))
        return repair(model, start, known, generator, way)

    return method


def by_rival(rivals: Rivals, name: str) -> Method:
    """Legs by "mean", "nearest" or "regression"."""

    def method(start: Motion) -> Motion:
        return getattr(rivals, name)(start, cases.legs(*start.root.shape[:2]))

    return method


@dataclass(frozen=True, eq=False)
class Met:
    """motions (B, T) by method; seconds per clip that each took after stage 2, one batch, wall time."""

    motions: dict[str, Motion]
    seconds: dict[str, float]


def meet(fitted: Optimised, methods: Mapping[str, Method], window: int = 0) -> Met:
    """Stages 2 and 3 beside every method, which begins with stage 2's estimate through a filter of so many frames."""
    start, count = known_above(smoothed(fitted.stages[2], window)), len(fitted.stages[2].root)
    motions = {"stage 2": fitted.stages[2], "stage 2, filtered": start, "stage 3": fitted.stages[3]}
    seconds = {"stage 2": 0.0, "stage 2, filtered": 0.0, "stage 3": fitted.after / count}
    for name, method in methods.items():
        began = time.perf_counter()
        motions[name] = method(start)
        seconds[name] = (time.perf_counter() - began) / count
    return Met(motions, seconds)


def with_legs(seen: Observation3D, made: Motion) -> Observation3D:
    """The same observation, whose hidden joints are seen where a method put them: for a stage 3 after diffusion."""
    points = torch.where(seen.visible[..., None], seen.points, made.positions.to(seen.points))
    return replace(seen, points=points, visible=torch.ones_like(seen.visible), name="legs by diffusion")
