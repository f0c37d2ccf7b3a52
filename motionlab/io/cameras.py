"""Calibrated cameras: JSON, Pose2Sim's TOML, OpenCV's FileStorage, EasyMocap's two files, COLMAP, Qualisys, Captury.

Each file becomes a table of ``WORDS`` per camera, in pixels and metres, which is then judged. The lens distortion of
tables goes with the camera (OpenCV's model: ``distorted``, ``undistorted``). That of Qualisys and Captury is left out:
the files seen so far have |k1| < 0.05, which moves a point by at most a few pixels near the rim.
"""

import re
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from kornia.geometry.calibration import distort_points, undistort_points

from motionlab.errors import DataError
from motionlab.io.judging import axes_to_matrix
from motionlab.io.reading import Location, checked_array, image_size, read_bytes, read_json, read_text, reading
from motionlab.observation import Camera
from motionlab.rotation import exp

#: Focal lengths that lenses have, in shares of the larger side; how far a principal point may lie off the middle.
_FOCAL, _CENTRE = (0.1, 100.0), 0.1
_SHAPE = 0.02  # share by which width : height may differ, and a size that needs no scaling
_FAR = 200.0  # metres from the origin: no camera stands there
_REMEDY = "give a Qualisys XML, a Captury .calib, a TOML, OpenCV's YAML or XML, or JSON as load_camera describes it"
_ROUNDS = 100
_EXACT = 0.05  # pixels by which a point may be missed
#: What is known of a camera, and the words that files have for it.
WORDS = {
    "intrinsics": ("intrinsics", "camera_matrix", "cameramatrix", "intrinsic_matrix", "intrinsic", "matrix", "mtx",
                   "k"),
    "distortion": ("distortion", "distortions", "distortion_coefficients", "distortion_coeffs", "dist_coeffs",
                   "distcoeffs", "dist_coefs", "distcoef", "dist", "d"),
    "rotation": ("rotation", "rotation_matrix", "rot", "r", "rvec"),
    "translation": ("translation", "translation_vector", "t", "tvec"),
    "size": ("size", "image_size", "imgsize", "img_size", "resolution"),
    "width": ("width", "image_width", "w"),
    "height": ("height", "image_height", "h"),
}  # fmt: skip
#: Lenses that bend more than OpenCV's usual model can: what they are called, and the keys that tell.
_FISHEYE = re.compile("fisheye|equidistan|omni|kannala|kb4")
_TELLS = re.compile("fisheye|model|lens|projection|type")
#: Parameters of COLMAP's models: how many focal lengths; behind cx and cy, how many of the lens in OpenCV's order.
_COLMAP = {
    "SIMPLE_PINHOLE": (1, 0), "PINHOLE": (2, 0), "SIMPLE_RADIAL": (1, 1), "RADIAL": (1, 2), "OPENCV": (2, 4),
    "FULL_OPENCV": (2, 8),
}  # fmt: skip
#: What is read of a camera of Qualisys. It gives image positions in 64ths of a pixel; its camera axes are y up, z
#: backward: ours y down, z forward.
_QUALISYS = [
    *(f"fov_video {side}" for side in ("left", "top", "right", "bottom")), *(f"transform {axis}" for axis in "xyz"),
    *(f"transform r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
    *(f"intrinsic {what}{axis}" for what in ("focalLength", "centerPoint") for axis in "UV"),
]  # fmt: skip
_QUALISYS_PIXEL, _FLIP = 64.0, np.diag([1.0, -1.0, -1.0])
#: And of one of Captury, with how many numbers each; its images are so many pixels wide.
_CAPTURY = {"sensorSize": 2, "focalLength": 1, "pixelAspect": 1, "centerOffset": 2, "right": 3, "up": 3, "origin": 3}
_CAPTURY_WIDTH = 1920
Table = dict[str, object]


def load_camera(
    path: str | Path, name: str | None = None, views: str | Path | None = None, size: tuple[int, int] | None = None
) -> tuple[Camera, bool]:
    """Reads a camera of a Qualisys XML, of a Captury camera.calib, or of a table.

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
        found = _tables(at)
        number = re.search(r"\d+", Path(views or "").name)
        told = [key for key in found if number and [*map(int, re.findall(r"\d+", key)[-1:])] == [int(number[0])]]
        names = [name] if name is not None else told if len(found) > 1 else [*found]
        if len(names) != 1 or names[0] not in found:
            what = "which of its cameras" if name is None else f"no camera {name!r}; there are"
            raise at.error(f"{what}: {', '.join(found)}", remedy="name it (--camera-name)")
        return _camera(at, names[0], found[names[0]], size)


def load_cameras(path: str | Path) -> dict[str, Camera]:
    """Reads all cameras of a file by name, as :func:`load_camera` does one of them."""
    with reading(path, _REMEDY) as at:
        return {name: _camera(at, name, table)[0] for name, table in _tables(at).items()}


def _camera(at: Location, name: str, table: Table, size: tuple[int, int] | None = None) -> tuple[Camera, bool]:
    """A camera of a table, if it can be one, and whether its place is known."""
    where = "" if name == "camera" else f"camera {name}, "  # the only one, without a name
    table = dict(zip(("width", "height"), size or (), strict=False)) | table
    placed = bool(table.keys() & {"rotation", "translation"})
    needed = ["intrinsics", *(["rotation", "translation"] if placed else []), "width", "height"]
    if missing := [key for key in needed if key not in table]:
        raise at.error(f"no {', '.join(missing)}", remedy="add them; the size of the images also by --size")
    if "fisheye" in table:
        raise at.error("a fisheye lens", place="lens", remedy="undistort the footage (cv2.fisheye), and give that")
    width, height = (int(x) for x in image_size(at, [table["width"], table["height"]], where + "width, height"))
    k = checked_array(at, table["intrinsics"], "3 3", where + "intrinsics")
    turn = np.ravel(table.get("rotation", np.eye(3)))
    turn = checked_array(at, turn, "3" if len(turn) == 3 else "9", where + "rotation")
    turn = exp(torch.from_numpy(turn)).numpy() if len(turn) == 3 else turn.reshape(3, 3)
    shift = checked_array(at, np.ravel(table.get("translation", np.zeros(3))), "3", where + "translation")
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise at.error(f"expected a rotation matrix, got {turn.tolist()}", place=where + "rotation")
    lens = checked_array(at, [*np.ravel(table.get("distortion", ())), 0.0], "N", where + "distortion").tolist()[:-1]
    if len(lens) not in (0, 1, 2, 4, 5, 8, 12, 14) or any(lens[8:]):
        raise at.error(f"{len(lens)} coefficients", place=where + "distortion", remedy="give k1, k2, p1, p2, k3")
    at.place = where + "intrinsics"
    _check_pixels(at, k, width, height)
    tensors = (torch.from_numpy(each).float() for each in (k, turn, shift))
    camera = Camera(*tensors, width, height, tuple(lens[:8]) if any(lens) else ())
    if (far := float(camera.centre.norm())) > _FAR:
        raise at.error(f"stands {far:.4g} m from the origin", place=where + "translation", remedy="give it in metres")
    return camera, placed


def _check_pixels(at: Location, k: np.ndarray, width: int, height: int) -> None:
    """Refuses intrinsics that cannot be meant, and says what may be."""
    (fx, skew, cx), (_, fy, cy) = k[:2].tolist()
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
    return _through_lens(distort_points, pixels, camera)


def undistorted(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Computes where a pinhole would put what the camera's lens put at pixels (..., 2); NaN where nothing comes there.

    By fixed-point steps, from the point itself, as OpenCV does.
    """
    found = _through_lens(undistort_points, pixels, camera, num_iters=_ROUNDS)
    miss = np.linalg.norm(pixels - distorted(found, camera), axis=-1, keepdims=True)
    return np.where(miss < _EXACT, found, np.nan)


def _through_lens(way: Callable, pixels: np.ndarray, camera: Camera, **how) -> np.ndarray:
    lens = torch.tensor([*camera.distortion, *[0.0] * 8][:8], dtype=torch.float64)
    points = torch.from_numpy(pixels).double()
    return way(points.reshape(-1, 2), camera.intrinsics.double(), lens, **how).reshape(points.shape).numpy()


def straight(pictures: Iterable[np.ndarray], camera: Camera) -> Iterator[np.ndarray]:
    """Yields pictures (H, W, 3) as a pinhole would have taken them, by the nearest pixel; black where there is none."""
    at = None
    for picture in pictures:
        if at is None:
            size = np.array(picture.shape[1::-1])
            scale = np.array([camera.width, camera.height]) / size
            there = np.stack(np.meshgrid(*map(np.arange, size)), -1)
            from_ = (distorted(there * scale, camera) / scale).round()
            inside = ((from_ >= 0) & (from_ < size)).all(-1, keepdims=True)
            at = np.where(inside, from_, -1).astype(int)  # the black border
        yield np.pad(picture, ((0, 1), (0, 1), (0, 0)))[at[..., 1], at[..., 0]]


def _tables(at: Location) -> dict[str, Table]:
    """Reads the cameras of a file by name, one or more."""
    head, suffix = read_bytes(at)[:4096].removeprefix(b"\xef\xbb\xbf").lstrip(), at.path.suffix.lower()
    if re.match(rb"\{|\[\s*[\[{]", head):
        found = _of_json(read_json(at))
    elif head.startswith(b"<"):
        found = _opencv_xml(at) if b"<opencv_storage" in head else _qualisys(at)
    elif head.startswith(b"tc camera calibration"):
        found = _captury(at)
    elif head.startswith(b"%YAML") or suffix in (".yml", ".yaml"):
        found = _easymocap(at) if re.search("intri|extri", at.path.name) else _named(_yaml(read_text(at)))
    elif re.search(rb"^\d+\s+[A-Z_]+\s+\d+\s+\d+\s+[-\d.]", head, re.MULTILINE):
        found = _colmap(at)
    elif suffix == ".toml" or re.match(rb"(#.*\n|\s)*\[[\w\"'.-]+\]\s", head):
        tables = tomllib.loads(read_text(at)).items()
        found = _of_json({str(one.get("name") or key) if isinstance(one, dict) else key: one for key, one in tables})
    else:
        raise at.error("no calibration of a known kind")
    at.place = ""
    if not found:
        raise at.error("no camera in it")
    return found


def _known(table: object) -> Table:
    """What a table says, by our words; nothing where it has no intrinsics."""
    if not isinstance(table, dict):
        return {}
    lower = {str(key).lower(): _matrix(value) for key, value in table.items()}
    known = ((word, lower.get(name)) for word, names in WORDS.items() for name in reversed(names))  # the first counts
    found = {word: value for word, value in known if value is not None}
    if isinstance(pair := found.pop("size", None), list) and len(pair) == 2:
        found = {"width": pair[0], "height": pair[1]} | found
    tells = (f"{key} {value}".lower() for key, value in lower.items() if _TELLS.search(key))
    bent = any(_FISHEYE.search(text) and not text.endswith((" 0", " 0.0", " false", " none", " ")) for text in tells)
    found |= {"fisheye": True} if bent else {}
    return found if "intrinsics" in found else {}


def _matrix(value: object) -> object:
    """Rows of what FileStorage writes as rows, cols and data."""
    if isinstance(value, dict) and {"rows", "cols", "data"} <= value.keys():
        shape = [int(np.ravel(value[side])[0]) for side in ("rows", "cols")]
        return np.asarray(value["data"], float).reshape(shape).tolist()
    return value


def _named(table: dict) -> dict[str, Table]:
    """One camera; or several whose keys end in their names, as EasyMocap's do: K_01, dist_01, R_01."""
    if known := _known(table):
        return {"camera": known}
    several: dict[str, Table] = {}
    for key, value in table.items():
        word, _, name = key.partition("_")
        if name and word in ("K", "dist", "R", "Rot", "T", "H", "W"):
            several.setdefault(name, {})[word] = value
    return {name: known for name, part in several.items() if (known := _known(part))}


def _of_json(document: object) -> dict[str, Table]:
    """One camera, a list of some, or some by name; as they stand where nothing in them is known."""
    inner = document.get("cameras", document) if isinstance(document, dict) else document
    if isinstance(inner, list):
        inner = {str(one.get("name", n)) if isinstance(one, dict) else str(n): one for n, one in enumerate(inner)}
    if found := _named(inner):
        return found
    found = {str(name): known for name, one in inner.items() if (known := _known(one))}
    return found or {"camera": {word: inner[word] for word in WORDS if word in inner}}


def _xml(at: Location) -> ElementTree.Element:
    text = read_text(at).strip()
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise at.error("document type declarations are refused", remedy="delete the declaration")
    return ElementTree.fromstring(text.encode())


def _opencv_xml(at: Location) -> dict[str, Table]:
    nodes = ((node, {part.tag: (part.text or "").split() for part in node}) for node in _xml(at))
    told = ((node, parts) for node, parts in nodes if not parts or {"rows", "cols", "data"} <= parts.keys())
    return _named({node.tag: parts or _value((node.text or "").strip()) for node, parts in told})


def _yaml(text: str) -> dict[str, object]:
    """What FileStorage and ROS write: keys at the left edge, with a number, a word, a list or a matrix each."""
    found: dict[str, object] = {}
    for part in re.split(r"^(?=\w)", text, flags=re.MULTILINE):
        key, _, body = part.partition(":")
        sides = dict(re.findall(r"\b(rows|cols):\s*(\d+)", body))
        row = re.search(r"\[([^\[\]]*)\]", body)
        if row and len(sides) == 2:
            found[key] = sides | {"data": row[1].replace(",", " ").split()}
        elif row:
            found[key] = [_value(cell.strip()) for cell in row[1].split(",")]
        elif "\n" not in body.strip():
            found[key] = _value(body.strip().strip('"'))
    return found


def _value(text: str) -> object:
    with suppress(ValueError):
        return float(text)
    return text


def _easymocap(at: Location) -> dict[str, Table]:
    """intri.yml and extri.yml, which lie side by side; the second may be missing."""
    found = {}
    for word in ("intri", "extri"):
        path = at.path.with_name(re.sub("intri|extri", word, at.path.name))
        if word == "intri" or path.exists():
            with reading(path, "put intri.yml and extri.yml side by side") as one:
                found |= _yaml(read_text(one))
    return _named(found)


def _colmap(at: Location) -> dict[str, Table]:
    """Lines of CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS. COLMAP's world has neither metres nor a floor: it stays out."""
    found: dict[str, Table] = {}
    for n, line in enumerate(read_text(at).splitlines(), start=1):
        at.place, words = f"line {n}", line.partition("#")[0].split()
        if not words:
            continue
        model, (width, height, *values) = words[1], (float(word) for word in words[2:])
        if model not in _COLMAP:
            remedy = f"undistort the images; known are {', '.join(_COLMAP)}"
            raise at.error(f"a lens by COLMAP's {model}", remedy=remedy)
        focal, lens = _COLMAP[model]
        if len(values) != focal + 2 + lens:
            raise at.error(f"{len(values)} parameters of {model}, expected {focal + 2 + lens}")
        fx, fy, (cx, cy, *distortion) = values[0], values[focal - 1], values[focal:]
        intrinsics = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        found[words[0]] = {"intrinsics": intrinsics, "width": width, "height": height, "distortion": distortion}
    return found


def _qualisys(at: Location) -> dict[str, Table]:
    """By serial. With r the file's r11..r33 as a matrix and p its x, y, z:  R = diag(1, -1, -1) r,  t = -R p."""
    found: dict[str, Table] = {}
    for index, node in enumerate(_xml(at).iter("camera"), start=1):
        name = node.get("serial") or f"camera {index}"
        at.place = f"camera {name}"
        if name in found:
            raise at.error("two cameras have this serial")
        said = {f"{part.tag} {key}": value for part in node for key, value in part.attrib.items()}
        values = checked_array(at, [float(said[key]) for key in _QUALISYS], "N")
        left, top, right, bottom = values[:4].tolist()
        place, rotation = values[4:7] / 1000, _FLIP @ values[7:16].reshape(3, 3)
        focal, centre = values[16:].reshape(2, 2) / _QUALISYS_PIXEL
        found[name] = _seen_from(focal, centre - (left, top), rotation, place, right - left + 1, bottom - top + 1)
    return found


def _captury(at: Location) -> dict[str, Table]:
    """By their place in the file, which has only the sensor in millimetres.

    Turned from the file's y-up world into that of Captury's C3D files, z up: (x, -z, y). There its joints
    project onto Captury's own projections.
    """
    found, upright = {}, axes_to_matrix("x-zy").numpy()
    for index, block in enumerate(re.split(r"^camera\b", read_text(at), flags=re.MULTILINE)[1:]):
        rows, values = (line.partition("#")[0].split() for line in reversed(block.splitlines())), []
        said = {row[0]: row[1:] for row in rows if row}  # the first counts
        for key, count in _CAPTURY.items():
            at.place = f"camera {index}, {key}"
            values.append(checked_array(at, [float(word) for word in said.get(key, ())], str(count)))
        sensor, focal, aspect, offset, right, up, origin = values
        if not (sensor > 0).all():
            raise at.error(f"expected lengths above zero, got {sensor.tolist()}", place=f"camera {index}, sensorSize")
        pixels = _CAPTURY_WIDTH / sensor[0]
        focal = focal * pixels * np.append(1.0, aspect)
        rotation = np.stack((right, -up, np.cross(right, -up))) @ upright.T
        centre, high = (sensor / 2 + offset) * pixels, round(float(sensor[1] * pixels))
        found[str(index)] = _seen_from(focal, centre, rotation, upright @ origin / 1000, _CAPTURY_WIDTH, high)
    return found


def _seen_from(focal, centre, rotation, place, width: float, height: float) -> Table:
    """A table of focal lengths and centre (2,) in pixels, and where the camera stands (3,), metres."""
    intrinsics = np.diag([*focal, 1.0])
    intrinsics[:2, 2] = centre
    here = {"intrinsics": intrinsics, "rotation": rotation, "translation": -rotation @ place}
    return here | {"width": width, "height": height}
