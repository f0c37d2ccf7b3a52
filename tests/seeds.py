"""Small valid files of every format, as bytes, for the tests of loaders. Made here; no recording is copied."""

import base64
import json
import pickle
import struct
import tempfile
from pathlib import Path

import calibrated
import detected
import numpy as np
import torch
from detected import npz
from scipy.spatial.transform import Rotation

import results
from motionlab import humanml
from motionlab.io import bvh, gltf, smpl
from motionlab.observation import Camera, look_at
from motionlab.skeleton import STANDARD

FRAMES = 4


def saved(save, suffix: str) -> bytes:
    """What a saver of ours writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"seed{suffix}"
        save(path, results.person(FRAMES))
        return path.read_bytes()


def _save_features(path: Path, motion) -> None:
    """HumanML3D's 263 numbers of somebody who stands, on one foot."""
    numbers, rest = np.zeros((motion.frames, humanml.SIZE), np.float32), motion.skeleton.rest_positions()[1:]
    numbers[:, 3], numbers[:, 4:67], numbers[:, -1] = 0.9, (rest + torch.tensor([0, 0.9, 0])).flatten(), 1
    np.save(path, numbers)


#: ASF/AMC by hand; its lines are counted in test_io_asf.
ASF = """# a comment
:version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:documentation
  free words: begin end
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name lfemur
    direction 0.34202 -0.939693 0
    length 7.5
    axis 0 0 20 XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
    id 2
    name ltibia
    direction 0.34202 -0.939693 0
    length 7.2
    axis 10 30 20 XYZ
    dof rx
    limits (-10 170)
  end
  begin
    id 3
    name thorax
    direction 0 1 0.1
    length 4
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root lfemur thorax
    lfemur ltibia
  end
"""
AMC = """#!OML
:FULLY-SPECIFIED
:DEGREES
1
root 10 16 -30 -2 -9 -3
lfemur -28 5 -20
ltibia 22
2
root 11 16 -29 -2 -19 -3
ltibia 25
lfemur -25 4 -10
"""


def _wxyz(draw) -> list[float]:
    return Rotation.random(random_state=draw).as_quat()[[3, 0, 1, 2]].tolist()


#: DeepMimic's joints in the order of a frame, and how many numbers each has.
LAYOUT = "chest4 neck4 rhip4 rknee1 rankle4 rshoulder4 relbow1 lhip4 lknee1 lankle4 lshoulder4 lelbow1".split()


def deepmimic_frames(count: int = 3, seed: int = 0) -> list[list[float]]:
    draw, rows = np.random.default_rng(seed), []
    for i in range(count):
        row = [0.033332 if i < count - 1 else 0.0, *draw.normal(size=3), *_wxyz(draw)]
        for part in LAYOUT:
            row += _wxyz(draw) if part.endswith("4") else [draw.uniform(-2, 2)]
        rows.append([float(v) for v in row])
    return rows


def amp_arrays() -> dict:
    draw = np.random.default_rng(3)
    rotations = Rotation.random(12, random_state=draw).as_quat().reshape(3, 4, 4)
    return {
        "local_or_global_rotation_xyzw": rotations.astype(np.float32),
        "root_translation": draw.normal(size=(3, 3)).astype(np.float32),
        "is_local": np.array(True),
        "fps": np.float32(60),
        "node_names": np.array(["pelvis", "torso", "head", "left_thigh"]),
        "parent_indices": np.array([-1, 0, 1, 0]),
        "local_translation": draw.normal(size=(4, 3)).astype(np.float32),
    }


def amass_arrays(columns: int = 156) -> dict:
    draw = np.random.default_rng(0)
    return {
        "poses": draw.uniform(-1.5, 1.5, (7, columns)),
        "trans": draw.normal(size=(7, 3)),
        "betas": draw.normal(size=16),
        "gender": np.array("female"),
        "mocap_framerate": np.array(120.0),
    }


def smpl_arrays(joints: int = 24, vertices: int = 60) -> dict:
    """A body in SMPL's layout: 24 joints (or more), two of them hands, pose correctives, two betas."""
    draw = np.random.default_rng(0)
    parents = [*STANDARD.parents, 20, 21, *([15] * 3), *(20 + i % 2 for i in range(30))][:joints]
    rest = STANDARD.rest_positions().numpy()
    weights = draw.dirichlet(np.full(joints, 0.1), vertices)
    regressor = draw.dirichlet(np.full(vertices, 0.1), joints)
    return {
        "v_template": np.resize(rest, (vertices, 3)) + 0.03 * draw.standard_normal((vertices, 3)),
        "shapedirs": 0.02 * draw.standard_normal((vertices, 3, 2)),
        "posedirs": 0.01 * draw.standard_normal((vertices, 3, 9 * (joints - 1))),
        "J_regressor": regressor,
        "weights": weights,
        "kintree_table": np.array([[2**32 - 1, *parents[1:]], range(joints)], dtype=np.uint32),
        "f": draw.integers(0, vertices, (80, 3)).astype(np.uint32),
    }


def trc_text(rows: list[str] | None = None, names=("A", "B"), unit="mm", rate="60.0") -> str:
    if rows is None:
        rows = [f"{n + 1}\t{n / 60:.4f}\t100.5\t200\t300\t1\t-2\t{n}" for n in range(FRAMES)]
    keys = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
    values = f"{rate}\t{rate}\t{len(rows)}\t{len(names)}\t{unit}\t{rate}\t1\t{len(rows)}"
    labels = "Frame#\tTime\t" + "".join(f"{name}\t\t\t" for name in names)
    columns = "\t\t" + "\t".join(f"{axis}{n + 1}" for n in range(len(names)) for axis in "XYZ")
    return "\n".join(["PathFileType\t4\t(X/Y/Z)\tfile.trc", keys, values, labels, columns, *rows]) + "\n"


def c3d_entry(name: bytes, group: int, body: bytes, order: str = "<") -> bytes:
    return struct.pack("bb", len(name), group) + name + struct.pack(f"{order}h", len(body) + 2) + body


def c3d_text(words: list[bytes], width: int) -> bytes:
    return struct.pack("bBBB", -1, 2, width, len(words)) + b"".join(w.ljust(width) for w in words) + b"\0"


def c3d_bytes(table: np.ndarray | None = None) -> bytes:
    """Header, one parameter block and 16-bit data, by hand from the format guide; mm, z up, 25 fps, scale 0.5."""
    table = np.arange(FRAMES * 8, dtype="<i2").reshape(FRAMES, 2, 4) if table is None else table

    parameters = b"\1\x50\1\x54" + c3d_entry(b"POINT", -1, b"\0")
    for name, words, width in ((b"LABELS", [b"A", b"BB"], 4), (b"UNITS", [b"mm"], 2), (b"Y_SCREEN", [b"+Z"], 2)):
        parameters += c3d_entry(name, 1, c3d_text(words, width))
    parameters += c3d_entry(b"RATE", 1, struct.pack("<bBf", 4, 0, 25.0) + b"\0")
    header = struct.pack("<BBHHHHHfHHf", 2, 0x50, 2, 0, 1, len(table), 0, 0.5, 3, 0, 25.0)
    return header.ljust(512, b"\0") + parameters.ljust(512, b"\0") + table.tobytes().ljust(512, b"\0")


def camera() -> Camera:
    eye, target = torch.tensor([2.0, -3.0, 1.7]), torch.tensor([0.1, 0.2, 0.9])
    return look_at(eye, target, focal=1500.0, width=1920, height=1088)


def qualisys_text() -> str:
    c = camera()
    rows = np.diag([1.0, -1.0, -1.0]) @ c.rotation.double().numpy()
    turn = " ".join(f'r{i + 1}{j + 1}="{rows[i, j]}"' for i in range(3) for j in range(3))
    x, y, z = (c.centre.double() * 1000).tolist()
    k = c.intrinsics.double().numpy() * 64
    return f"""<?xml version='1.0' encoding='ASCII'?>
<calibration><cameras><camera serial="cam_01">
  <fov_video left="0" top="0" right="{c.width - 1}" bottom="{c.height - 1}"/>
  <transform {turn} x="{x}" y="{y}" z="{z}"/>
  <intrinsic focalLengthU="{k[0, 0]}" focalLengthV="{k[1, 1]}" centerPointU="{k[0, 2]}" centerPointV="{k[1, 2]}"/>
</camera></cameras></calibration>"""


def captury_text() -> str:
    """The same camera in Captury's words: y up, (x, y, z)_file = (x, z, -y)_world, millimetres."""
    c = camera()
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    right, down, _ = c.rotation.double().numpy() @ turn.T
    width, height = 10.0, 10.0 * c.height / c.width
    k = c.intrinsics.double().numpy() * width / c.width

    def line(values) -> str:
        return " ".join(f"{v:.9f}" for v in values)

    return f"""tc camera calibration v0.3
camera\t0\tCamera
\tframe\t0
\t\tsensorSize\t {width:.9f} {height:.9f}\t# in mm
\t\tfocalLength\t {k[0, 0]:.9f}\t# in mm
\t\tpixelAspect\t {k[1, 1] / k[0, 0]:.9f}\t# y / x
\t\tcenterOffset\t {k[0, 2] - width / 2:.9f} {k[1, 2] - height / 2:.9f}\t# in mm
\t\torigin\t{line(turn @ c.centre.double().numpy() * 1000)}
\t\tup\t{line(-down)}
\t\tright\t{line(right)}
"""


def gltf_text(glb: bytes) -> bytes:
    """A .gltf, with its numbers inside, of a GLB."""
    size = int.from_bytes(glb[12:16], "little")
    content = json.loads(glb[20 : 20 + size])
    numbers = base64.b64encode(glb[28 + size :]).decode()
    content["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{numbers}"
    return json.dumps(content).encode()


SEEDS: dict[str, bytes] = {
    ".bvh": saved(bvh.save, ".bvh"),
    ".asf": ASF.encode(),
    ".amc": AMC.encode(),
    "deepmimic.txt": json.dumps({"Loop": "wrap", "Frames": deepmimic_frames()}).encode(),
    "amp.npz": npz(**amp_arrays()),
    "amass.npz": saved(smpl.save_motion, ".npz"),
    "smpl.npz": npz(**smpl_arrays()),
    "smpl.pkl": pickle.dumps(smpl_arrays(), protocol=2),
    "openpose.json": json.dumps(detected.openpose(18, "_2d")).encode(),
    ".trc": trc_text().encode(),
    ".c3d": c3d_bytes(),
    "qualisys.xml": qualisys_text().encode(),
    "captury.calib": captury_text().encode(),
    ".glb": saved(gltf.save, ".glb"),
    ".gltf": gltf_text(saved(gltf.save, ".glb")),
    **calibrated.SEEDS,
    "gvhmr.pt": results.gvhmr(),
    "wham.pkl": results.wham(),
    "phalp.pkl": results.phalp(packed=False),
    "tram.npy": results.tram(),
    "humanml.npy": saved(humanml.save, ".npy"),
    "features.npy": saved(_save_features, ".npy"),
    **detected.SEEDS,
}
