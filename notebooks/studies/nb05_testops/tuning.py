"""A stage 2 that is hard to beat: its smoothness, its pose prior and a filter after it, chosen together on clips of
other people."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from motionlab import metrics
from motionlab.baselines import smoothed
from motionlab.humor.energies import Weights
from motionlab.humor.evidence import Observation3D
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.motion import Motion
from motionlab.observation import Observation2D

#: Times the usual weights in stages 1 and 2, of smoothness and of the pose prior.
FACTORS, POSES = (0.03, 0.1, 0.3, 1.0, 3.0), (0.0, 0.04, 0.2, 1.0, 5.0, 25.0)
WINDOWS = (0, 5, 9, 15, 21)  # frames of the Savitzky-Golay filter, 0 for none
Seen = Observation2D | Observation3D


class Choice(NamedTuple):
    """How a stage 2 is tuned: smoothness and pose prior over the usual ones, frames of the filter after it."""

    smoothness: float
    pose: float
    window: int

    def weights(self, usual: Weights) -> Weights:
        """Returns the usual weights with smoothness and pose prior of stages 1 and 2 changed."""
        first, second, last = usual.joints3d_smooth
        smooth = (self.smoothness * first, self.smoothness * second, last)
        first, second, last = usual.pose_prior
        return replace(usual, joints3d_smooth=smooth, pose_prior=(self.pose * first, self.pose * second, last))


def search(
    practice: Seen, truth: Motion, priors: Priors, weights: Weights, schedule: Schedule, *, align: str,
    factors: Sequence[float] = FACTORS, poses: Sequence[float] = POSES, windows: Sequence[int] = WINDOWS,
    **given: object,
) -> list[dict[str, float]]:  # fmt: skip
    """Computes stage 2's mean error on practice clips (B, T), a row for each smoothness, pose prior and filter tried.

    From the usual weights on, smoothness and pose prior are tried in turn, each with every filter, until neither
    changes any more. align: "none" in the world, "root" on the true bones with the pelvis put on the true one. given:
    of the camera, goes to ``fit``.
    """
    rows, chosen = {}, Choice(1.0, 1.0, 0)

    def measure(tried: Choice) -> None:
        if tried in rows:
            return
        fitted = fit(practice, priors, weights=tried.weights(weights), schedule=schedule.without_stage_3(), **given)
        for window in windows:
            made = filtered(fitted.stages[2], window)
            made = on_true_bones(made, truth) if align == "root" else made
            error = metrics.mpjpe(made.positions, truth.positions, align=align)
            rows[tried._replace(window=window)] = 100 * error.mean().item()

    while True:
        before = chosen
        for factor in factors:
            measure(Choice(factor, chosen.pose, 0))
        chosen = min(rows, key=rows.get)
        for prior in poses:
            measure(Choice(chosen.smoothness, prior, 0))
        chosen = min(rows, key=rows.get)
        if chosen == before:
            names = ("smoothness x", "pose prior x", "filter, frames")
            return [dict(zip(names, tried, strict=True)) | {"cm": error} for tried, error in rows.items()]


def on_true_bones(motion: Motion, truth: Motion) -> Motion:
    """The motion's rotations on the true body's bones: what is left of an error is the pose's."""
    return replace(motion, skeleton=truth.skeleton)


def best(rows: Sequence[dict[str, float]]) -> Choice:
    """Returns the choice of the row with the least error."""
    row = min(rows, key=lambda row: row["cm"])
    return Choice(row["smoothness x"], row["pose prior x"], row["filter, frames"])


def said(chosen: Choice) -> str:
    """Says what was chosen."""
    after = f"filter over {chosen.window} frames" if chosen.window else "no filter"
    return f"smoothness x {chosen.smoothness:g}, pose prior x {chosen.pose:g}, {after}"


def filtered(motion: Motion, window: int) -> Motion:
    """Smooths a motion over so many frames, fewer where it is shorter; 0: as it is."""
    most = motion.frames - 1 + motion.frames % 2
    return smoothed(motion, min(window, most) if most > 2 else 0)


def stage_2(
    observed: Seen, priors: Priors, weights: Weights, schedule: Schedule, chosen: Choice, **given: object
) -> Motion:
    """Fits stage 2 with the weights and the filter that were chosen."""
    changed, schedule = chosen.weights(weights), schedule.without_stage_3()
    return filtered(fit(observed, priors, weights=changed, schedule=schedule, **given).stages[2], chosen.window)


def ways(
    observed: Seen, priors: Priors, weights: Weights, schedule: Schedule, chosen: Choice, **given: object
) -> dict[str, Motion]:
    """Fits an observation by all stages, and by stage 2 as it was tuned: motions by name."""
    fitted = fit(observed, priors, weights=weights, schedule=schedule, **given)
    found = {f"stage {k}": motion for k, motion in fitted.stages.items()}
    found["tuned stage 2"] = stage_2(observed, priors, weights, schedule, chosen, **given)
    return {name: found[name] for name in ("stage 1", "stage 2", "tuned stage 2", "stage 3")}
