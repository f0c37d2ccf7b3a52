"""Calibrated cameras from files: the tables that ``calibrations`` reads, judged.

The lens distortion of tables goes with the camera (OpenCV's model: ``distorted``, ``undistorted``). That of Qualisys
and Captury is left out: the files seen so far have |k1| < 0.05, which moves a point by at most a few pixels near the
rim.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from kornia.geometry.calibration import distort_points

from motionlab.errors import DataError
from motionlab.io.calibrations import Table, read_tables
from motionlab.io.reading import Location, checked_array, image_size, reading
from motionlab.observation import Camera
from motionlab.rotation import exp

#: Focal lengths that lenses have, in shares of the larger side; how far a principal point may lie off the middle.
_FOCAL, _CENTRE = (0.1, 100.0), 0.1
_SHAPE = 0.02  # share by which width : height may differ, and a size that needs no scaling
_FAR = 200.0  # metres from the origin: no camera stands there
_REMEDY = "give a Qualisys XML, a Captury .calib, a TOML, OpenCV's YAML or XML, or JSON as load_camera describes it"
_ROUNDS = 100
_EXACT = 0.05  # pixels by which a point may be missed


def load_camera(
    path: str | Path, name: str | None = None, views: str | Path | None = None, size: tuple[int, int] | None = None
) -> tuple[Camera, bool]:
    """Reads a camera of a Qualisys XML, of a Captury camera.calib, or of a table as ``calibrations`` reads them.

    JSON: {"intrinsics": 3x3 in pixels, "width": W, "height": H}, where the lens bends lines "distortion": OpenCV's k1,
    k2, p1, p2, k3, and, where the camera's place is known, "rotation": 3x3 camera from world or a rotation vector, and
    "translation": 3 in metres; world z up, floor at z = 0. Also a list of such cameras, or some by name.

    Args:
        name: of the camera (a serial, or its place in a file). None: the only one, or the one whose name ends
            in the same number as the folder ``views`` has in its name.
        size: of the images, where the file may not say it.

    Returns:
        the camera, and whether its place in the world is known.
    Raises:
        DataError: not such a file, or none or several cameras that fit.
    """
    with reading(path, _REMEDY) as at:
        found = read_tables(at)
        if name is None and len(found) > 1 and views is not None and (number := re.search(r"\d+", Path(views).name)):
            last = {key: re.findall(r"\d+", key)[-1:] for key in found}
            names = [key for key, digits in last.items() if [*map(int, digits)] == [int(number[0])]]
            name = names[0] if len(names) == 1 else None
        if name is None and len(found) == 1:
            name = next(iter(found))
        if name not in found:
            what = "which of its cameras" if name is None else f"no camera {name!r}; there are"
            raise at.error(f"{what}: {', '.join(found)}", remedy="name it (--camera-name)")
        return _camera(at, name, found[name], size)


def load_cameras(path: str | Path) -> dict[str, Camera]:
    """Reads all cameras of a file by name, as :func:`load_camera` does one of them."""
    with reading(path, _REMEDY) as at:
        return {name: _camera(at, name, table)[0] for name, table in read_tables(at).items()}


def _camera(at: Location, name: str, table: Table, size: tuple[int, int] | None = None) -> tuple[Camera, bool]:
    """A camera of a table, if it can be one, and whether its place is known."""
    where = "" if name == "camera" else f"camera {name}, "  # the only one, without a name
    if size is not None and not table.keys() & {"width", "height"}:
        table = table | {"width": size[0], "height": size[1]}
    placed = bool(table.keys() & {"rotation", "translation"})
    needed = ["intrinsics", *(["rotation", "translation"] if placed else []), "width", "height"]
    if missing := [key for key in needed if key not in table]:
        raise at.error(f"no {', '.join(missing)}", remedy="add them; the size of the images also by --size")
    if "fisheye" in table:
        raise at.error("a fisheye lens", place="lens", remedy="undistort the footage (cv2.fisheye), and give that")
    width, height = (int(x) for x in image_size(at, [table["width"], table["height"]], where + "width, height"))
    k = checked_array(at, table["intrinsics"], "3 3", where + "intrinsics")
    turn, shift = np.eye(3), np.zeros(3)
    if placed:
        turn = checked_array(at, np.ravel(table["rotation"]), "N", where + "rotation")
        if len(turn) not in (3, 9):
            raise at.error(f"expected 3 or 9 numbers, got {len(turn)}", place=where + "rotation")
        turn = exp(torch.from_numpy(turn)).numpy() if len(turn) == 3 else turn.reshape(3, 3)
        shift = checked_array(at, np.ravel(table["translation"]), "3", where + "translation")
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise at.error(f"expected a rotation matrix, got {turn.tolist()}", place=where + "rotation")
    lens = checked_array(at, [*np.ravel(table.get("distortion", ())), 0.0], "N", where + "distortion").tolist()[:-1]
    if len(lens) not in (0, 1, 2, 4, 5, 8, 12, 14) or any(lens[8:]):
        message = f"{len(lens)} coefficients of a lens"
        raise at.error(message, place=where + "distortion", remedy="give k1, k2, p1, p2, k3")
    at.place = where + "intrinsics"
    _check_pixels(at, k, width, height)
    tensors = (torch.from_numpy(each).float() for each in (k, turn, shift))
    camera = Camera(*tensors, width, height, tuple(lens[:8]) if any(lens) else ())
    if placed and (far := float(camera.centre.norm())) > _FAR:
        message = f"the camera stands {far:.4g} m from the origin"
        raise at.error(message, place=where + "translation", remedy="give the translation in metres")
    return camera, placed


def _check_pixels(at: Location, k: np.ndarray, width: int, height: int) -> None:
    """Refuses intrinsics that cannot be meant, and says what may be."""
    (fx, skew, cx), (_, fy, cy) = k[:2].tolist()
    if not (fx > 0 and fy > 0):
        raise at.error("expected a positive focal length and image size")
    if not _FOCAL[0] * max(width, height) < min(fx, fy) <= max(fx, fy) < _FOCAL[1] * max(width, height):
        message = f"focal lengths of {fx:g} and {fy:g} pixels for an image of {width} x {height}"
        raise at.error(message, remedy="give them in pixels: not in mm, nor as shares of the image's size")
    if abs(skew) > 1e-3 * fx or abs(k[2, 2] - 1) > 1e-6 or np.abs(k[[1, 2, 2], [0, 0, 1]]).max() > 1e-6:
        raise at.error("expected rows fx 0 cx, 0 fy cy, 0 0 1", remedy="pixels that are skewed are not modelled")
    off, turned = (max(abs(cx / w - 0.5), abs(cy / h - 0.5)) for w, h in ((width, height), (height, width)))
    if off > _CENTRE and turned < _CENTRE / 2:
        message = f"the principal point, {cx:g} and {cy:g}, is the middle of an image of {height} x {width}"
        raise at.error(f"{message}, not of {width} x {height}", remedy="exchange width and height, or turn the images")
    if off > 1:
        raise at.error(f"the principal point, {cx:g} and {cy:g}, lies far outside the image of {width} x {height}")


def for_images(camera: Camera, size: tuple[int, int], path: Path) -> tuple[Camera, list[str]]:
    """Returns the camera for images of another size and the same shape, and what is to be said of it.

    Raises:
        DataError: images of another shape.
    """
    across, down = size[0] / camera.width, size[1] / camera.height
    if abs(across / down - 1) > _SHAPE:
        message = f"a camera for images of {camera.width} x {camera.height}, and images of {size[0]} x {size[1]}"
        remedy = "give the camera that took these images; cropped or turned ones need one of their own"
        raise DataError(message, path=path, place="width, height", remedy=remedy)
    if abs(across - 1) < _SHAPE:
        return camera, []
    k = camera.intrinsics * camera.intrinsics.new_tensor([[across], [down], [1.0]])
    note = f"the camera is for images of {camera.width} x {camera.height}: scaled to those of {size[0]} x {size[1]}"
    return replace(camera, intrinsics=k, width=size[0], height=size[1]), [note]


def distorted(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Computes where the camera's lens puts what a pinhole would put at pixels (..., 2)."""
    lens = torch.zeros(8, dtype=torch.float64)
    lens[: len(camera.distortion)] = torch.tensor(camera.distortion, dtype=torch.float64)
    points = torch.from_numpy(pixels).double()
    return distort_points(points.reshape(-1, 2), camera.intrinsics.double(), lens).reshape(points.shape).numpy()


def undistorted(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Computes where a pinhole would put what the camera's lens put at pixels (..., 2); NaN where nothing comes there.

    By fixed-point steps, from the point itself, each as far as it brings the point nearer.
    """
    found, step = pixels.astype(float), np.ones(pixels.shape[:-1])
    with np.errstate(over="ignore", invalid="ignore"):
        miss = pixels - distorted(found, camera)
        for _ in range(_ROUNDS):
            tried = found + step[..., None] * miss
            now = pixels - distorted(tried, camera)
            nearer = np.linalg.norm(now, axis=-1) < np.linalg.norm(miss, axis=-1)
            found, miss = (np.where(nearer[..., None], new, old) for new, old in ((tried, found), (now, miss)))
            step = np.where(nearer, np.minimum(2 * step, 1), step / 2)
    return np.where(np.linalg.norm(miss, axis=-1, keepdims=True) < _EXACT, found, np.nan)


def straight(pictures: Iterable[np.ndarray], camera: Camera) -> Iterator[np.ndarray]:
    """Yields pictures (H, W, 3) as a pinhole would have taken them, by the nearest pixel; black where there is none."""
    at = None
    for picture in pictures:
        high, wide = picture.shape[:2]
        if at is None or at[0].shape != (high, wide):
            scale = np.array([camera.width / wide, camera.height / high])
            there = np.stack(np.meshgrid(np.arange(wide), np.arange(high)), -1)
            from_ = np.nan_to_num(distorted(there * scale, camera) / scale, nan=-1.0, posinf=-1.0, neginf=-1.0)
            x, y = from_.round().clip(-1, max(high, wide)).astype(int).transpose(2, 0, 1)
            inside = (x >= 0) & (x < wide) & (y >= 0) & (y < high)
            at = inside, y.clip(0, high - 1), x.clip(0, wide - 1)
        yield np.where(at[0][..., None], picture[at[1], at[2]], np.uint8(0))
