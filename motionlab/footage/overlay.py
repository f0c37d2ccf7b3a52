"""People over what filmed them: skins through the camera in front of a picture, beside the scene from the side."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from tqdm import tqdm

from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D
from motionlab.skeleton import STANDARD
from motionlab.viz.palette import INK, PAPER, blend, colour
from motionlab.viz.scene import Scene

_OPAQUE = 0.8  # of a body over a video: the person below still shows
_AREA = 640 * 480  # pixels of the picture in a film


def as_camera(picture: np.ndarray, camera: Camera, size: tuple[int, int]) -> np.ndarray:
    """Converts a picture (H, W, 3) uint8 to what a camera's image is at another size (width, height).

    A frame of another shape keeps its upper left corner and is black where the camera's image is larger.
    """
    high, wide = picture.shape[:2]
    if abs(wide * camera.height - high * camera.width) > max(camera.width, camera.height):
        inside, picture = picture[: camera.height, : camera.width], np.zeros((camera.height, camera.width, 3), np.uint8)
        picture[: inside.shape[0], : inside.shape[1]] = inside
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))


def _film_size(camera: Camera, area: float) -> tuple[int, int]:
    """Computes an even width and height of about so many pixels, within half a pixel of the camera's shape if any is.

    Rounding both to even numbers would miss the shape of a portrait, whose height counts double.
    """
    ratio = camera.height / camera.width
    wide = 2 * round((area / ratio) ** 0.5 / 2)
    some = [(w, 2 * round(w * ratio / 2)) for w in range(max(2, wide - 8), wide + 10, 2)]
    return min(some, key=lambda s: (max(abs(s[0] * ratio - s[1]), 0.5), abs(s[0] - wide)))


def bodies_over(
    motions: Sequence[Motion], camera: Camera, pictures: Iterable[np.ndarray], frames: Sequence[int],
    size: tuple[int, int], body: BodyModel, *, roles: Sequence[str | tuple],
    shown: Sequence[Sequence[bool]] | None = None, fine: bool = True,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Draws the skins of people through their camera over pictures, one per frame; whoever is nearer hides the other.

    motions: one clip per person, at one rate. pictures: (H, W, 3) uint8, those of ``frames`` in their order, of the
    size (width, height) and the camera's shape. shown: (P, T) in which frames there is somebody. fine: smooth edges.
    """
    with Scene(size, camera=camera, fine=fine) as scene:
        for k, (motion, role) in enumerate(zip(motions, roles, strict=True)):
            scene.body(body, motion, role, shadow=0, shown=None if shown is None else shown[k])
        for frame, picture in zip(frames, pictures, strict=True):
            scene.at(frame / motions[0].fps).plotter.render()
            layer = scene.plotter.screenshot(transparent_background=True, return_img=True)
            there, mixed = layer[..., 3] > 0, picture.copy()
            share = _OPAQUE * layer[there, 3:] / 255.0
            mixed[there] = share * layer[there, :3] + (1 - share) * picture[there]
            yield mixed


def labelled(picture: np.ndarray, text: str) -> np.ndarray:
    """Draws a label into the upper left corner of a picture."""
    image = Image.fromarray(picture)
    pen, font = ImageDraw.Draw(image), ImageFont.load_default(max(12, round(image.height / 28)))
    pen.rectangle(pen.textbbox((8, 6), text, font=font), fill=PAPER)
    pen.text((8, 6), text, fill=INK, font=font)
    return np.asarray(image)


def over_footage(
    motions: Sequence[Motion], camera: Camera, pictures: Iterable[np.ndarray] | None, path: str | Path, body: BodyModel,
    *, roles: Sequence[str | tuple], shown: Sequence[Sequence[bool]] | None = None, seen: Sequence[Observation2D] = (),
    ghosts: Mapping[int, tuple[Tensor, Tensor]] | None = None, area: int = _AREA, progress: str | bool = False,
) -> None:  # fmt: skip
    """Writes an MP4 of people over what their camera filmed, beside the scene from the camera's right.

    The eye on the right stands for those of whom, while they are there, at least half as much was seen as of the one
    seen best: who is mostly outside the image, and may be anywhere, does not make them small.

    Args:
        motions: one clip per person, all of one rate, which is the film's, and one length.
        pictures: one (H, W, 3) uint8 for each frame; None is paper.
        shown: (P, T) in which frames there is somebody.
        seen: detections of each person, a frame for each of the film, drawn as dots.
        ghosts: by person, where joints of other motions are in the image (K, T, 22, 2) and which are hidden (T, 22):
            their hidden limbs are drawn as lines.
        area: of the picture over the footage, pixels. progress: the name of a bar, or False.
    """
    count, fps = motions[0].frames, motions[0].fps
    size, frames = _film_size(camera, area), range(count)
    paper = np.asarray(Image.new("RGB", size, PAPER))
    below = (as_camera(p, camera, size) for p in pictures) if pictures is not None else (paper for _ in frames)
    azimuth = float(torch.rad2deg(torch.atan2(camera.rotation[0, 1], camera.rotation[0, 0])))
    wide = max(320, 2 * round(0.4 * size[1]))
    counts = [(each.confidence > 0).sum(-1).float() for each in seen]
    much = [float(n[n > 0].median()) if n.any() else 0.0 for n in counts] or [1.0] * len(motions)
    with Scene((wide, size[1]), azimuth=azimuth, panels=("from the camera's right",), fine=False) as side:
        side.floor()
        for k, (motion, role) in enumerate(zip(motions, roles, strict=True)):
            there = None if shown is None else shown[k]
            side.body(body, motion, role, shown=there, framed=2 * much[k] >= max(much))
        with imageio.get_writer(path, fps=fps, macro_block_size=2, quality=6) as film:
            drawn = bodies_over(motions, camera, below, frames, size, body, roles=roles, shown=shown, fine=False)
            for frame, front in enumerate(tqdm(drawn, progress or None, count, leave=False, disable=not progress)):
                image, scale = Image.fromarray(front), size[0] / camera.width
                for person, role in zip(seen, roles, strict=False):
                    _draw_dots(image, person, frame, scale, role)
                for k, (places, hidden) in (ghosts or {}).items():
                    if shown is None or shown[k][frame]:
                        _draw_bones(image, places[:, frame] * scale, hidden[frame], roles[k])
                text = "over the footage" if pictures is not None else "through the camera"
                film.append_data(np.concatenate((labelled(np.asarray(image), text), side.image(frame / fps)), 1))


def _draw_bones(image: Image.Image, places: Tensor, hidden: Tensor, role: str | tuple) -> None:
    """Draws the hidden bones of other motions, places (K, 22, 2), as lines, so that many of them make a cloud."""
    pen, tone = ImageDraw.Draw(image, "RGBA"), tuple(round(255 * c) for c in blend(colour(role), INK, 0.3))
    for joint in hidden.nonzero()[:, 0].tolist():
        for bone in places[:, [STANDARD.parents[joint], joint]].flatten(1):
            if bone.isfinite().all():
                pen.line(bone.tolist(), fill=(*tone, 90), width=2)


def _draw_dots(image: Image.Image, seen: Observation2D, frame: int, scale: float, role: str | tuple) -> None:
    pen, tone = ImageDraw.Draw(image), tuple(round(255 * c) for c in blend(colour(role), "white", 0.5))
    for at in (seen.keypoints[frame][seen.confidence[frame] > 0] * scale).tolist():
        pen.circle(tuple(at), 2.5, fill=tone, outline=(20, 20, 20))
