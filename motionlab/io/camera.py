"""One camera from any file that holds cameras."""

from __future__ import annotations

import re
from pathlib import Path

import torch

from motionlab.io import calibration
from motionlab.io.reading import Spot, numbers, read_bytes, read_json, reading
from motionlab.observation import Camera


def load_camera(path: str | Path, name: str | None = None, views: str | Path | None = None) -> tuple[Camera, bool]:
    """A camera of a Qualisys XML, of a Captury camera.calib, or of JSON.

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
            found = {str(i): camera for i, camera in enumerate(calibration.load_captury(path, width=1920))}
        else:
            found = calibration.load_qualisys(path)
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
