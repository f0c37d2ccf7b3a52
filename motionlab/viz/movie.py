"""Films of motions side by side in sync, and key poses in one picture."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import torch

from motionlab.body import BodyModel
from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.viz import gif, shapes, viewpoint
from motionlab.viz.figures import single
from motionlab.viz.palette import ROLE
from motionlab.viz.scene import Scene


@dataclass(frozen=True)
class Film:
    """A written movie; shows itself in a notebook.

    frames at fps per second play ``seconds`` of motion ``speed`` times as fast as life.
    """

    path: Path
    frames: int
    fps: float
    seconds: float
    speed: float
    bytes: int

    def _repr_html_(self) -> str:
        data = base64.b64encode(self.path.read_bytes()).decode()
        if self.path.suffix == ".gif":
            return f'<img alt="{self.path.stem}" src="data:image/gif;base64,{data}">'
        return f'<video controls loop autoplay muted src="data:video/mp4;base64,{data}"></video>'


def write(
    pictures: Sequence[np.ndarray], path: str | Path, fps: float, budget: int = 700_000
) -> tuple[int, float, int]:
    """Write pictures (H, W, 3) uint8 as a .gif that loops or an .mp4; returns its frames, rate and bytes.

    A GIF that would be larger than ``budget`` bytes gets fewer colours, then fewer frames per second; it keeps
    its length.

    Raises:
        ShapeError: no pictures. ValueError: another ending, or a rate that the format cannot play.
    """
    path = Path(path)
    if len(pictures) == 0:
        raise ShapeError(f"{path}: no pictures to write")
    step = 1
    if path.suffix == ".gif":
        for colours, step in ((127, 1), (64, 1), (64, 2), (48, 3)):
            gif.write(path, pictures[::step], fps / step, colours)
            if path.stat().st_size <= budget:
                break
    elif path.suffix == ".mp4":  # its pixels come in pairs
        height, width = (n // 2 * 2 for n in pictures[0].shape[:2])
        imageio.mimwrite(path, [p[:height, :width] for p in pictures], fps=fps, macro_block_size=2, quality=7)
    else:
        raise ValueError(f"{path}: a film ends in .gif or .mp4")
    return len(pictures[::step]), fps / step, path.stat().st_size


def stage(
    motions: Motion | Mapping[str, Motion],
    roles: Mapping[str, str] | None = None,
    body: BodyModel | None = None,
    size: tuple[int, int] | None = None,
    **view,
) -> tuple[Scene, float]:
    """A scene with a floor and one panel per motion, and the seconds until the longest has ended.

    The arguments are those of :func:`film`; ``view`` goes to :class:`~motionlab.viz.scene.Scene`.
    """
    panels = {"": motions} if isinstance(motions, Motion) else dict(motions)
    if not panels:
        raise ShapeError("no motions to show")
    roles = {label: label if label in ROLE else "ours" for label in panels} | dict(roles or {})
    seconds = max((single(motion).frames - 1) / motion.fps for motion in panels.values())
    size = size or {1: (480, 360), 2: (640, 340)}.get(len(panels), (240 * len(panels), 320))
    scene = Scene(size, panels=tuple(panels), **view).floor()
    for index, (label, motion) in enumerate(panels.items()):
        if body is None:
            scene.skeleton(motion, roles[label], panel=index)
        else:
            scene.body(body, motion, roles[label], panel=index)
    return scene, seconds


def film(
    motions: Motion | Mapping[str, Motion],
    path: str | Path,
    *,
    roles: Mapping[str, str] | None = None,
    body: BodyModel | None = None,
    size: tuple[int, int] | None = None,
    fps: float = 12.5,
    speed: float = 1.0,
    most: int = 60,
    follow: bool = False,
    azimuth: float | None = None,
) -> Film:
    """Write motions side by side in sync, each under its label, as a GIF or MP4.

    Args:
        motions: one, or label -> motion. A label that names a role has its colour, others are "ours";
            ``roles`` (label -> role) says otherwise.
        body: a ``BodyModel`` to show its skin instead of the mannequin.
        size: of the whole picture; 480 x 360 for one motion, 320 x 340 for each of two, 240 x 320 for each of more.
        fps: pictures per second. speed: times life. most: pictures; a longer motion plays faster, and the
            caption says by how much.
        follow, azimuth: see :class:`~motionlab.viz.scene.Scene`. A view that follows makes a larger GIF.

    Raises:
        ShapeError: no motions, a batch of them, or one without frames. KeyError: an unknown role.
    """
    scene, seconds = stage(motions, roles, body, size, follow=follow, azimuth=azimuth)
    count = min(int(seconds / speed * fps + 1e-6) + 1, most)
    pace = max(speed, seconds * fps / most)
    with scene:
        clock = scene.caption()
        pictures = []
        for index in range(count):
            now = index * pace / fps
            clock(f"{now:.1f} s" + (f"  ({pace:.1f} x life)" if abs(pace - 1) > 0.05 else ""))
            pictures.append(scene.image(now))
    frames, rate, size_on_disk = write(pictures, path, fps)
    return Film(Path(path), frames, rate, seconds, pace, size_on_disk)


def strip(
    motion: Motion,
    n: int = 8,
    role: str | tuple = "ours",
    *,
    body: BodyModel | None = None,
    size: tuple[int, int] = (1200, 330),
    azimuth=None,
) -> np.ndarray:
    """``n`` poses evenly through time, side by side in one picture (H, W, 3), each over its time in seconds.

    Travel is taken out; heights above the floor are kept.
    """
    frames = np.linspace(0, single(motion).frames - 1, n).round().astype(int)
    if azimuth is None:
        azimuth = viewpoint.good_azimuth(shapes.array(motion.root), viewpoint.left_of(motion), size[0] / size[1])
    turn = np.radians(azimuth)
    towards, right = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([-np.sin(turn), np.cos(turn), 0.0])
    with Scene(size, azimuth=azimuth, elevation=6.0, footroom=0.13) as scene:
        reach = shapes.array(motion.positions[frames]) - shapes.array(motion.root[frames])[:, None]
        side = reach @ right
        gap = 0.25
        step = np.concatenate(([0.0], np.cumsum(side.max(1)[:-1] - side.min(1)[1:] + gap)))
        for place, frame in zip(step, frames, strict=True):
            home = torch.tensor(place * right - [*shapes.array(motion.root[frame, :2]), 0.0]).to(motion.root)
            here = replace(motion, root=motion.root + home)
            if body is None:
                scene.skeleton(here, role, frame=int(frame))
            else:
                scene.body(body, here, role, frame=int(frame))
            scene.label(place * right + 0.25 * towards, f"{frame / motion.fps:.2f} s")
        return scene.floor().image()
