"""Many cases in one fit, and the table of errors that every case gets. Clips of a batch do not touch each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from motionlab.baselines import smoothed
from motionlab.contact import with_contacts
from motionlab.humor.energies import RGB, Weights
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, Schedule, fit
from motionlab.metrics import gait, pose
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D
from motionlab.parallel import run_jobs
from studies.nb05_testops.measures import error_over_time
from studies.shared.contenders import CM, Seen


@dataclass(frozen=True, eq=False)
class CaseFit:
    """The fits of one case: motions (B, T) after stage 1, 2 and 3, contact probabilities (B, T, 9), cameras as found.

    seconds: wall time of the whole batch that these clips were fitted in, shared out evenly.
    """

    stages: dict[int, Motion]
    contacts: Tensor
    cameras: list[Camera]
    betas: Tensor
    seconds: float


def fit_together(
    seen: Mapping[str, Seen], priors: Priors, *, batch: int = 24, workers: int = 1, **how
) -> dict[str, CaseFit]:
    """Fit the clips of all cases in batches of at most ``batch``, whatever case they belong to, in as many processes.

    how: goes to ``fit``.
    """
    names = list(seen)
    counts = [len(seen[n].cameras) for n in names]
    keypoints = torch.cat([seen[n].observation.keypoints for n in names])
    confidence = torch.cat([seen[n].observation.confidence for n in names])
    cameras = [camera for n in names for camera in seen[n].cameras]
    size = min(batch, -(-len(cameras) // workers))
    parts = [slice(start, start + size) for start in range(0, len(cameras), size)]
    like = seen[names[0]].observation
    observations = [replace(like, keypoints=keypoints[part], confidence=confidence[part]) for part in parts]
    found = _fits(observations, [cameras[part] for part in parts], partial(fit, priors=priors, **how), workers)
    stages = {stage: _joined([f.stages[stage] for f in found]) for stage in found[0].stages}
    contacts, betas = torch.cat([f.contacts for f in found]), torch.cat([f.betas for f in found])
    cameras, each = [c for f in found for c in f.cameras], sum(map(seconds, found)) / len(cameras)
    ends = torch.tensor(counts).cumsum(0).tolist()
    return {
        n: CaseFit(
            {stage: motion.clip(slice(end - count, end)) for stage, motion in stages.items()},
            contacts[end - count : end], cameras[end - count : end], betas[end - count : end], each * count,
        )
        for n, count, end in zip(names, counts, ends, strict=True)
    }  # fmt: skip


def _fits(
    observations: Sequence[Observation2D], cameras: Sequence[Sequence[Camera]], one: Callable, workers: int
) -> list[Fitted]:
    """``one`` fit after the other, or so many at a time, each in a process of its own with one thread."""
    jobs = [partial(one, seen, cameras=some) for seen, some in zip(observations, cameras, strict=True)]
    return run_jobs(jobs, workers)


def seconds(fitted: Fitted) -> float:
    """Wall time that the optimiser spent on a fit."""
    return sum(report.seconds for reports in fitted.results.values() for report in reports)


def _joined(motions: Sequence[Motion]) -> Motion:
    """Batches (B, T) of motions with a skeleton per clip as one."""
    first = motions[0]
    contacts = None if first.contacts is None else torch.cat([m.contacts for m in motions])
    offsets = torch.cat([m.skeleton.offsets for m in motions])
    root, rot = torch.cat([m.root for m in motions]), torch.cat([m.rot for m in motions])
    return replace(first, skeleton=replace(first.skeleton, offsets=offsets), root=root, rot=rot, contacts=contacts)


def scores(motion: Motion, truth: Motion, seen: Tensor) -> dict[str, Tensor]:
    """Errors of a fit, one number (B,) per clip.

    cm, the pelvis put on the true one: "all", "seen", "hidden" (joints, by the mask (B, T, 22)), "legs" (knees,
    ankles, feet). "world": cm, as it stands. "acceleration": error in m/s^2. "contact F1": contacts of the motion, or
    where it has none those that follow from height and speed. "under floor": % of foot joints deeper than 3 cm.
    """
    p, t = motion.positions, truth.positions
    error = pose.joint_errors(p, t, align="root")
    on_seen, on_hidden = pose.mpjpe_visible_occluded(p, t, seen, align="root")
    touching = (motion if motion.contacts is not None else with_contacts(motion)).contacts
    feet = motion.skeleton.indices(["left_foot", "right_foot"])
    below = gait.floor_penetration(p[..., feet, :], depths=(0.03,)).frequency[..., 0]
    return {
        "all": CM * error.mean((-1, -2)),
        "seen": CM * on_seen,
        "hidden": CM * on_hidden,
        "legs": CM * error[..., gait.legs(motion)].mean((-1, -2)),
        "world": CM * pose.mpjpe(p, t, align="none"),
        "acceleration": pose.acceleration_error(p, t, truth.fps),
        "contact F1": gait.contact_scores(touching, truth.contacts).f1,
        "under floor": 100 * below,
    }


def stage_2_rows(
    practice: Mapping[str, Seen],
    priors: Priors,
    schedule: Schedule,
    *,
    smoothness: Sequence[float] = (100.0, 25.0, 6.0, 1.5),
    filters: Sequence[int] = (0, 5, 9, 15),
    workers: int = 1,
) -> list[dict[str, float]]:
    """Stage 2 at its best: mean errors over practice scenes (with ``truth`` and ``seen``) by weight and filter."""
    rows, names = [], ("all", "legs", "world", "acceleration")
    for weight in smoothness:
        tried = fit_together(
            practice,
            priors,
            schedule=schedule.without_stage_3(),
            weights=with_smoothness(weight),
            batch=80,
            workers=workers,
        )
        for window in filters:
            found = [scores(smoothed(tried[n].stages[2], window), s.truth, s.seen) for n, s in practice.items()]
            mean = {name: torch.cat([each[name] for each in found]).nanmean().item() for name in names}
            rows.append({"smoothness": weight, "filter, frames": window} | mean)
    return rows


def with_smoothness(weight: float) -> Weights:
    """The official weights for keypoints with another smoothness in stages 1 and 2."""
    return replace(RGB, joints3d_smooth=(weight, weight, 0.0))


def later_error(fit: Motion, truth: Motion, gap: Sequence[int]) -> tuple[Tensor, Tensor]:
    """World error in cm (B,) before and after frames without detections; where nothing comes after, in them.

    Before is NaN where nothing comes before.
    """
    error = CM * error_over_time(fit, truth, align="none")
    last = max(gap) + 1
    after = error[..., last:] if last < error.shape[-1] else error[..., min(gap) :]
    return error[..., : min(gap)].mean(-1), after.mean(-1)
