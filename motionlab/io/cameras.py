"""Calibrated cameras from files: Qualisys XML, Captury's camera.calib, and the tables that ``calibrations`` reads.

The lens distortion of tables goes with the camera, see ``lens``. That of Qualisys and Captury is left out: the files
seen so far have |k1| < 0.05, which moves a point by at most a few pixels near the rim.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from motionlab.errors import DataError
from motionlab.io.calibrations import Table, read_tables
from motionlab.io.points import axes_to_matrix
from motionlab.io.reading import Spot, image_size, numbers, read_bytes, read_text, reading
from motionlab.observation import Camera
from motionlab.rotation import exp

#: Qualisys gives image positions in 64ths of a pixel.
_QUALISYS_PIXEL = 64.0
#: Focal lengths that lenses have, in shares of the larger side; how far a principal point may lie off the middle.
_FOCAL, _CENTRE = (0.1, 100.0), 0.1
_SHAPE = 0.02  # share by which width : height may differ, and a size that needs no scaling
_FAR = 200.0  # metres from the origin: no camera stands there
#: From Qualisys' camera axes (x right, y up, z backward) to ours (x right, y down, z forward).
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


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
    remedy = "give a Qualisys XML, a Captury .calib, a TOML, OpenCV's YAML or XML, or JSON as load_camera describes it"
    with reading(path, remedy) as at:
        found = read_tables(at)
        if found is None and read_bytes(at).lstrip().startswith(b"tc camera calibration"):
            found = {str(i): camera for i, camera in enumerate(load_captury(path, width=1920))}
        elif found is None:
            found = load_qualisys(path)
        if not found:
            raise at.error("no camera in it")
        if name is None and len(found) > 1 and views is not None:
            number = re.search(r"\d+", Path(views).name)
            names = [key for key in found if number and re.findall(r"\d+", key)[-1:] and
                     int(re.findall(r"\d+", key)[-1]) == int(number.group())]  # fmt: skip
            name = names[0] if len(names) == 1 else None
        if name is None and len(found) == 1:
            name = next(iter(found))
        if name not in found:
            what = "which of its cameras" if name is None else f"no camera {name!r}; there are"
            raise at.error(f"{what}: {', '.join(found)}", remedy="name it (--camera-name)")
        camera = found[name]
        return (camera, True) if isinstance(camera, Camera) else _of_table(at, camera, size)


def _of_table(at: Spot, table: Table, size: tuple[int, int] | None) -> tuple[Camera, bool]:
    """A camera of a table, if it can be one."""
    if size is not None and not table.keys() & {"width", "height"}:
        table = table | {"width": size[0], "height": size[1]}
    placed = bool(table.keys() & {"rotation", "translation"})
    needed = ["intrinsics", *(["rotation", "translation"] if placed else []), "width", "height"]
    if missing := [key for key in needed if key not in table]:
        raise at.error(f"no {', '.join(missing)}", remedy="add them; the size of the images also by --size")
    if "fisheye" in table:
        raise at.error("a fisheye lens", place="lens", remedy="undistort the footage (cv2.fisheye), and give that")
    width, height = (int(x) for x in image_size(at, [table["width"], table["height"]], "width, height"))
    k = torch.from_numpy(numbers(at, table["intrinsics"], "3 3", "intrinsics"))
    turn, shift = torch.eye(3).double(), torch.zeros(3).double()
    if placed:
        flat = np.asarray(numbers(at, np.ravel(table["rotation"]), "N", "rotation"))
        if len(flat) not in (3, 9):
            raise at.error(f"expected 3 or 9 numbers, got {len(flat)}", place="rotation")
        flat = torch.from_numpy(flat)
        turn = exp(flat) if len(flat) == 3 else flat.reshape(3, 3)
        shift = torch.from_numpy(numbers(at, np.ravel(table["translation"]), "3", "translation"))
    at.place = "rotation"
    _rotation(at, turn)
    lens = numbers(at, [*np.ravel(table.get("distortion", ())), 0.0], "N", "distortion").tolist()[:-1]
    if len(lens) not in (0, 1, 2, 4, 5, 8, 12, 14) or any(lens[8:]):
        raise at.error(f"{len(lens)} coefficients of a lens", place="distortion", remedy="give k1, k2, p1, p2, k3")
    camera = Camera(k.float(), turn.float(), shift.float(), width, height, tuple(lens[:8]) if any(lens) else ())
    _check(at, camera, placed)
    return camera, placed


def _check(at: Spot, camera: Camera, placed: bool) -> None:
    """Refuses a camera that cannot be meant, and says what may be."""
    k, width, height = camera.intrinsics.double(), camera.width, camera.height
    (fx, skew, cx), (_, fy, cy) = k[:2].tolist()
    at.place = "intrinsics"
    if not (fx > 0 and fy > 0):
        raise at.error("expected a positive focal length and image size")
    if not _FOCAL[0] * max(width, height) < min(fx, fy) <= max(fx, fy) < _FOCAL[1] * max(width, height):
        message = f"focal lengths of {fx:g} and {fy:g} pixels for an image of {width} x {height}"
        raise at.error(message, remedy="give them in pixels: not in mm, nor as shares of the image's size")
    if abs(skew) > 1e-3 * fx or abs(k[2, 2] - 1) > 1e-6 or k[[1, 2, 2], [0, 0, 1]].abs().max() > 1e-6:
        raise at.error("expected rows fx 0 cx, 0 fy cy, 0 0 1", remedy="pixels that are skewed are not modelled")
    off, turned = (max(abs(cx / w - 0.5), abs(cy / h - 0.5)) for w, h in ((width, height), (height, width)))
    if off > _CENTRE and turned < _CENTRE / 2:
        message = f"the principal point, {cx:g} and {cy:g}, is the middle of an image of {height} x {width}"
        raise at.error(f"{message}, not of {width} x {height}", remedy="exchange width and height, or turn the images")
    if off > 1:
        raise at.error(f"the principal point, {cx:g} and {cy:g}, lies far outside the image of {width} x {height}")
    if placed and float(camera.centre.norm()) > _FAR:
        message = f"the camera stands {float(camera.centre.norm()):.4g} m from the origin"
        raise at.error(message, place="translation", remedy="give the translation in metres")


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


def load_qualisys(path: str | Path) -> dict[str, Camera]:
    """Reads the cameras of a Qualisys calibration by serial, in its own z-up world, metres.

    With r the file's r11..r33 as a matrix and p its x, y, z:  R = diag(1, -1, -1) r,  t = -R p.

    Raises:
        DataError: not such a file, a number is missing or unusable, or r is not a rotation.
    """
    with reading(path, "export the calibration again as Qualisys XML") as at:
        text = read_text(at).strip()
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise at.error("document type declarations are refused", remedy="delete the declaration")
        found = ElementTree.fromstring(text.encode()).iter("camera")
        cameras = {}
        for index, node in enumerate(found, start=1):
            name = node.get("serial") or f"camera {index}"
            at.place = f"camera {name}"
            parts = {tag: node.find(tag) for tag in ("fov_video", "transform", "intrinsic")}
            for tag, part in parts.items():
                if part is None:
                    raise at.error(f"<{tag}> is missing")
            if name in cameras:
                raise at.error("two cameras have this serial")
            cameras[name] = _qualisys_camera(at, **{tag: part.attrib for tag, part in parts.items()})
        if not cameras:
            raise at.error("no <camera> in it")
        return cameras


def _qualisys_camera(at: Spot, fov_video: dict, transform: dict, intrinsic: dict) -> Camera:
    def read(source: dict, *keys: str) -> torch.Tensor:
        for key in keys:
            if key not in source:
                raise at.error(f"{key} is missing")
        return torch.from_numpy(numbers(at, [float(source[key]) for key in keys], str(len(keys))))

    rows = read(transform, *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(3, 3)
    rotation = _FLIP @ _rotation(at, rows)
    left, top, right, bottom = read(fov_video, "left", "top", "right", "bottom").tolist()
    focal = read(intrinsic, "focalLengthU", "focalLengthV") / _QUALISYS_PIXEL
    centre = read(intrinsic, "centerPointU", "centerPointV") / _QUALISYS_PIXEL - torch.tensor([left, top])
    position = read(transform, "x", "y", "z") / 1000
    return _camera(at, focal, centre, rotation, -rotation @ position, right - left + 1, bottom - top + 1)


def load_captury(path: str | Path, *, width: int) -> list[Camera]:
    """Reads the cameras of a Captury camera.calib in file order, metres, z up.

    Turned from the file's y-up world into that of Captury's C3D files, z up: (x, -z, y). There its joints
    project onto Captury's own projections.

    Args:
        width: image width in pixels. The file has only the sensor in millimetres; the height follows from it.

    Raises:
        DataError: not such a file, or a number is missing or unusable.
    """
    with reading(path, "export the calibration again from Captury") as at:
        text = read_text(at)
        if not text.startswith("tc camera calibration"):
            raise at.error('expected "tc camera calibration" first', place="line 1")
        blocks = re.split(r"^camera\b", text, flags=re.MULTILINE)[1:]
        if not blocks:
            raise at.error("no camera in it")
        cameras = []
        for index, block in enumerate(blocks):
            at.place = f"camera {index}"
            cameras.append(_captury_camera(at, block, width))
        return cameras


def _captury_camera(at: Spot, block: str, width: int) -> Camera:
    def read(key: str, count: int) -> torch.Tensor:
        line = re.search(rf"^[ \t]*{key}[ \t]+([^#\n]*)", block, flags=re.MULTILINE)
        if line is None:
            raise at.error(f"{key} is missing")
        values = [float(word) for word in line.group(1).split()]
        return torch.from_numpy(numbers(at, values, str(count), f"{at.place}, {key}"))

    sensor = read("sensorSize", 2)
    if not (sensor > 0).all():
        raise at.error(f"sensorSize: expected two lengths above zero, got {sensor.tolist()}")
    pixels = width / sensor[0]
    aspect = read("pixelAspect", 1)
    focal = read("focalLength", 1) * pixels * torch.cat((torch.ones(1, dtype=torch.float64), aspect))
    centre = (sensor / 2 + read("centerOffset", 2)) * pixels
    right, up = read("right", 3), read("up", 3)
    rows = torch.stack((right, -up, torch.linalg.cross(right, -up)))
    rotation = _rotation(at, rows) @ axes_to_matrix("x-zy").T
    position = axes_to_matrix("x-zy") @ read("origin", 3) / 1000
    return _camera(at, focal, centre, rotation, -rotation @ position, width, round(float(sensor[1] * pixels)))


def _rotation(at: Spot, matrix: torch.Tensor) -> torch.Tensor:
    if not torch.allclose(matrix @ matrix.T, torch.eye(3, dtype=matrix.dtype), atol=1e-3) or matrix.det() < 0:
        raise at.error(f"expected a rotation matrix, got {matrix.tolist()}")
    return matrix


def _camera(at: Spot, focal, centre, rotation, translation, width: float, height: float) -> Camera:
    if not (focal > 0).all() or min(width, height) < 1:
        raise at.error(f"expected a positive focal length and image, got {focal.tolist()}, {width} x {height}")
    intrinsics = torch.eye(3, dtype=torch.float64)
    intrinsics[[0, 1], [0, 1]], intrinsics[:2, 2] = focal, centre
    tensors = (tensor.float() for tensor in (intrinsics, rotation, translation))
    return Camera(*tensors, width=int(width), height=int(height))
