"""A stage 2 that is hard to beat: its smoothness and a filter after it, chosen together on clips of other people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from motionlab.baselines import smoothed
from motionlab.humor.energies import Weights
from motionlab.humor.evidence import Observation3D
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, Schedule, fit
from motionlab.metrics import pose
from motionlab.motion import Motion
from motionlab.observation import Observation2D

#: Times the usual weight of smoothness in stages 1 and 2; frames of the Savitzky-Golay filter, 0 for none.
FACTORS, WINDOWS = (0.03, 0.1, 0.3, 1.0, 3.0), (0, 5, 9, 15, 21)


def grid(
    practice: Observation2D | Observation3D,
    truth: Motion,
    priors: Priors,
    weights: Weights,
    schedule: Schedule,
    *,
    align: str,
    factors: Sequence[float] = FACTORS,
    windows: Sequence[int] = WINDOWS,
    **given: object,
) -> list[dict[str, float]]:
    """Computes stage 2's mean error on practice clips (B, T) by smoothness and filter, one row for each pair.

    align: "none" in the world, "root" with the pelvis put on the true one. given: of the camera, goes to ``fit``.
    """
    rows = []
    for factor in factors:
        found = without_stage_3(practice, priors, weights, schedule, factor, **given).stages[2]
        for window in windows:
            error = pose.mpjpe(filtered(found, window).positions, truth.positions, align=align)
            rows.append({"smoothness x": factor, "filter, frames": window, "cm": 100 * error.mean().item()})
    return rows


def best(rows: Sequence[dict[str, float]]) -> tuple[float, int]:
    """Returns smoothness and filter of the row with the least error."""
    row = min(rows, key=lambda row: row["cm"])
    return row["smoothness x"], row["filter, frames"]


def said(chosen: tuple[float, int]) -> str:
    """Says what was chosen."""
    return f"smoothness x {chosen[0]:g}, " + (f"filter over {chosen[1]} frames" if chosen[1] else "no filter")


def without_stage_3(
    observed: Observation2D | Observation3D,
    priors: Priors,
    weights: Weights,
    schedule: Schedule,
    factor: float,
    **given: object,
) -> Fitted:
    """Fits stages 1 and 2 alone, with so many times the usual smoothness."""
    first, second, last = weights.joints3d_smooth
    changed = replace(weights, joints3d_smooth=(factor * first, factor * second, last))
    return fit(observed, priors, weights=changed, schedule=schedule.without_stage_3(), **given)


def filtered(motion: Motion, window: int) -> Motion:
    """Smooths a motion over so many frames, fewer where it is shorter; 0: as it is."""
    most = motion.frames - 1 + motion.frames % 2
    return smoothed(motion, min(window, most) if most > 2 else 0)


def stage_2(
    observed: Observation2D | Observation3D,
    priors: Priors,
    weights: Weights,
    schedule: Schedule,
    chosen: tuple[float, int],
    **given: object,
) -> Motion:
    """Fits stage 2 with the smoothness and the filter that were chosen."""
    factor, window = chosen
    return filtered(without_stage_3(observed, priors, weights, schedule, factor, **given).stages[2], window)


def ways(
    observed: Observation2D | Observation3D,
    priors: Priors,
    weights: Weights,
    schedule: Schedule,
    chosen: tuple[float, int],
    **given: object,
) -> dict[str, Motion]:
    """Fits an observation by all stages, and by stage 2 as it was tuned: motions by name."""
    fitted = fit(observed, priors, weights=weights, schedule=schedule, **given)
    found = {f"stage {k}": motion for k, motion in fitted.stages.items()}
    found["tuned stage 2"] = stage_2(observed, priors, weights, schedule, chosen, **given)
    return {name: found[name] for name in ("stage 1", "stage 2", "tuned stage 2", "stage 3")}
