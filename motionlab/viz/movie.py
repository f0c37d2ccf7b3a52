"""Films of motions side by side in sync, and key poses in one picture."""

import base64
import io
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import torch
from PIL import Image
from torch import Tensor
from tqdm.auto import tqdm

from motionlab import viz
from motionlab.body import BodyModel
from motionlab.errors import ShapeError
from motionlab.motion import Motion, single
from motionlab.viz import mannequin, viewpoint
from motionlab.viz.palette import ROLE
from motionlab.viz.scene import Scene

Mesh = tuple[Tensor, Tensor]  # vertices (1, V, 3), faces (F, 3)
_WOOD, _GHOST = "#b9a88f", (0.35, 0.35, 0.35)
_DRAFT = 5  # pictures of a film that is only drawn to see that it draws
_FINE = 2  # drawn twice as large and reduced: smooth edges


def drawn(times: np.ndarray) -> np.ndarray:
    """Returns the times (N,) at which a film's pictures are drawn: all, or for a draft a few, both ends among them."""
    count = min(len(times), _DRAFT) if viz.draft else len(times)
    return times[np.linspace(0, len(times) - 1, count).round().astype(int)]


def meshes(occluders: Sequence[object]) -> list[Mesh]:
    """Returns the meshes of things that do not move."""
    return [(o.vertices, o.faces) for o in occluders]


def data_url(kind: str, content: bytes) -> str:
    """Returns content of a kind, such as "image/png", as a URL that holds it."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


@dataclass(frozen=True)
class Film:
    """A written movie of ``seconds`` of motion, ``speed`` times as fast as life; shows itself in a notebook.

    poster: a JPEG of the frame in the middle, which a page shows before the film plays or where it cannot.
    """

    path: Path
    seconds: float
    speed: float
    poster: bytes

    def _repr_html_(self) -> str:
        still, film = data_url("image/jpeg", self.poster), data_url("video/mp4", self.path.read_bytes())
        look = f'controls loop autoplay muted playsinline style="max-width:100%" poster="{still}"'
        return f'<video {look} src="{film}"></video>'


def write_film(
    pictures: Sequence[np.ndarray], path: str | Path, fps: float, seconds: float, speed: float = 1.0
) -> Film:
    """Writes pictures (H, W, 3) uint8 as an .mp4; ``seconds`` and ``speed`` as of :class:`Film`.

    Raises:
        ShapeError: no pictures. ValueError: another ending.
    """
    path = Path(path)
    if len(pictures) == 0:
        raise ShapeError(f"{path}: no pictures to write")
    if path.suffix != ".mp4":
        raise ValueError(f"{path}: a film ends in .mp4")
    height, width = (n // 2 * 2 for n in pictures[0].shape[:2])  # its pixels come in pairs
    imageio.mimwrite(path, [p[:height, :width] for p in pictures], fps=fps, macro_block_size=2, quality=6)
    return Film(path, seconds, speed, jpeg(pictures[len(pictures) // 2]))


def stage(
    motions: Motion | Mapping[str, Motion], roles: Mapping[str, str] | None = None, body: BodyModel | None = None,
    size: tuple[int, int] | None = None, *, things: Sequence[Mesh] = (), ghost: Motion | None = None, **view,
) -> tuple[Scene, float]:  # fmt: skip
    """Builds a scene with a floor and one panel per motion; returns it and the seconds until the longest has ended.

    Args:
        motions, roles, body: as of :func:`film`.
        things: what stood there and hid somebody, translucent in every panel: see :func:`meshes`.
        ghost: a motion that stands, grey and translucent, in every other panel than its own: the truth.
        view: of :class:`~motionlab.viz.scene.Scene`, as follow and azimuth.
    """
    panels, roles = _cast(motions, roles)
    seconds = max((single(motion).frames - 1) / motion.fps for motion in panels.values())
    scene = Scene(size, panels=tuple(panels), **view).floor()
    for panel, (label, motion) in enumerate(panels.items()):
        _add(scene, motion, roles[label], body, None if motion is ghost else ghost, panel=panel)
        for vertices, faces in things:
            scene.mesh(vertices[0].numpy(), faces.numpy(), _WOOD, opacity=0.35, framed=False, panel=panel)
    return scene, seconds


def _cast(motions, roles) -> tuple[dict[str, Motion], dict[str, str]]:
    """Label -> motion, and label -> role."""
    panels = {"": motions} if isinstance(motions, Motion) else dict(motions)
    if not panels:
        raise ShapeError("no motions to show")
    return panels, {label: label if label in ROLE else "ours" for label in panels} | dict(roles or {})


def _add(scene: Scene, motion: Motion, role, body: BodyModel | None, ghost: Motion | None, **how) -> None:
    """A motion and, translucent, what it is compared with."""
    add = scene.skeleton if body is None else partial(scene.body, body)
    add(motion, role, **how)
    if ghost is not None:
        add(ghost, _GHOST, **how | {"opacity": 0.35, "shadow": 0, "framed": False})


def film(
    motions: Motion | Mapping[str, Motion], path: str | Path, *, roles: Mapping[str, str] | None = None,
    body: BodyModel | None = None, size: tuple[int, int] | None = None, fps: float | None = None, speed: float = 1.0,
    most: int = 300, progress: bool | None = None, **view,
) -> Film:  # fmt: skip
    """Writes motions side by side in sync, each under its label, as an MP4.

    Args:
        motions: one, or label -> motion. A label that names a role has its colour, others are "ours";
            ``roles`` (label -> role) says otherwise.
        body: a ``BodyModel`` to show its skin instead of the mannequin.
        size: of the whole picture; by default 480 x 420 for each motion.
        fps: pictures per second; by default the motion's own rate, 30 at most. speed: times life.
        most: pictures; a longer motion plays faster, and the caption says by how much.
        progress: a bar; by default where somebody watches.
        view: ``things``, ``ghost``, and the eye's ``follow``, ``azimuth``, ``elevation``, as of :func:`stage`.

    Raises:
        ShapeError: no motions, a batch of them, or one without frames. KeyError: an unknown role.
    """
    shown, path = [motions] if isinstance(motions, Motion) else list(motions.values()), Path(path)
    fps = fps or min(30.0, max((m.fps for m in shown), default=30.0))
    fine = 1 if viz.draft else _FINE  # a third faster than a scene that smooths its own edges
    width, height = (fine * n for n in size or (480 * len(shown), 420))
    scene, seconds = stage(motions, roles, body, (width, height), **view)
    scene.smooth(False)
    count = min(int(seconds / speed * fps + 1e-6) + 1, most)
    pace = max(speed, seconds * fps / most)
    if progress is None:  # somebody sees a bar in a terminal, or in a notebook that is not run in a batch
        progress = not os.environ.get("MOTIONLAB_BATCH") and ("ipykernel" in sys.modules or sys.stderr.isatty())
    with scene:
        clock = scene.caption()
        pictures = []
        for now in tqdm(drawn(np.arange(count) * pace / fps), f"film {path.name}", leave=False, disable=not progress):
            clock(f"{now:.1f} s" + (f"  ({pace:.1f} x life)" if abs(pace - 1) > 0.05 else ""))
            pictures.append(np.asarray(Image.fromarray(scene.image(float(now))).reduce(fine)))
    return write_film(pictures, path, fps * len(pictures) / count, seconds, pace)  # a draft keeps its length


def jpeg(picture: np.ndarray, quality: int = 80) -> bytes:
    """Returns a picture (H, W, 3) uint8 as a JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "jpeg", quality=quality, subsampling=0)
    return buffer.getvalue()


def strip(
    motions: Motion | Mapping[str, Motion], n: int = 8, role: str | tuple = "ours", *,
    roles: Mapping[str, str] | None = None, body: BodyModel | None = None, ghost: Motion | None = None,
    size: tuple[int, int] = (1200, 330), azimuth: float | None = None,
) -> np.ndarray:  # fmt: skip
    """Draws ``n`` poses evenly through time, side by side in one picture (H, W, 3), each over its time in seconds
    (a single frame has none).

    Travel is taken out; heights above the floor are kept, and who flies off leaves the picture. Several motions
    (label -> motion) are rows of ``size`` each, in colours as of :func:`film`; a ``ghost`` stands as far off as it is.
    """
    panels, roles = _cast(motions, {"": role} | dict(roles or {}))
    if azimuth is None:
        first = single(next(iter(panels.values())))
        azimuth = viewpoint.good_azimuth(mannequin.array(first.root), viewpoint.left_of(first), size[0] / size[1])
    turn, rows = np.radians(azimuth), []
    towards, right = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([-np.sin(turn), np.cos(turn), 0.0])
    for label, motion in panels.items():
        frames = np.linspace(0, single(motion).frames - 1, n).round().astype(int)
        root, both = mannequin.array(motion.root[frames]), (motion, None if motion is ghost else ghost)
        side = (mannequin.array(motion.positions[frames]) - root[:, None]) @ right
        step = np.concatenate(([0.0], np.cumsum(side.max(1)[:-1] - side.min(1)[1:] + 0.25)))
        with Scene(size, panels=(label,), azimuth=azimuth, elevation=6.0, footroom=0.13) as scene:
            for place, frame, at in zip(step, frames, root, strict=True):
                home = torch.tensor(place * right - [*at[:2], 0.0]).to(motion.root)
                here, beside = (m and replace(m, root=m.root + home) for m in both)
                near = at[2] < root[:, 2].min() + 1.5
                _add(scene, here, roles[label], body, beside, frame=int(frame), framed=near)
                if motion.frames > 1:
                    scene.label(place * right + 0.25 * towards, f"{frame / motion.fps:.2f} s")
            rows.append(scene.floor().image())
    return np.concatenate(rows)
