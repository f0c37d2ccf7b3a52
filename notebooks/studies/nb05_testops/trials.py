"""Many cases in one fit, and the table of errors that every case gets. Clips of a batch do not touch each other."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import torch
from torch import Tensor

from data_synth.legs import two_bone
from data_synth.scenes import Scene
from motionlab import metrics, rotation
from motionlab.baselines import smoothed
from motionlab.humor.energies import RGB
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.motion import Motion
from motionlab.parallel import run_jobs
from studies.nb05_testops.measures import CM
from studies.nb05_testops.tuning import Choice
from studies.shared.clips import part, stacked

#: What stage 2 is tuned over: its smoothness, the weight of its pose prior, and frames of the filter after it.
GRID = (400.0, 100.0, 25.0, 6.0, 1.5, 0.4), (0.0, 0.01, 0.04, 0.2, 1.0, 5.0), (0, 5, 9, 15, 21, 31)
#: The official weights but for smoothness, of which ``Choice.smoothness`` is the weight itself.
_UNIT = replace(RGB, joints3d_smooth=(1.0, 1.0, 0.0))


def fit_together(
    seen: Mapping[str, Scene], priors: Priors, *, batch: int = 24, workers: int = 1, **how
) -> dict[str, dict[int, Motion]]:
    """Fit the clips of all cases in batches of at most ``batch``, whatever case they belong to, in as many processes:
    by case the motions (B, T) after stages 1, 2 and 3. how: goes to ``fit``."""
    cameras = [camera for each in seen.values() for camera in each.cameras]
    every = [part(each.observation, k) for each in seen.values() for k in range(len(each.cameras))]
    every = stacked(every, camera=None, name="")
    size = min(batch, -(-len(cameras) // workers))
    parts = [slice(start, start + size) for start in range(0, len(cameras), size)]
    found = run_jobs([partial(_stages, part(every, k), priors, cameras=cameras[k], **how) for k in parts], workers)
    stages, fits, start = {k: _joined([f[k] for f in found]) for k in found[0]}, {}, 0
    for name, scene in seen.items():
        mine = slice(start, start + len(scene.cameras))
        fits[name] = {k: motion.clip(mine) for k, motion in stages.items()}
        start = mine.stop
    return fits


def _stages(*given, **how) -> dict[int, Motion]:
    return fit(*given, **how).stages


def _joined(motions: Sequence[Motion]) -> Motion:
    """Batches (B, T) of motions with a skeleton per clip as one."""
    first = motions[0]
    contacts = None if first.contacts is None else torch.cat([m.contacts for m in motions])
    offsets = torch.cat([m.skeleton.offsets for m in motions])
    root, rot = torch.cat([m.root for m in motions]), torch.cat([m.rot for m in motions])
    return replace(first, skeleton=replace(first.skeleton, offsets=offsets), root=root, rot=rot, contacts=contacts)


def scores(motion: Motion, truth: Motion) -> dict[str, Tensor]:
    """Errors of a fit, one number (B,) per clip.

    cm, the pelvis put on the true one: "all" joints, "legs" (knees, ankles, feet). "world": cm, as it stands.
    "acceleration": error in m/s^2.
    """
    p, t = motion.positions, truth.positions
    error = metrics.joint_errors(p, t, align="root")
    return {
        "all": CM * error.mean((-1, -2)),
        "legs": CM * error[..., metrics.legs(motion)].mean((-1, -2)),
        "world": CM * metrics.mpjpe(p, t, align="none"),
        "acceleration": metrics.acceleration_error(p, t, truth.fps),
    }


def tried(
    practice: Mapping[str, Scene], priors: Priors, schedule: Schedule, *, smoothness: Sequence[float] = GRID[0],
    pose: Sequence[float] = GRID[1], windows: Sequence[int] = GRID[2], **how,
) -> dict[Choice, dict[str, dict[str, Tensor]]]:  # fmt: skip
    """Scores stage 2 on practice scenes, by rival and scene: every smoothness, weight of
    the pose prior and filter. how: goes to :func:`fit_together`."""
    found = {}
    for smooth, prior in product(smoothness, pose):
        weights = Choice(smooth, prior, 0).weights(_UNIT)
        fits = fit_together(practice, priors, schedule=schedule.without_stage_3(), weights=weights, **how)
        for window in windows:
            filtered = {name: smoothed(fits[name][2], window) for name in practice}
            found[Choice(smooth, prior, window)] = {n: scores(filtered[n], s.truth) for n, s in practice.items()}
    return found


def fit_rivals(
    seen: Mapping[str, Scene], rivals: Mapping[str, Choice], priors: Priors, schedule: Schedule, **how
) -> dict[str, Motion]:
    """Fits each scene by its own rival, filter included. how: goes to :func:`fit_together`."""
    found, by_weights = {}, {}
    for name, rival in rivals.items():
        by_weights.setdefault(rival._replace(window=0), {})[name] = seen[name]
    for which, some in by_weights.items():
        fits = fit_together(some, priors, schedule=schedule.without_stage_3(), weights=which.weights(_UNIT), **how)
        found |= {n: smoothed(fits[n][2], rivals[n].window) for n in some}
    return {name: found[name] for name in seen}


def on_the_floor(motion: Motion) -> Motion:
    """Bends the legs of a fit (B, T) so that no ankle is lower than 9 cm: two bones each, knees forward.

    What a floor alone does for stage 2: the pelvis stays, the foot keeps its direction.
    """
    sole, rot, (points, turns) = 0.09, motion.rot.clone(), motion.world
    for side in metrics.SIDES:
        hip, knee, ankle = motion.skeleton.indices([f"{side}_{part}" for part in ("hip", "knee", "ankle")])
        target = points[..., ankle, :].clone()
        target[..., 2] = target[..., 2].clamp(min=sole)
        upper = (points[..., knee, :] - points[..., hip, :]).norm(dim=-1).mean(-1)
        lower = (points[..., ankle, :] - points[..., knee, :]).norm(dim=-1).mean(-1)
        for clip in range(len(rot)):
            thigh, shin, _ = two_bone(
                points[clip, :, hip], target[clip], turns[clip, :, 0, :, 0], upper[clip].item(), lower[clip].item()
            )
            low = points[clip, :, ankle, 2] < sole
            bones = points[clip, :, knee] - points[clip, :, hip], points[clip, :, ankle] - points[clip, :, knee]
            new_hip = rotation.rotation_between(bones[0], thigh) @ turns[clip, :, hip]
            new_knee = rotation.rotation_between(bones[1], shin) @ turns[clip, :, knee]
            local = (turns[clip, :, 0].mT @ new_hip, new_hip.mT @ new_knee, new_knee.mT @ turns[clip, :, ankle])
            for joint, value in zip((hip, knee, ankle), local, strict=True):
                rot[clip, :, joint] = torch.where(low[:, None, None], value, rot[clip, :, joint])
    return replace(motion, rot=rot, contacts=None)


def later_error(fit: Motion, truth: Motion, gap: Sequence[int]) -> tuple[Tensor, Tensor]:
    """World error in cm (B,) before and after frames without detections; where nothing comes after, in them.

    Before is NaN where nothing comes before.
    """
    error = CM * metrics.joint_errors(fit.positions, truth.positions, align="none").mean(-1)
    last = max(gap) + 1
    after = error[..., last:] if last < error.shape[-1] else error[..., min(gap) :]
    return error[..., : min(gap)].mean(-1), after.mean(-1)
