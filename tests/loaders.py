"""One way to call every loader on one file, and what to ask of its result or its error."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import calibrated
import detected
import pytest
import seeds
import torch

from motionlab import io
from motionlab.body import BodyModel
from motionlab.errors import DataError
from motionlab.io import asf, bvh, clips, gltf, keypoints, points, smpl
from motionlab.io.cameras import load_camera, load_cameras
from motionlab.io.keypoints import Footage
from motionlab.io.points import Positions
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D


def load_asf(path: Path):
    other = path.with_name("whole.amc")
    other.write_bytes(seeds.SEEDS[".amc"])
    return asf.load(path, other)


def load_amc(path: Path):
    other = path.with_name("whole.asf")
    other.write_bytes(seeds.SEEDS[".asf"])
    return asf.load(other, path)


def load_openpose(path: Path):
    """The file as frame 7 of a folder of its own; frame 8 is whole."""
    folder = path.with_name("frames")
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    if path.is_file():
        (folder / "bad_7_keypoints.json").write_bytes(path.read_bytes())
    (folder / "bad_8_keypoints.json").write_bytes(seeds.SEEDS["openpose.json"])
    return keypoints.load_person(folder, fps=30)


LOADERS = {
    ".bvh": bvh.load,
    ".asf": load_asf,
    ".amc": load_amc,
    "deepmimic.txt": clips.load_deepmimic,
    "amp.npz": clips.load_amp,
    "amass.npz": smpl.load_motion,
    "smpl.npz": smpl.load,
    "smpl.pkl": smpl.load,
    "openpose.json": load_openpose,
    ".trc": points.load_trc,
    ".c3d": points.load_c3d,
    **dict.fromkeys(("qualisys.xml", "captury.calib"), load_cameras),
    ".glb": gltf.load,
    ".gltf": gltf.load,
    **dict.fromkeys(calibrated.SEEDS, lambda path: load_camera(path)[0]),
    "gvhmr.pt": smpl.load_motion,
    "wham.pkl": smpl.load_motion,
    "phalp.pkl": smpl.load_motion,
    "tram.npy": io.load_npy,
    "humanml.npy": io.load_npy,
    "features.npy": io.load_npy,
    **dict.fromkeys(detected.SEEDS, partial(keypoints.load, fps=30, size=detected.SIZE)),
}


def numbers_of(value) -> list[torch.Tensor]:
    """Every tensor that a loaded value gives."""
    if isinstance(value, Motion):
        return [value.positions, value.world[1]]
    if isinstance(value, Positions):
        return [value.positions]
    if isinstance(value, Observation2D):
        return [value.keypoints, value.confidence]
    if isinstance(value, Footage):
        everybody = value.people([track.id for track in value.tracks])
        return [everybody.keypoints, everybody.confidence, torch.tensor([list(r.values()) for r in value.table()])]
    if isinstance(value, BodyModel):
        return [value.template, value.joints, value.weights, value.skeleton.offsets]
    cameras = value.values() if isinstance(value, dict) else value if isinstance(value, list) else [value]
    assert all(isinstance(camera, Camera) for camera in cameras) and cameras
    return [t for camera in cameras for t in (camera.intrinsics, camera.rotation, camera.translation)]


def check_error(error: DataError, *words: str) -> None:
    """The message names the file, a place in it and a remedy."""
    assert error.path and error.place and error.remedy
    text = str(error)
    assert all(str(part) in text for part in (error.path, error.place, error.remedy))
    assert "(DataError" not in text  # an error that says it all passes as it is
    for word in words:
        assert word in text


@contextmanager
def refused(*words: str, match: str | None = None) -> Iterator[None]:
    """A loader that is called within answers so."""
    with pytest.raises(DataError, match=match) as caught:
        yield
    check_error(caught.value, *words)
