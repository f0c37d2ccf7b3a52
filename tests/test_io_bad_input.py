"""Files that are wrong: every loader answers with a DataError that names file, place and remedy."""

import json
import pickle
import re
import zipfile
from pathlib import Path

import detected
import numpy as np
import pytest
import seeds
from loaders import LOADERS, numbers_of, refused

from motionlab import io
from motionlab.errors import DataError
from motionlab.io import keypoints, smpl


@pytest.mark.parametrize("kind", seeds.SEEDS)
def test_the_seed_itself_is_valid(tmp_path, kind):
    path = tmp_path / f"seed{kind}"
    path.write_bytes(seeds.SEEDS[kind])
    assert all(tensor.isfinite().all() for tensor in numbers_of(LOADERS[kind](path)))


GARBAGE = np.random.default_rng(0).integers(0, 256, 3000, dtype=np.uint8).tobytes()
WHOLE = {
    "empty": lambda data: b"",
    "blank": lambda data: b"\n \n",
    "binary garbage": lambda data: GARBAGE,
    "zero bytes": lambda data: b"\0" * len(data),
    "cut after a third": lambda data: data[: len(data) // 3],
    "not this format": lambda data: b"<html><body>404 Not Found</body></html>",
    "a zip of nothing": lambda data: b"PK\x05\x06" + b"\0" * 18,
}


@pytest.mark.parametrize("how", WHOLE)
@pytest.mark.parametrize("kind", seeds.SEEDS)
def test_files_that_are_no_such_files(tmp_path, kind, how):
    path = tmp_path / f"bad{kind}"
    path.write_bytes(WHOLE[how](seeds.SEEDS[kind]))
    with refused("bad"):
        LOADERS[kind](path)


@pytest.mark.parametrize("kind", [kind for kind in seeds.SEEDS if kind != "openpose.json"])
def test_nothing_there_or_a_folder(tmp_path, kind):
    with refused("none", "no such file"):
        LOADERS[kind](tmp_path / f"none{kind}")
    with refused(str(tmp_path)):
        LOADERS[kind](tmp_path)


def text(kind: str, old: str, new: str, count: int = 1) -> bytes:
    """The seed with a text replaced; the pattern must be there."""
    changed, times = re.subn(old, new, seeds.SEEDS[kind].decode(), count=count, flags=re.MULTILINE)
    assert times, f"{old!r} is not in the seed of {kind}"
    return changed.encode()


def archive(arrays: dict, **changes) -> bytes:
    """An npz with arrays changed, or dropped where the new value is None."""
    return seeds.npz(**{key: value for key, value in (arrays | changes).items() if value is not None})


def with_nan(array: np.ndarray) -> np.ndarray:
    array = array.astype(float).copy()
    array.flat[array.size // 2] = np.nan
    return array


def people(*flats) -> bytes:
    return json.dumps({"people": [{"pose_keypoints_2d": flat} for flat in flats]}).encode()


AMASS, AMP, SMPL = seeds.amass_arrays(), seeds.amp_arrays(), seeds.smpl_arrays()
POSES = AMASS["poses"]
#: name -> (kind, file, words of the message); BVH, ASF, AMC, DeepMimic, AMP and SMPL have tables of their own
MALFORMED: dict[str, tuple[str, bytes, tuple[str, ...]]] = {
    "bvh: absurdly many frames": (".bvh", text(".bvh", r"Frames:\s*4", "Frames: 1000000000000"), ()),
    "deepmimic: nested without end": ("deepmimic.txt", b'{"Frames": ' + b"[" * 100_000, ()),
    "amass: 155 columns": ("amass.npz", archive(AMASS, poses=POSES[:, :155]), ("poses", "155")),
    "amass: trans too short": ("amass.npz", archive(AMASS, trans=np.zeros((3, 3))), ("trans",)),
    "amass: trans missing": ("amass.npz", archive(AMASS, trans=None), ("trans",)),
    "amass: no frame rate": ("amass.npz", archive(AMASS, mocap_framerate=None), ("mocap_framerate",)),
    "amass: negative frame rate": ("amass.npz", archive(AMASS, mocap_framerate=np.array(-30.0)), ("-30",)),
    "amass: two frame rates": ("amass.npz", archive(AMASS, mocap_framerate=np.array([30.0, 60.0])), ("frame",)),
    "amass: NaN": ("amass.npz", archive(AMASS, poses=with_nan(POSES)), ("poses", "nan")),
    "amass: zero frames": ("amass.npz", archive(AMASS, poses=POSES[:0], trans=np.zeros((0, 3))), ("poses",)),
    "amass: text for numbers": ("amass.npz", archive(AMASS, trans=np.full((4, 3), "x")), ("trans",)),
    "amass: complex numbers": ("amass.npz", archive(AMASS, poses=POSES + 1j), ("poses",)),
    "amass: body without root": (
        "amass.npz", archive(AMASS, poses=None, pose_body=POSES[:, 3:66]), ("root_orient",),
    ),
    "amass: a pickled object": ("amass.npz", archive(AMASS, poses=np.array([{}], dtype=object)), ("pickled",)),
    "smpl: 20 joints": ("smpl.npz", archive(SMPL, kintree_table=SMPL["kintree_table"][:, :20]), ("kintree",)),
    "smpl: pickle of a list": ("smpl.pkl", pickle.dumps([1, 2, 3], protocol=2), ()),
    "smpl: pickle that refers to itself": ("smpl.pkl", b"\x80\x02]q\x00h\x00a.", ()),
    "openpose: no people": ("openpose.json", b'{"version": 1.3}', ("people",)),
    "openpose: people is a number": ("openpose.json", b'{"people": 3}', ("people",)),
    "openpose: 53 numbers": ("openpose.json", people([1.0] * 53), ("person 0",)),
    "openpose: people of two layouts": ("openpose.json", people([1.0] * 54, [1.0] * 75), ("keypoints, got",)),
    "openpose: other layout than the next frame": ("openpose.json", people([1.0] * 75), ("frame 8",)),
    "openpose: a text": ("openpose.json", people(["a"] * 54), ("person 0",)),
    "openpose: 1e400": ("openpose.json", people([1.0] * 53 + [0]).replace(b" 0]", b" 1e400]"), ("person 0",)),
    "trc: a coordinate too many": (".trc", text(".trc", r"\t-2\t0$", "\t-2\t0\t7"), ("line 6",)),
    "trc: more markers": (".trc", text(".trc", "\t2\tmm", "\t3\tmm"), ("NumMarkers",)),
    "trc: rate zero": (".trc", text(".trc", "^60.0", "0"), ("DataRate",)),
    "trc: rate negative": (".trc", text(".trc", "^60.0", "-60"), ("DataRate",)),
    "trc: a word": (".trc", text(".trc", "300", "left"), ("line 6",)),
    "trc: unit unknown": (".trc", text(".trc", "mm", "px"), ("Units",)),
    "c3d: other processor": (".c3d", seeds.SEEDS[".c3d"].replace(b"\1\x50\1\x54", b"\1\x50\1\x57"), ("87",)),
    "c3d: more frames": (".c3d", seeds.c3d_bytes(np.zeros((80, 2, 4), "<i2"))[:1536], ("80 frames",)),
    "c3d: no frames": (".c3d", seeds.c3d_bytes(np.zeros((0, 2, 4), "<i2")), ("3-D data",)),
    "c3d: unit unknown": (".c3d", seeds.SEEDS[".c3d"].replace(b"mm", b"px"), ("UNITS",)),
    "c3d: rate negative": (".c3d", seeds.SEEDS[".c3d"].replace(b"\x00\x00\xc8\x41", b"\x00\x00\xc8\xc1"), ("RATE",)),
    "c3d: labels of one name": (".c3d", seeds.SEEDS[".c3d"].replace(b"BB  ", b"A   "), ("LABELS",)),
    "qualisys: not a rotation": ("qualisys.xml", text("qualisys.xml", r'r11="[^"]*"', 'r11="3"'), ("cam_01",)),
    "qualisys: a focal length missing": ("qualisys.xml", text("qualisys.xml", "focalLengthU", "fx"), ("focalLengthU",)),
    "qualisys: entities": (
        "qualisys.xml", text("qualisys.xml", "<calibration>", '<!DOCTYPE a [<!ENTITY b "c">]><calibration>'), (),
    ),
    "captury: sensor of zero": ("captury.calib", text("captury.calib", r"10\.0{9}", "0.0"), ("sensorSize",)),
    "captury: no right": ("captury.calib", text("captury.calib", "\tright", "\tleft"), ("right",)),
    "captury: NaN": ("captury.calib", text("captury.calib", r"focalLength\t \S+", "focalLength\t nan"), ("focal",)),
    "glb: absurd length": (".glb", seeds.SEEDS[".glb"][:8] + b"\xff" * 4 + seeds.SEEDS[".glb"][12:], ()),
}  # fmt: skip


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_say_what_where_and_what_to_do(tmp_path, name):
    kind, data, words = MALFORMED[name]
    path = tmp_path / f"bad{kind}"
    path.write_bytes(data)
    with refused(*words):
        LOADERS[kind](path)


@pytest.mark.parametrize("fps", [0, -30, float("nan"), float("inf"), None, "30"])
def test_frame_rates_from_callers_are_checked(tmp_path, fps):
    path = tmp_path / "0.json"
    path.write_bytes(seeds.SEEDS["openpose.json"])
    with pytest.raises(DataError, match="frames per second"):
        keypoints.load_person(tmp_path, fps=fps)


def test_openpose_folders_that_are_none(tmp_path):
    for folder, words in ((tmp_path, "no numbered JSON"), (tmp_path / "none", "no such file")):
        with refused(words):
            keypoints.load_person(folder, fps=30)
    (tmp_path / "a1.json").write_text('{"people": []}')
    with pytest.raises(DataError, match="nobody"):
        keypoints.load_person(tmp_path, fps=30)
    (tmp_path / "a01.json").write_text('{"people": []}')
    with pytest.raises(DataError, match="same frame number"):
        keypoints.load_person(tmp_path, fps=30)
    (tmp_path / "a01.json").unlink()
    (tmp_path / "a999999999999.json").write_bytes(people([1.0] * 54))
    with pytest.raises(DataError, match="stray"):
        keypoints.load_person(tmp_path, fps=30)


class Hostile:
    """Unpickling this writes a file."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self):
        return Path.touch, (self.canary,)


@pytest.fixture
def canary(tmp_path):
    """A file that must not appear; the pickle that would make it does so when it is really loaded."""
    sure = tmp_path / "sure"
    pickle.loads(pickle.dumps(Hostile(sure)))
    assert sure.exists()
    yield tmp_path / "canary"
    assert not (tmp_path / "canary").exists()


@pytest.mark.parametrize("kind", seeds.SEEDS)
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_pickles_are_never_executed(tmp_path, canary, kind, protocol):
    path = tmp_path / f"bad{kind}"
    for thing in (Hostile(canary), {"v_template": Hostile(canary)}, {**SMPL, "weights": Hostile(canary)}):
        path.write_bytes(pickle.dumps(thing, protocol=protocol))
        with refused("bad"):
            LOADERS[kind](path)


@pytest.mark.parametrize("kind", ["amp.npz", "amass.npz", "smpl.npz", "plain.npz"])
def test_objects_in_archives_are_never_unpickled(tmp_path, canary, kind):
    known = {"amp.npz": AMP, "amass.npz": AMASS, "smpl.npz": SMPL}
    whole = (known | {"plain.npz": detected.plain_arrays()})[kind]
    path = tmp_path / f"bad{kind}"
    for key in whole.keys() - {"betas", "gender"}:  # which nothing reads
        path.write_bytes(archive(whole, **{key: np.array([Hostile(canary)], dtype=object)}))
        for loader in (LOADERS[kind], io.load_npz, io.load):
            with pytest.raises(DataError):
                loader(path)


def test_archives_that_promise_too_much(tmp_path):
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 66), }".ljust(117) + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 80
    path = tmp_path / "bad.npz"
    with zipfile.ZipFile(path, "w") as target:
        target.writestr("poses.npy", member)
    with refused("poses", "promises shape"):
        smpl.load_motion(path)
