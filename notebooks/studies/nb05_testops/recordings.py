"""Recordings of real people against references: Pose2Sim's person from each single view, a webcam without reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.errors import DataError, ShapeError
from motionlab.fit import landmarks_of, pixel_distances, pixels_of
from motionlab.humor import testops
from motionlab.humor.evidence import evidence
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, Schedule
from motionlab.io import openpose, points
from motionlab.io.cameras import load_qualisys
from motionlab.metrics import pose
from motionlab.motion import FPS, Motion
from motionlab.observation import BODY_25, Camera, Observation2D, at_rate

#: The twelve joints that marker tables and keypoints share, ours and Pose2Sim's name of each.
COMPARED = {
    f"{side}_{part}": f"{side[0].upper()}{part.capitalize()}"
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    for side in ("left", "right")
}
_HIPS = [list(COMPARED).index(f"{side}_hip") for side in ("left", "right")]


class Views(NamedTuple):
    """Several cameras' keypoints of the same seconds, and where the joints were.

    observation: (G, T, 25, 2) of BODY_25, 30 fps. cameras: calibrated, one per view. names: of the views.
    reference (T, 12, 3): metres, world of the cameras; joints of ``COMPARED``.
    """

    observation: Observation2D
    cameras: list[Camera]
    names: tuple[str, ...]
    reference: Tensor


def pose2sim(folder: Path | str, *, trial: str = "single_balancing") -> Views:
    """Pose2Sim's balancing person from four views at 30 fps, with the triangulated and filtered markers.

    folder: ``pose2sim_openpose`` of the data set. Only the frames that the reference has.

    Raises:
        DataError: a file cannot be read, or there are not as many cameras as views.
    """
    folder = Path(folder)
    places = sorted((folder / trial).glob("cam*_json"))
    cameras = list(load_qualisys(folder / "Calib.qca.txt").values())
    if not places or len(places) != len(cameras):
        message = f"{len(places)} views and {len(cameras)} cameras"
        raise DataError(message, path=folder / trial, remedy="unpack the data set again")
    tables = sorted((folder / "ref3d").glob("*.trc"))
    if not tables:
        raise DataError("no .trc file in it", path=folder / "ref3d", remedy="unpack the data set again")
    markers = points.load_trc(tables[0])
    seen = [openpose.load(place, fps=markers.fps, layout="BODY_25B") for place in places]
    frames = min(markers.frames, *(each.frames for each in seen))
    seen = [openpose.to_body_25(each, midpoints=True) for each in seen]
    whole = replace(
        seen[0],
        keypoints=torch.stack([each.keypoints[:frames] for each in seen]),
        confidence=torch.stack([each.confidence[:frames] for each in seen]),
        name=trial,
    )
    step = round(markers.fps / FPS)
    if abs(markers.fps / step - FPS) > 1e-3 * FPS:
        raise DataError(f"{markers.fps:g} frames per second", path=tables[0], remedy="a multiple of 30 is expected")
    observation = at_rate(whole)
    reference = markers.select(list(COMPARED.values())).positions[:frames:step][: observation.frames]
    return Views(observation, cameras, tuple(place.name.removesuffix("_json") for place in places), reference)


def fit_views(
    views: Views, priors: Priors, *, camera: str = "known", schedule: Schedule | None = None, **options
) -> Fitted:
    """Every view fitted for itself (all in one batch).

    camera: "known": the calibration, and with it the floor. "intrinsics": level cameras at a guessed height with the
    calibration's intrinsics. "assumed": nothing, not even the focal length.
    """
    return testops.fit(views.observation, priors, schedule=schedule, **_given(views, camera), **options)


def _given(views: Views, camera: str) -> dict[str, object]:
    if camera not in ("known", "intrinsics", "assumed"):
        raise ValueError(f'camera: expected "known", "intrinsics" or "assumed", got {camera!r}')
    return {
        "cameras": None if camera == "assumed" else views.cameras,
        "size": (views.cameras[0].width, views.cameras[0].height),
        "floor": "camera" if camera == "known" else "guess",
    }


def start_cameras(observation: Observation2D, **given: object) -> list[Camera]:
    """The cameras that a fit starts from, and keeps until stage 3 moves them; arguments as of ``testops.fit``."""
    seen = evidence(observation, **given)
    return seen.view.cameras(seen.values.new_zeros(len(seen.values), 3))


def compared(motion: Motion) -> Tensor:
    """The twelve joints (..., T, 12, 3) of a fitted motion, world."""
    return landmarks_of(motion)[..., [BODY_25.index(name) for name in COMPARED], :]


def in_camera(cameras: Sequence[Camera], points: Tensor) -> Tensor:
    """World points (G, T, K, 3) in the axes of each view's camera."""
    turn, shift = (torch.stack([getattr(c, n) for c in cameras]).to(points) for n in ("rotation", "translation"))
    return points @ turn[:, None].mT + shift[:, None, None]


def errors(predicted: Tensor, truth: Tensor) -> dict[str, Tensor]:
    """Mean distance (G,) in cm of joints (G, T, 12, 3): as they are, hips' middle on the true one, and frame by frame
    after the best rotation and shift (rigid), or with the best scale as well (Procrustes)."""
    ours, theirs = (x[..., _HIPS, :].mean(-2, keepdim=True) for x in (predicted, truth))
    found = {"global": predicted, "root": predicted - ours + theirs}
    found |= {
        "rigid": pose.align_procrustes(predicted, truth, scale=False),
        "procrustes": pose.align_procrustes(predicted, truth, scale=True),
    }
    return {name: 100 * (points - truth).norm(dim=-1).mean((-2, -1)) for name, points in found.items()}


def rows(fitted: Fitted, views: Views, camera: str = "known") -> list[dict[str, object]]:
    """One row per view and stage: px, and in cm the error of the twelve joints, in the axes of the view's camera.

    There the true and the found world agree, whatever is known of the camera: with a known one "global" is the error
    in the room, else it holds the wrong distance too. camera: as the fit had it.
    """
    if len(fitted.motion.root) != len(views.names):
        raise ShapeError(f"{len(fitted.motion.root)} fits of {len(views.names)} views")
    count = fitted.motion.frames
    truth = in_camera(views.cameras, views.reference[None, :count].expand(len(views.names), -1, -1, -1))
    before, found = start_cameras(views.observation, **_given(views, camera)), []
    for stage, motion in fitted.stages.items():
        if stage == 1:
            continue
        cameras = before if stage == 2 else fitted.cameras
        error = errors(in_camera(cameras, compared(motion)), truth)
        away, weight = pixel_distances(pixels_of(motion, cameras), views.observation)
        acceleration = pose.mean_acceleration(motion.positions, motion.fps)
        for v, view in enumerate(views.names):
            found.append(
                {"view": view, "stage": stage, "frames": count}
                | {"px": float((away[v] * weight[v]).sum() / weight[v].sum())}
                | {name: float(value[v]) for name, value in error.items()}
                | {"acceleration": float(acceleration[v])}
            )
    return sorted(found, key=lambda row: (row["view"], row["stage"]))


def monocular_rows(
    folder: Path | str, priors: Priors, *, camera: str = "known", schedule: Schedule | None = None, **options
) -> list[dict[str, object]]:
    """Pose2Sim's person from each single view, stage 2 against stage 3; see :func:`rows` and :func:`fit_views`."""
    views = pose2sim(folder)
    return rows(fit_views(views, priors, camera=camera, schedule=schedule, **options), views, camera)


def webcam(folder: Path | str, start: int = 0, frames: int | None = None) -> Observation2D:
    """A webcam recording of 3Dance (BODY_25, 30 fps presumed), or some frames of it."""
    seen = openpose.load(folder, fps=FPS, layout="BODY_25")
    stop = seen.frames if frames is None else start + frames
    return replace(seen, keypoints=seen.keypoints[start:stop], confidence=seen.confidence[start:stop])


def webcam_rows(fitted: Fitted, observation: Observation2D, **given: object) -> list[dict[str, object]]:
    """One row per stage of a fit without reference: px, acceleration, and how far feet and pelvis are from the floor.

    given: what the fit was given of the camera (cameras, floor, size). px: of what was detected. lowest: median over
    frames of the lowest joint's height in cm. pelvis: its median height in cm.
    """
    before, found = start_cameras(observation, **given), []
    for stage, motion in fitted.stages.items():
        if stage == 1:
            continue
        away, weight = pixel_distances(pixels_of(motion, before if stage == 2 else fitted.cameras), observation)
        height = motion.positions[..., 2]
        found.append({
            "stage": stage,
            "frames": motion.frames,
            "px": float((away * weight).sum() / weight.sum()),
            "acceleration": float(pose.mean_acceleration(motion.positions, motion.fps).mean()),
            "lowest": 100 * float(height.amin(-1).median()),
            "pelvis": 100 * float(height[..., 0].median()),
        })  # fmt: skip
    return found
