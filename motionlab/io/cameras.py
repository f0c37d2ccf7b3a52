"""Calibrated cameras from files: Qualisys XML (as Pose2Sim writes it), Captury's camera.calib, or JSON of one camera.

Lens distortion is not modelled: ``Camera`` has none. The files here have |k1| < 0.05, which moves a point by
at most a few pixels near the rim.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import torch

from motionlab.io.points import axes_to_matrix
from motionlab.io.reading import Spot, numbers, read_bytes, read_json, read_text, reading
from motionlab.observation import Camera

#: Qualisys gives image positions in 64ths of a pixel.
_QUALISYS_PIXEL = 64.0
#: From Qualisys' camera axes (x right, y up, z backward) to ours (x right, y down, z forward).
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


def load_camera(path: str | Path, name: str | None = None, views: str | Path | None = None) -> tuple[Camera, bool]:
    """Reads a camera of a Qualisys XML, of a Captury camera.calib, or of JSON.

    JSON: {"intrinsics": 3x3 in pixels, "width": W, "height": H}, and, where the camera's place is known, "rotation":
    3x3 camera from world, and "translation": 3 in metres; world z up, floor at z = 0.

    Args:
        name: of the camera (a serial, or its place in a Captury file). None: the only one, or the one whose name ends
            in the same number as the folder ``views`` has in its name.

    Returns:
        the camera, and whether its place in the world is known.
    Raises:
        DataError: not such a file, or none or several cameras that fit.
    """
    with reading(path, "give a Qualisys XML, a Captury camera.calib, or JSON as load_camera describes it") as at:
        head = read_bytes(at).lstrip()
        if head.startswith(b"{"):
            return _from_json(at)
        if head.startswith(b"tc camera calibration"):
            found = {str(i): camera for i, camera in enumerate(load_captury(path, width=1920))}
        else:
            found = load_qualisys(path)
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
        return found[name], True


def _from_json(at: Spot) -> tuple[Camera, bool]:
    content = read_json(at)
    placed = "rotation" in content or "translation" in content
    shapes = {"intrinsics": "3 3"} | ({"rotation": "3 3", "translation": "3"} if placed else {})
    missing = [key for key in (*shapes, "width", "height") if key not in content]
    if missing:
        raise at.error(f"no {', '.join(missing)}")
    arrays = {key: torch.from_numpy(numbers(at, content[key], shape, key)).float() for key, shape in shapes.items()}
    k, turn = arrays["intrinsics"], arrays.get("rotation", torch.eye(3))
    if not torch.allclose(turn @ turn.T, torch.eye(3), atol=1e-3) or turn.det() < 0:
        raise at.error("expected a rotation matrix", place="rotation")
    width, height = (int(numbers(at, content[key], "", key)) for key in ("width", "height"))
    if min(width, height) < 1 or not (k[0, 0] > 0 and k[1, 1] > 0):
        raise at.error("expected a positive focal length and image size", place="intrinsics")
    return Camera(k, turn, arrays.get("translation", torch.zeros(3)), width, height), placed


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
