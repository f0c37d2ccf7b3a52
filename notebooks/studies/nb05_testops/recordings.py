"""Real keypoints: Pose2Sim's person from each single view, a synthetic stand-in, and a folder of one's own."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from data_synth import scenes
from motionlab import metrics
from motionlab.body import BodyModel
from motionlab.footage.fit import landmarks_of, pixels_of
from motionlab.humor import testops
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, Schedule
from motionlab.io import keypoints, points
from motionlab.io.cameras import load_cameras
from motionlab.io.detections import to_body_25
from motionlab.motion import FPS, Motion
from motionlab.observation import BODY_25, Camera, Observation2D, at_rate
from studies.nb05_testops import over_video
from studies.nb05_testops.camera_knowledge import in_camera, misses, start_cameras
from studies.shared.clips import part, stacked

#: The twelve joints that marker tables and keypoints share, ours and Pose2Sim's name of each.
COMPARED = {
    f"{side}_{part}": f"{side[0].upper()}{part.capitalize()}"
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    for side in ("left", "right")
}
_ROWS = [BODY_25.index(name) for name in COMPARED]
HIPS = [list(COMPARED).index(f"{side}_hip") for side in ("left", "right")]
HOW = ("known", "level", "assumed")  # what a fit may know of the camera
_HEADS = {"px": "pixels off", "root": "pose, cm", "global": "in the room, cm",
          "acceleration": "acceleration / reference's"}  # fmt: skip


class Views(NamedTuple):
    """Several cameras' keypoints of the same seconds, and where the joints were.

    observation: (G, T, 25, 2) of BODY_25, 30 fps. cameras: calibrated, one per view; None: nothing is known. names: of
    the views. reference (T, 12, 3): metres, world of the cameras, joints of ``COMPARED``; None: there is none.
    pictures: of each view, frame by frame. size: of its image where there is no camera, pixels.
    """

    observation: Observation2D
    cameras: list[Camera] | None
    names: tuple[str, ...]
    reference: Tensor | None
    pictures: tuple[over_video.Pictures, ...]
    size: tuple[int, int] | None = None

    @property
    def knows(self) -> tuple[str, ...]:
        """What a fit may know of these cameras, of ``HOW``."""
        return HOW if self.cameras is not None else HOW[-1:]

    def clip(self, index: int, frames: int | None = None) -> Observation2D:
        """Returns one view's keypoints (T, 25, 2), or their first frames."""
        return part(self.observation, index, slice(frames))

    def first(self, frames: int) -> Self:
        """Returns the first frames of every view."""
        reference = None if self.reference is None else self.reference[:frames]
        return self._replace(observation=part(self.observation, slice(None), slice(frames)), reference=reference)


@cache
def pose2sim(folder: Path | str) -> Views:
    """Reads Pose2Sim's balancing person from four views at 30 fps; the reference is that of its authors."""
    folder = Path(folder)
    places = sorted((folder / "single_balancing").glob("cam*_json"))
    cameras = list(load_cameras(folder / "Calib.qca.txt").values())
    seen = [to_body_25(keypoints.load_person(p, fps=60.0, layout="BODY_25B")) for p in places]
    names = tuple(place.name.removesuffix("_json") for place in places)
    markers = points.load_trc(folder / "ref3d" / "Balancing_for_IK.trc")
    markers = markers.positions[:, [markers.names.index(name) for name in COMPARED.values()]]
    frames = min(len(markers), *(each.frames for each in seen))
    observation = at_rate(stacked([part(each, slice(frames)) for each in seen], name="single_balancing"))
    films = [folder / "videos" / f"{name}.mp4" for name in names]
    pictures = tuple(over_video.video(path, camera, 2) for path, camera in zip(films, cameras, strict=True))
    return Views(observation, cameras, names, markers[::2][: observation.frames], pictures)


def shown(own: str | None, data: Path | None, body: BodyModel, *, seed: int, fps: float = FPS, size=None) -> Views:
    """Returns the views of the first experiment: of a folder of OpenPose JSON of one's own, else Pose2Sim's, else easy
    synthetic clips, each with the picture its camera would take.

    Of one's own camera nothing is known but the size of its image: width and height in pixels; None: the least usual
    size that holds the detections.
    """
    if own:
        seen = stacked([at_rate(to_body_25(keypoints.load_person(own, fps=fps)))])
        return Views(seen, None, ("yours",), None, (over_video.blank(start_cameras(seen, size=size)[0]),), size)
    if data:
        return pose2sim(data / "pose2sim_openpose")
    scene = scenes.film("easy", 2, seed=seed, frames=30)
    pictures = tuple(over_video.staged(scene.truth.clip(k), camera, body) for k, camera in enumerate(scene.cameras))
    names = "synthetic clip 1", "synthetic clip 2"
    return Views(scene.observation, list(scene.cameras), names, None, pictures)


def given(views: Views, how: str, focal: float = 1.0, index: int | None = None) -> dict[str, object]:
    """Returns arguments of ``testops.fit`` for what it may know of the cameras of all views, or of one.

    how: "known": the calibration, and with it the floor. "level": the lens alone; the camera is taken as level, 1.2 m
    above the floor. "assumed": nothing but the size of the image. focal: times the focal length, also the assumed one.
    """
    some = start_cameras(views.observation, size=views.size) if views.cameras is None else views.cameras
    some = some if index is None else [some[index]]
    if how == "assumed":
        size = {"size": (some[0].width, some[0].height), "floor": "guess"}
        if focal == 1.0:
            return {"cameras": [None] * len(some)} | size
        some = start_cameras(views.clip(index or 0, 1), cameras=[None], **size) * len(some)
    longer = torch.tensor([[focal, 1.0, 1.0], [1.0, focal, 1.0], [1.0, 1.0, 1.0]])
    lens = [replace(c, intrinsics=c.intrinsics * longer.to(c.intrinsics)) for c in some]
    return {"cameras": lens, "floor": "camera" if how == "known" and views.cameras is not None else "guess"}


class Refits:
    """Fits of the first frames of one view by shooting, made when they are first asked for; how and focal: as of
    :func:`given`."""

    def __init__(self, views: Views, priors: Priors, schedule: Schedule | None, frames: int) -> None:
        self.views, self.frames = views, frames
        fit = partial(testops.fit, priors=priors, schedule=schedule, solver="shooting")
        self.fit = cache(lambda k, how, focal: fit(views.clip(k, frames), **given(views, how, focal, k)))

    def __call__(self, index: int, how: str, focal: float = 1.0) -> Fitted:
        """Returns the fit of a view."""
        return self.fit(index, how, focal)

    def cameras(self, stage: int, index: int, how: str, focal: float = 1.0) -> list[Camera]:
        """Returns the camera that a stage of a fit saw by: stage 3 may have moved it."""
        if stage == 3:
            return self(index, how, focal).cameras
        return start_cameras(self.views.clip(index, self.frames), **given(self.views, how, focal, index))


def camera_rows(refits: Refits, index: int, off: Callable[[Motion, Camera, Observation2D], float]) -> list[dict]:
    """Returns a row per knowledge of the camera and stage: pixels off, by a function and by the library."""
    found, seen = [], refits.views.clip(index, refits.frames)
    for how, stage in product(refits.views.knows, (2, 3)):
        (camera,) = cameras = refits.cameras(stage, index, how)
        motion = refits(index, how).stages[stage]
        row = {"camera": how, "stage": stage, "px, written above": off(motion, camera, seen)}
        found.append(row | {"library": misses(pixels_of(motion, cameras), seen).item()})
    return found


def pictured(refits: Refits, body: BodyModel, index: int, how: str, focal: float, frame: int) -> np.ndarray:
    """Draws the detections of a frame, and stages 2 and 3 of a fit as bodies, over what the camera filmed."""
    views, fitted = refits.views, refits(index, how, focal)
    frame, pictures, count = min(frame, fitted.motion.frames - 1), views.pictures[index], refits.frames
    seen = views.clip(index, count)
    panels = {"detected": over_video.detections(seen, fitted.cameras[0], pictures, [frame])[0]}
    for stage in (2, 3):
        (camera,) = cameras = refits.cameras(stage, index, how, focal)
        off = misses(pixels_of(fitted.stages[stage], cameras), seen).item()
        (drawn,) = over_video.bodies(fitted.stages[stage].clip(0), camera, pictures, f"stage{stage}", body, [frame])
        panels[f"stage {stage}: {off:.0f} px off"] = drawn
    return over_video.side_by_side(panels)


# ------------------------------------------------------------------------------------------------------------ measures
def compared(motion: Motion) -> Tensor:
    """Computes the twelve joints (..., T, 12, 3) of a fitted motion, world."""
    return landmarks_of(motion)[..., _ROWS, :]


def measured(motion: Motion, cameras: Sequence[Camera], views: Views) -> dict[str, Tensor]:
    """Measures a fit of every view (G, T): numbers (G,).

    "px": distance from the detections. "global": cm, against the reference; "root": the middle of the hips put on the
    true one. "acceleration": of the twelve joints, over the reference's.
    """
    truth = views.reference[None, : motion.frames].expand(len(cameras), -1, -1, -1)
    found, there = in_camera(cameras, compared(motion)), in_camera(views.cameras, truth)
    ours, theirs = (x[..., HIPS, :].mean(-2, keepdim=True) for x in (found, there))
    moving = metrics.mean_acceleration(compared(motion), motion.fps) / metrics.mean_acceleration(truth, motion.fps)
    return {
        "px": misses(pixels_of(motion, list(cameras)), views.observation),
        "global": 100 * (found - there).norm(dim=-1).mean((-2, -1)),
        "root": 100 * (found - ours + theirs - there).norm(dim=-1).mean((-2, -1)),
        "acceleration": moving,
    }


def rows(score: Mapping[str, Mapping[str, Tensor]]) -> list[dict[str, object]]:
    """Returns a row per method, of what ``measured`` says of it, means over the views."""
    return [
        {"method": method} | {head: numbers[name].mean().item() for name, head in _HEADS.items()}
        for method, numbers in score.items()
    ]


def panels(views: Views, motions: Mapping[str, Motion], body: BodyModel) -> dict[str, over_video.Panel]:
    """Returns a film's panels: detections, tuned stage 2 and stage 3 in the first view, which was fitted, and the third
    view."""
    here, there = ((views.cameras[k], views.pictures[k]) for k in (0, 2))
    two, three = (motions[name].clip(0) for name in ("tuned stage 2", "stage 3"))
    return {
        "camera 1: detected": partial(over_video.detections, views.clip(0), *here),
        "tuned stage 2": partial(over_video.bodies, two, *here, "stage2", body),
        "stage 3": partial(over_video.bodies, three, *here, "stage3", body),
        "the same stage 3 from camera 3": partial(over_video.bodies, three, *there, "stage3", body),
    }
