"""People drawn through a camera over what it filmed: one picture, and films of panels side by side."""

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from PIL import Image

from motionlab.body import BodyModel
from motionlab.footage.overlay import as_camera, bodies_over, labelled
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D
from motionlab.viz.movie import Film, drawn, jpeg, write_film
from motionlab.viz.palette import PAPER
from motionlab.viz.scene import Scene
from studies.shared.overlay import overlay

WIDTH = 300  # pixels of a panel

Pictures = Callable[[int], np.ndarray]  # frame -> (H, W, 3) uint8 of the camera's shape
Panel = Callable[[Sequence[int]], list[np.ndarray]]  # of a film: frames -> pictures


def shape(camera: Camera) -> tuple[int, int]:
    """Returns width and height of a picture of a camera."""
    return WIDTH, round(WIDTH * camera.height / camera.width)


def video(path: Path, camera: Camera, step: int) -> Pictures:
    """Returns every ``step``-th frame of a video, read when the first is asked for, past the end the last one; a frame
    narrower than the camera's image is black at its right."""

    @cache
    def frames() -> list[np.ndarray]:
        with imageio.get_reader(path) as reader:
            return [as_camera(picture, camera, shape(camera)) for k, picture in enumerate(reader) if k % step == 0]

    return lambda frame: frames()[min(frame, len(frames()) - 1)]


def blank(camera: Camera) -> Pictures:
    """Returns paper, for keypoints whose video nobody has."""
    paper = np.asarray(Image.new("RGB", shape(camera), PAPER))
    return lambda frame: paper


def staged(motion: Motion, camera: Camera, body: BodyModel) -> Pictures:
    """Returns what a camera would film of a motion on a floor: for people who are synthetic."""

    def picture(frame: int) -> np.ndarray:
        with Scene(shape(camera), camera=camera) as scene:
            return scene.floor().body(body, motion, "truth", frame=frame).image()

    return picture


def bodies(
    motion: Motion, camera: Camera, pictures: Pictures, role: str, body: BodyModel, frames: Sequence[int]
) -> list[np.ndarray]:
    """Draws a motion's skin through a camera over the pictures of some frames."""
    how = {"size": pictures(frames[0]).shape[1::-1], "roles": [role]}
    return list(bodies_over([motion], camera, map(pictures, frames), frames, body=body, **how))


def detections(seen: Observation2D, camera: Camera, pictures: Pictures, frames: Sequence[int]) -> list[np.ndarray]:
    """Draws keypoints over the pictures of some frames."""
    seen, wide = replace(seen, camera=camera), max(2.5, pictures(frames[0]).shape[1] / 250)
    return [overlay(seen, pictures(frame), frame, wide) for frame in frames]


def side_by_side(panels: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns pictures of one height side by side, each under its label."""
    return np.concatenate([labelled(picture, label) for label, picture in panels.items()], 1)


@dataclass(frozen=True, eq=False)
class Photo:
    """A picture (H, W, 3) uint8 that a page shows as a JPEG, as photographs want it."""

    picture: np.ndarray

    def _repr_html_(self) -> str:
        return f'<img src="data:image/jpeg;base64,{base64.b64encode(jpeg(self.picture, 85)).decode()}">'


def film(panels: Mapping[str, Panel], count: int, fps: float, path: Path) -> Film:
    """Writes panels as an MP4 at the speed of life."""
    frames = [int(frame) for frame in drawn(np.arange(count))]
    rows = [panel(frames) for panel in panels.values()]
    pictures = [side_by_side(dict(zip(panels, row, strict=True))) for row in zip(*rows, strict=True)]
    return write_film(pictures, path, fps * len(pictures) / count, count / fps)  # a draft keeps its length
