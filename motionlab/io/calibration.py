"""Calibrated cameras from files: Qualisys XML (as Pose2Sim writes it) and Captury's camera.calib.

Lens distortion is not modelled: ``Camera`` has none. The files here have |k1| < 0.05, which moves a point by
at most a few pixels near the rim.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import torch

from motionlab.io.positions import axes_to_matrix
from motionlab.io.reading import Spot, numbers, read_text, reading
from motionlab.observation import Camera

#: Qualisys gives image positions in 64ths of a pixel.
QUALISYS_PIXEL = 64.0
#: From Qualisys' camera axes (x right, y up, z backward) to ours (x right, y down, z forward).
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


def load_qualisys(path: str | Path) -> dict[str, Camera]:
    """Cameras of a Qualisys calibration by serial, in its own z-up world, metres.

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
    rotation = FLIP @ _rotation(at, rows)
    left, top, right, bottom = read(fov_video, "left", "top", "right", "bottom").tolist()
    focal = read(intrinsic, "focalLengthU", "focalLengthV") / QUALISYS_PIXEL
    centre = read(intrinsic, "centerPointU", "centerPointV") / QUALISYS_PIXEL - torch.tensor([left, top])
    position = read(transform, "x", "y", "z") / 1000
    return _camera(at, focal, centre, rotation, -rotation @ position, right - left + 1, bottom - top + 1)


def load_captury(path: str | Path, *, width: int) -> list[Camera]:
    """Cameras of a Captury camera.calib in file order, metres, z up.

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
