"""Calibrations: JSON, Pose2Sim's TOML, OpenCV's FileStorage, EasyMocap's two files, COLMAP, Qualisys XML, Captury.

Each becomes a table of ``WORDS`` per camera, in pixels and metres; ``cameras`` judges what they say.
"""

from __future__ import annotations

import re
import tomllib
import xml.etree.ElementTree as ElementTree

import numpy as np

from motionlab.io.judging import axes_to_matrix
from motionlab.io.reading import Location, checked_array, read_bytes, read_json, read_text, reading

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
#: Parameters of COLMAP's models: f or fx fy, cx, cy, then the lens in OpenCV's order.
_COLMAP = {
    "SIMPLE_PINHOLE": (1, ()), "PINHOLE": (2, ()), "SIMPLE_RADIAL": (1, (0,)), "RADIAL": (1, (0, 1)),
    "OPENCV": (2, (0, 1, 2, 3)), "FULL_OPENCV": (2, (0, 1, 2, 3, 4, 5, 6, 7)),
}  # fmt: skip
#: Qualisys gives image positions in 64ths of a pixel; its camera axes are y up, z backward: ours y down, z forward.
_QUALISYS_PIXEL, _FLIP = 64.0, np.diag([1.0, -1.0, -1.0])
_CAPTURY_WIDTH = 1920  # pixels, of its images
Table = dict[str, object]


def read_tables(at: Location) -> dict[str, Table]:
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
        tables = tomllib.loads(read_text(at))
        found = {str(table.get("name") or key): known for key, table in tables.items() if (known := _known(table))}
    else:
        raise at.error("no calibration of a known kind")
    if not found:
        raise at.error("no camera in it")
    return found


def _known(table: object) -> Table:
    """What a table says, by our words; nothing where it has no intrinsics."""
    if not isinstance(table, dict):
        return {}
    lower = {str(key).lower(): _matrix(value) for key, value in table.items()}
    found = {word: next((lower[name] for name in names if name in lower), None) for word, names in WORDS.items()}
    found = {word: value for word, value in found.items() if value is not None}
    if isinstance(pair := found.pop("size", None), list) and len(pair) == 2:
        found = {"width": pair[0], "height": pair[1]} | found
    tells = (f"{key} {value}".lower() for key, value in lower.items() if _TELLS.search(key))
    bent = any(_FISHEYE.search(text) and not text.endswith((" 0", " 0.0", " false", " none", " ")) for text in tells)
    found |= {"fisheye": True} if bent else {}
    return found if "intrinsics" in found else {}


def _matrix(value: object) -> object:
    """Rows of what FileStorage writes as rows, cols and data."""
    if isinstance(value, dict) and {"rows", "cols", "data"} <= value.keys():
        return np.asarray(value["data"], float).reshape(int(value["rows"]), int(value["cols"])).tolist()
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
    found = {}
    for node in _xml(at):
        parts = {part.tag: (part.text or "").split() for part in node}
        if {"rows", "cols", "data"} <= parts.keys():
            found[node.tag] = {"rows": parts["rows"][0], "cols": parts["cols"][0], "data": parts["data"]}
        elif not parts:
            found[node.tag] = _value((node.text or "").strip())
    return _named(found)


def _yaml(text: str) -> dict[str, object]:
    """What FileStorage and ROS write: keys at the left edge, with a number, a word, a list or a matrix each."""
    found: dict[str, object] = {}
    for part in re.split(r"^(?=\w)", text, flags=re.MULTILINE):
        key, _, body = part.partition(":")
        sides = [re.search(rf"\b{side}:\s*(\d+)", body) for side in ("rows", "cols")]
        row = re.search(r"\[([^\[\]]*)\]", body)
        if row and all(sides):
            found[key] = {"rows": sides[0][1], "cols": sides[1][1], "data": row[1].replace(",", " ").split()}
        elif row:
            found[key] = [_value(cell.strip()) for cell in row[1].split(",")]
        elif "\n" not in body.strip():
            found[key] = _value(body.strip().strip('"'))
    return found


def _value(text: str) -> object:
    try:
        return float(text)
    except ValueError:
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
        at.place, words = f"line {n}", line.split()
        if not words or words[0].startswith("#"):
            continue
        model, (width, height, *values) = words[1], (float(word) for word in words[2:])
        if model not in _COLMAP:
            raise at.error(
                f"a lens by COLMAP's {model}", remedy=f"undistort the images; known are {', '.join(_COLMAP)}"
            )
        focal, places = _COLMAP[model]
        if len(values) != focal + 2 + len(places):
            raise at.error(f"{len(values)} parameters of {model}, expected {focal + 2 + len(places)}")
        fx, fy, (cx, cy, *lens) = values[0], values[focal - 1], values[focal:]
        intrinsics = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        found[words[0]] = {"intrinsics": intrinsics, "width": width, "height": height, "distortion": lens}
    at.place = ""
    return found


def _qualisys(at: Location) -> dict[str, Table]:
    """By serial. With r the file's r11..r33 as a matrix and p its x, y, z:  R = diag(1, -1, -1) r,  t = -R p."""
    found: dict[str, Table] = {}
    for index, node in enumerate(_xml(at).iter("camera"), start=1):
        name = node.get("serial") or f"camera {index}"
        at.place = f"camera {name}"
        if name in found:
            raise at.error("two cameras have this serial")
        parts = {tag: node.find(tag) for tag in ("fov_video", "transform", "intrinsic")}
        if lacking := [tag for tag, part in parts.items() if part is None]:
            raise at.error(f"<{lacking[0]}> is missing")

        def read(tag: str, *keys: str, parts: dict = parts) -> np.ndarray:
            if lacking := [key for key in keys if key not in parts[tag].attrib]:
                raise at.error(f"{lacking[0]} is missing")
            return checked_array(at, [float(parts[tag].get(key)) for key in keys], "N")

        rotation = _FLIP @ read("transform", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(3, 3)
        left, top, right, bottom = read("fov_video", "left", "top", "right", "bottom").tolist()
        focal = read("intrinsic", "focalLengthU", "focalLengthV") / _QUALISYS_PIXEL
        centre = read("intrinsic", "centerPointU", "centerPointV") / _QUALISYS_PIXEL - (left, top)
        place = read("transform", "x", "y", "z") / 1000
        found[name] = _seen_from(focal, centre, rotation, place, right - left + 1, bottom - top + 1)
    at.place = ""
    return found


def _captury(at: Location) -> dict[str, Table]:
    """By their place in the file, which has only the sensor in millimetres.

    Turned from the file's y-up world into that of Captury's C3D files, z up: (x, -z, y). There its joints
    project onto Captury's own projections.
    """
    text = read_text(at)
    found, upright = {}, axes_to_matrix("x-zy").double().numpy()
    for index, block in enumerate(re.split(r"^camera\b", text, flags=re.MULTILINE)[1:]):
        at.place = f"camera {index}"

        def read(key: str, count: int, block: str = block) -> np.ndarray:
            line = re.search(rf"^[ \t]*{key}[ \t]+([^#\n]*)", block, flags=re.MULTILINE)
            if line is None:
                raise at.error(f"{key} is missing")
            return checked_array(at, [float(word) for word in line[1].split()], str(count), f"{at.place}, {key}")

        sensor = read("sensorSize", 2)
        if not (sensor > 0).all():
            raise at.error(f"sensorSize: expected two lengths above zero, got {sensor.tolist()}")
        pixels = _CAPTURY_WIDTH / sensor[0]
        focal = read("focalLength", 1) * pixels * np.append(1.0, read("pixelAspect", 1))
        centre = (sensor / 2 + read("centerOffset", 2)) * pixels
        right, up = read("right", 3), read("up", 3)
        rotation = np.stack((right, -up, np.cross(right, -up))) @ upright.T
        place = upright @ read("origin", 3) / 1000
        high = round(float(sensor[1] * pixels))
        found[str(index)] = _seen_from(focal, centre, rotation, place, _CAPTURY_WIDTH, high)
    at.place = ""
    return found


def _seen_from(focal, centre, rotation, place, width: float, height: float) -> Table:
    """A table of focal lengths and centre (2,) in pixels, and where the camera stands (3,), metres."""
    intrinsics = np.eye(3)
    intrinsics[[0, 1], [0, 1]], intrinsics[:2, 2] = focal, centre
    here = {"intrinsics": intrinsics, "rotation": rotation, "translation": -rotation @ place}
    return here | {"width": width, "height": height}
