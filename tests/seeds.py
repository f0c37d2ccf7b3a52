"""Small valid files of every format, as bytes, for the tests of loaders. Made here; no recording is copied."""

import base64
import io
import json
import pickle
import struct
import tempfile
from functools import partial
from pathlib import Path

import calibrated
import detected
import numpy as np
import torch

import results
from motionlab import humanml, rotation
from motionlab.io import amass, bvh, gltf
from motionlab.motion import Motion
from motionlab.observation import Camera, look_at
from motionlab.skeleton import STANDARD, UPRIGHT

FRAMES = 4


def motion(frames: int = FRAMES) -> Motion:
    """A standing body that bends a little at random."""
    generator = torch.Generator().manual_seed(0)
    rot = rotation.exp(0.2 * torch.randn(frames, 22, 3, generator=generator))
    rot[:, 0] = UPRIGHT @ rot[:, 0]
    root = torch.tensor([0.0, 0.0, float(STANDARD.standing_height())]) + 0.01 * torch.arange(frames)[:, None]
    return Motion(STANDARD, root, rot, 30.0)


def saved(save, suffix: str) -> bytes:
    """What a saver of ours writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"seed{suffix}"
        save(path, motion())
        return path.read_bytes()


def npz(**arrays) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def asf_text() -> str:
    def bone(number: int, name: str, direction: str, dof: str) -> str:
        limits = "(-90 90)\n           " * len(dof.split())
        freedom = f"    dof {dof}\n    limits {limits.strip()}\n" if dof else ""
        return (
            f"  begin\n     id {number}\n     name {name}\n     direction {direction}\n     length 7.5\n"
            f"     axis 0 0 20 XYZ\n{freedom}  end\n"
        )

    bones = [("lhip", "0.6 -0.8 0", ""), ("lfemur", "0 -1 0", "rx ry rz"), ("ltibia", "0 -1 0", "rx")]
    body = "".join(bone(n, *b) for n, b in enumerate([*bones, ("spine", "0 1 0", "rx ry rz")], start=1))
    return (
        ":version 1.10\n:name TEST\n:units\n  mass 1.0\n  length 0.45\n  angle deg\n:documentation\n  made by a test\n"
        ":root\n  order TX TY TZ RX RY RZ\n  axis XYZ\n  position 0 0 0\n  orientation 0 0 0\n"
        f":bonedata\n{body}:hierarchy\n  begin\n    root lhip spine\n    lhip lfemur\n    lfemur ltibia\n  end\n"
    )


def amc_text() -> str:
    frame = "{}\nroot 1.5 16.5 -3 {} 2 3\nlfemur 10 -5 {}\nltibia 20\nspine 1 2 3\n"
    return "#!OML:ASF test\n:FULLY-SPECIFIED\n:DEGREES\n" + "".join(frame.format(n, n, n) for n in range(1, FRAMES + 1))


def deepmimic_text() -> str:
    ball = [0.998, 0.05, 0.03, 0.02]
    sizes = [4, 4, 4, 1, 4, 4, 1, 4, 1, 4, 4, 1]
    joints = [x for size in sizes for x in (ball if size == 4 else [0.1])]
    return json.dumps(
        {"Loop": "wrap", "Frames": [[0.033, 0.0, 0.9, 0.01 * n, *ball, *joints][:44] for n in range(FRAMES)]}
    )


def amp_arrays() -> dict:
    turn = np.tile(np.array([0.0, 0.0, 0.1, 0.99498744]), (FRAMES, 3, 1))
    return {
        "local_or_global_rotation_xyzw": turn,
        "root_translation": np.full((FRAMES, 3), 0.9),
        "node_names": np.array(["pelvis", "torso", "head"]),
        "parent_indices": np.array([-1, 0, 1]),
        "local_translation": np.array([[0.0, 0, 0], [0, 0, 0.3], [0, 0, 0.4]]),
        "fps": np.array(30),
        "is_local": np.array(True),
    }


def amass_arrays() -> dict:
    draw = np.random.default_rng(0)
    return {
        "poses": draw.uniform(-1, 1, (FRAMES, 156)),
        "trans": draw.normal(size=(FRAMES, 3)),
        "betas": draw.normal(size=10),
        "gender": np.array("male"),
        "mocap_framerate": np.array(60.0),
    }


def anidance_arrays() -> dict:
    return {"positions_cm": np.random.default_rng(0).normal(size=(FRAMES, 24, 3)) * 50, "fps": np.array(25.0)}


def smpl_arrays() -> dict:
    """A body of SMPL's layout on 24 joints: a few vertices about each joint."""
    rest = STANDARD.rest_positions().numpy()
    rest = np.concatenate([rest, rest[20:22] + np.array([[0.1, 0, 0], [-0.1, 0, 0]])])
    draw = np.random.default_rng(0)
    template = (rest[:, None] + draw.normal(scale=0.02, size=(24, 2, 3))).reshape(-1, 3)
    weights = np.repeat(np.eye(24), 2, axis=0) * 0.9 + 0.1 / 24
    parents = np.array([2**32 - 1, *STANDARD.parents[1:], 20, 21])
    return {
        "v_template": template,
        "shapedirs": draw.normal(scale=0.01, size=(48, 3, 10)),
        "J_regressor": np.repeat(np.eye(24), 2, axis=1) / 2,
        "weights": weights,
        "kintree_table": np.stack([parents, np.arange(24)]).astype(np.int64),
        "f": draw.integers(0, 48, (20, 3)),
    }


def openpose_text() -> str:
    points = np.random.default_rng(0).uniform(10, 500, (2, 18, 3)).round(2)
    points[..., 2] = 0.7
    return json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": p.reshape(-1).tolist()} for p in points]})


def trc_text(rows: list[str] | None = None, names=("A", "B"), unit="mm", rate="60.0") -> str:
    if rows is None:
        rows = [f"{n + 1}\t{n / 60:.4f}\t100.5\t200\t300\t1\t-2\t{n}" for n in range(FRAMES)]
    keys = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
    values = f"{rate}\t{rate}\t{len(rows)}\t{len(names)}\t{unit}\t{rate}\t1\t{len(rows)}"
    labels = "Frame#\tTime\t" + "".join(f"{name}\t\t\t" for name in names)
    columns = "\t\t" + "\t".join(f"{axis}{n + 1}" for n in range(len(names)) for axis in "XYZ")
    return "\n".join(["PathFileType\t4\t(X/Y/Z)\tfile.trc", keys, values, labels, columns, *rows]) + "\n"


def c3d_bytes(table: np.ndarray | None = None) -> bytes:
    """Header, one parameter block and 16-bit data, by hand from the format guide; mm, z up, 25 fps, scale 0.5."""
    table = np.arange(FRAMES * 8, dtype="<i2").reshape(FRAMES, 2, 4) if table is None else table

    def entry(name: bytes, group: int, body: bytes) -> bytes:
        return struct.pack("<bb", len(name), group) + name + struct.pack("<h", len(body) + 2) + body

    def text(words: list[bytes], width: int) -> bytes:
        return struct.pack("<bBBB", -1, 2, width, len(words)) + b"".join(w.ljust(width) for w in words) + b"\0"

    parameters = b"\1\x50\1\x54" + entry(b"POINT", -1, b"\0")
    parameters += entry(b"LABELS", 1, text([b"A", b"BB"], 4)) + entry(b"UNITS", 1, text([b"mm"], 2))
    parameters += entry(b"Y_SCREEN", 1, text([b"+Z"], 2)) + entry(b"RATE", 1, struct.pack("<bBf", 4, 0, 25.0) + b"\0")
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


def biomech_text() -> str:
    groups = "Frame;Sub Frame;Annotations;CenterOfGravity;;;LWristPositions;;;LWristAngles;;;;Left Toe Out"
    units = "\n;;;X;Y;Z;X;Y;Z;X;Y;Z;W;Left\n;;;mm;mm;mm;mm;mm;mm;;;;;deg\n"
    rows = "".join(f"{n};0;;-1.5;2;{n};4;5;6;0;0;0;1;7\n" for n in range(FRAMES))
    return f"Unknown recording time\nFrames;{FRAMES}\n;;;{groups.split(';', 3)[3]}{units}{rows}"


def projected_text() -> str:
    rows = "".join(f"{20 * n},0.4,0.3,0.{n}1,0.25\n" for n in range(FRAMES))
    return f"Timestamps [ms],Hips,,Head,,\n{rows}"


def gltf_text(glb: bytes) -> bytes:
    """A .gltf, with its numbers inside, of a GLB."""
    size = int.from_bytes(glb[12:16], "little")
    content = json.loads(glb[20 : 20 + size])
    numbers = base64.b64encode(glb[28 + size :]).decode()
    content["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{numbers}"
    return json.dumps(content).encode()


SEEDS: dict[str, bytes] = {
    ".bvh": saved(bvh.save, ".bvh"),
    ".asf": asf_text().encode(),
    ".amc": amc_text().encode(),
    "deepmimic.txt": deepmimic_text().encode(),
    "amp.npz": npz(**amp_arrays()),
    "amass.npz": saved(amass.save, ".npz"),
    "anidance.npz": npz(**anidance_arrays()),
    "smpl.npz": npz(**smpl_arrays()),
    "smpl.pkl": pickle.dumps(smpl_arrays(), protocol=2),
    "openpose.json": openpose_text().encode(),
    ".trc": trc_text().encode(),
    ".c3d": c3d_bytes(),
    "qualisys.xml": qualisys_text().encode(),
    "captury.calib": captury_text().encode(),
    "biomech.csv": biomech_text().encode(),
    "projected.csv": projected_text().encode(),
    ".glb": saved(gltf.save, ".glb"),
    ".gltf": gltf_text(saved(gltf.save, ".glb")),
    **calibrated.SEEDS,
    "gvhmr.pt": results.gvhmr(),
    "wham.pkl": results.wham(),
    "phalp.pkl": results.phalp(packed=False),
    "tram.npy": results.tram(),
    "humanml.npy": saved(humanml.save, ".npy"),
    "features.npy": saved(partial(humanml.save, as_features=True), ".npy"),
    **detected.SEEDS,
}
