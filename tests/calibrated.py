"""One camera as calibration tools write it, each by hand from its documentation."""

import json

import numpy as np

K = [[900.0, 0.0, 650.0], [0.0, 905.0, 350.0], [0.0, 0.0, 1.0]]
LENS = [-0.1, 0.02, 0.001, -0.002, 0.003]
SIZE = (1280, 720)
#: The camera stands 1.4 m high and 5 m behind the origin, looks along y, and is rolled and turned a little.
ROTVEC, SHIFT = (1.5, 0.05, -0.1), (-0.5, 1.4, 5.0)


def matrix(vector) -> np.ndarray:
    """Rotation matrix of a rotation vector, by Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    x, y, z = np.asarray(vector) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


PLACED = {"rotation": matrix(ROTVEC).tolist(), "translation": list(SHIFT)}
PLAIN = {"intrinsics": K, "width": SIZE[0], "height": SIZE[1], "distortion": LENS}


def pose2sim(name: str = "cam01") -> str:
    size = [float(side) for side in SIZE]
    return (
        f'[{name}]\nname = "{name}"\nsize = {size}\nmatrix = {K}\ndistortions = {LENS}\nrotation = {[*ROTVEC]}\n'
        f"translation = {[*SHIFT]}\nfisheye = false\n\n[metadata]\nadjusted = false\nerror = 0.0\n"
    )


def _block(key: str, rows, columns: int) -> str:
    data = np.ravel(rows)
    text = ",\n       ".join(", ".join(f"{x:.17g}" for x in part) for part in np.array_split(data, 2))
    return (
        f"{key}: !!opencv-matrix\n   rows: {len(data) // columns}\n   cols: {columns}\n   dt: d\n   data: [ {text} ]\n"
    )


def opencv_yaml() -> str:
    words = f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\n"
    return f"%YAML:1.0\n---\n{words}{_block('camera_matrix', K, 3)}{_block('distortion_coefficients', LENS, 1)}"


def opencv_xml() -> str:
    def node(key: str, rows, columns: int) -> str:
        data = np.ravel(rows)
        text = " ".join(f"{x:.17g}" for x in data)
        inner = f"<rows>{len(data) // columns}</rows><cols>{columns}</cols><dt>d</dt><data>{text}</data>"
        return f'<{key} type_id="opencv-matrix">{inner}</{key}>'

    sides = f"<image_width>{SIZE[0]}</image_width><image_height>{SIZE[1]}</image_height>"
    inner = sides + node("camera_matrix", K, 3) + node("distortion_coefficients", LENS, 5)
    return f'<?xml version="1.0"?>\n<opencv_storage>\n{inner}\n</opencv_storage>\n'


def opencv_json() -> str:
    def value(rows, columns: int) -> dict:
        data = np.ravel(rows).tolist()
        return {"type_id": "opencv-matrix", "rows": len(data) // columns, "cols": columns, "dt": "d", "data": data}

    found = {"camera_matrix": value(K, 3), "distortion_coefficients": value(LENS, 1)}
    return json.dumps(found | {"image_width": SIZE[0], "image_height": SIZE[1]})


def ros() -> str:
    return (
        f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        f"  data: {np.ravel(K).tolist()}\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n"
        f"  data: {LENS}\n"
    )


def easymocap(names=("01",)) -> tuple[str, str]:
    """intri.yml and extri.yml; there is no image size in them."""
    inner = outer = "%YAML:1.0\n---\nnames:\n" + "".join(f'   - "{name}"\n' for name in names)
    for name in names:
        inner += _block(f"K_{name}", K, 3) + _block(f"dist_{name}", LENS, 5)
        outer += _block(f"R_{name}", ROTVEC, 1) + _block(f"Rot_{name}", matrix(ROTVEC), 3)
        outer += _block(f"T_{name}", SHIFT, 1)
    return inner, outer


def colmap(model: str = "OPENCV") -> str:
    (fx, _, cx), (_, fy, cy), _ = K
    words = {
        "OPENCV": (fx, fy, cx, cy, *LENS[:4]), "FULL_OPENCV": (fx, fy, cx, cy, *LENS, 0, 0, 0),
        "PINHOLE": (fx, fy, cx, cy), "SIMPLE_RADIAL": (fx, cx, cy, LENS[0]), "FOV": (fx, fy, cx, cy, 0.9),
    }[model]  # fmt: skip
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{head}# Number of cameras: 1\n1 {model} {SIZE[0]} {SIZE[1]} {' '.join(map(str, words))}\n"


#: name -> (content, whether its place is in it)
FORMATS = {
    "camera.json": (json.dumps(PLAIN | PLACED), True),
    "list.json": (json.dumps([PLAIN]), False),
    "named.json": (json.dumps({"left": PLAIN | PLACED}), True),
    "panoptic.json": (json.dumps({"cameras": [{
        "name": "00_01", "resolution": SIZE, "K": K, "distCoef": LENS, "R": PLACED["rotation"],
        "t": [[x] for x in SHIFT]}]}), True),
    "Calib.toml": (pose2sim(), True),
    "opencv.yaml": (opencv_yaml(), False),
    "opencv.xml": (opencv_xml(), False),
    "opencv.json": (opencv_json(), False),
    "ros.yaml": (ros(), False),
    "cameras.txt": (colmap("FULL_OPENCV"), False),
}  # fmt: skip
SEEDS = {name: content.encode() for name, (content, _) in FORMATS.items()}
