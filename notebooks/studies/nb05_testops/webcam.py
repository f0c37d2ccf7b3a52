"""A webcam of which nothing is known, and whether a fit moves as what it shows."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from motionlab.baselines import savitzky_golay
from motionlab.footage.fit import pixels_of
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Schedule, fit
from motionlab.io import keypoints
from motionlab.motion import FPS, Motion
from motionlab.observation import Camera, Observation2D
from studies.nb05_testops.camera_knowledge import misses, start_cameras
from studies.shared.clips import part

RECORDINGS, SIZE = ("dance_upper_body", "PRE_json"), (1280, 720)
SMOOTHED = 9  # frames of the filter over detections whose speed is measured
ROLES = {"stage 2, level camera": "stage2", "stage 3, level camera": "stage3"}
Ways = Mapping[str, tuple[Motion, Sequence[Camera]]]  # what was fitted -> motions (G, T), and where they are seen from


def clips(folder: Path | str, starts: Sequence[int], frames: int) -> Observation2D:
    """Reads clips (G, T) of a webcam recording of 3Dance, 30 fps presumed."""
    seen = keypoints.load_person(folder, fps=FPS, layout="BODY_25")
    return part(seen, torch.tensor(starts)[:, None] + torch.arange(frames))


def fitted(seen: Observation2D, priors: Priors, schedule: Schedule) -> Ways:
    """Fits clips by the camera that is assumed where nothing is known; stage 3 may then move it."""
    given = {"cameras": [None] * len(seen.keypoints), "size": SIZE}
    found = fit(seen, priors, schedule=schedule, **given)
    both = (found.stages[2], start_cameras(seen, **given)), (found.motion, found.cameras)
    return dict(zip(ROLES, both, strict=True))


def lean(motion: Motion) -> Tensor:
    """Computes the angle (..., T) in degrees of the trunk, pelvis to neck, from the vertical."""
    trunk = motion.positions[..., motion.skeleton.index("neck"), :] - motion.positions[..., 0, :]
    return torch.rad2deg(torch.acos((trunk[..., 2] / trunk.norm(dim=-1)).clamp(-1, 1)))


def seen_motion(motion: Motion, cameras: Sequence[Camera], seen: Observation2D) -> dict[str, Tensor]:
    """Computes how a fit (G, T) moves in the image, over how the detections do: "speed" and "acceleration" (G,).

    Only points that were detected in ``SMOOTHED`` frames on end count, in those frames; the detections are smoothed.
    """
    ours, theirs = pixels_of(motion, list(cameras)), savitzky_golay(seen.keypoints.flatten(-2), SMOOTHED, 2)
    theirs, there = theirs.unflatten(-1, (-1, 2)), (seen.confidence > 0).double()
    whole = there.unfold(1, SMOOTHED, 1).amin(-1)  # (G, T - 8, K): the window around each frame
    edge = SMOOTHED // 2
    ours, theirs = ours[:, edge:-edge], theirs[:, edge:-edge]
    found = {}
    for name, order in (("speed", 1), ("acceleration", 2)):
        mask = whole[:, order:] * whole[:, :-order]
        a, b = ((x.diff(n=order, dim=1).norm(dim=-1) * mask).sum((1, 2)) for x in (ours, theirs))
        found[name] = (a / b).float()
    return found


def rows(found: Mapping[str, Ways], seen: Mapping[str, Observation2D]) -> list[dict[str, object]]:
    """Returns a row per recording and fit, of what can be said without a reference."""
    made = []
    for name, ways in found.items():
        here = seen[name]
        for label, (motion, cameras) in ways.items():
            moves = seen_motion(motion, cameras, here)
            made.append({
                "recording": f"{name} ({len(here.keypoints)} clips)", "fit": label,
                "pixels off": misses(pixels_of(motion, list(cameras)), here).mean().item(),
                "trunk leans, degrees": lean(motion).median().item(),
            } | {f"{kind} / detections'": moves[kind].mean().item() for kind in ("speed", "acceleration")})  # fmt: skip
    return made
