"""DeepMimic's JSON: against scipy and a scalar tree, its traps, and wrong files."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from loaders import refused
from scipy.spatial.transform import Rotation
from seeds import LAYOUT
from seeds import deepmimic_frames as frames

from motionlab.io import clips
from tests.recorded import DATA, needs_data
from tests.twins import fk as twin_fk


def write(folder: Path, content) -> Path:
    path = folder / "clip.txt"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    return path


def test_agrees_with_scipy_and_a_scalar_tree(tmp_path):
    rows = frames()
    motion = clips.load_deepmimic(write(tmp_path, {"Loop": "none", "Frames": rows}))
    assert motion.fps == 30.0 and motion.frames == 3 and motion.notes == ()
    row = rows[1]
    quaternion = lambda at: Rotation.from_quat([*row[at + 1 : at + 4], row[at]]).as_matrix()  # noqa: E731
    rot, at = [quaternion(4)], 8
    for part in LAYOUT:
        rot.append(quaternion(at) if part.endswith("4") else Rotation.from_euler("z", row[at]).as_matrix())
        at += int(part[-1])
        if "elbow" in part:
            rot.append(np.eye(3))  # the wrist is fixed
    assert at == 44
    skeleton = motion.skeleton
    expected, _ = twin_fk(skeleton.parents, skeleton.offsets.double().numpy(), np.array(row[1:4]), rot)
    y_up = motion.positions[1].numpy() @ np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    np.testing.assert_allclose(y_up, expected, atol=1e-5)


def test_knees_and_elbows_bend_as_a_human_does(tmp_path):
    row = [0.1, 0, 1, 0, 1, 0, 0, 0]
    for part in LAYOUT:
        row += [1, 0, 0, 0] if part.endswith("4") else [-1.0 if "knee" in part else 1.0]
    motion = clips.load_deepmimic(write(tmp_path, {"Frames": [row]}))
    at = lambda name: motion.positions[0, motion.skeleton.index(name)]  # noqa: E731
    forward = motion.rot[0, 0] @ torch.tensor([1.0, 0, 0])
    for side in ("left", "right"):
        assert (at(f"{side}_ankle") - at(f"{side}_knee")) @ forward < -0.3
        assert (at(f"{side}_wrist") - at(f"{side}_elbow")) @ forward > 0.2
    left = torch.linalg.cross(torch.tensor([0.0, 0, 1]), forward)
    assert (at("left_hip") - at("right_hip")) @ left > 0.1


@pytest.mark.parametrize(("duration", "fps"), [(0.033332, 30), (0.008333, 120), (0.0625, 16), (0.041667, 24)])
def test_printed_durations_give_whole_rates(tmp_path, duration, fps):
    rows = [[duration, *row[1:]] for row in frames(4)]
    assert clips.load_deepmimic(write(tmp_path, {"Frames": rows})).fps == fps


def test_uneven_frames_are_resampled_and_noted(tmp_path):
    rows = [[0.2 if i == 1 else 0.1, *row[1:]] for i, row in enumerate(frames(5))]
    motion = clips.load_deepmimic(write(tmp_path, {"Frames": rows}))
    assert motion.frames == 6 and "resampled" in motion.notes[0]
    even = clips.load_deepmimic(write(tmp_path, {"Frames": [[0.1, *row[1:]] for row in rows]}))
    torch.testing.assert_close(motion.root[[0, 1, 3, 4, 5]], even.root)
    torch.testing.assert_close(motion.root[2], (even.root[1] + even.root[2]) / 2)
    torch.testing.assert_close(motion.rot[[0, 1, 3, 4, 5]], even.rot, atol=1e-5, rtol=0)


def broken(frame: int, columns: int | slice, value) -> dict:
    rows = frames()
    rows[frame][columns] = value
    return {"Frames": rows}


WRONG = {
    "a list": ([1, 2], '"Frames"'),
    "no Frames": ({"Loop": "wrap"}, '"Frames"'),
    "Frames a word": ({"Frames": "many"}, '"Frames"'),
    "43 numbers": (broken(2, slice(1), []), "frame 2.*expected shape \\(44\\), got \\(43,\\)"),
    "a frame that is a number": ({"Frames": [*frames(1), 5]}, "frame 1.*expected shape"),
    "NaN": (json.dumps(broken(1, 9, float("nan"))).encode(), "NaN is not a number"),
    "zero quaternion": (broken(1, slice(4, 8), [0] * 4), "frame 1, root.*length 0"),
    "negative duration": (broken(0, 0, -0.03), "frame 0.*only the last"),
    "zero duration inside": (broken(1, 0, 0), "frame 1.*only the last"),
    "one frame without duration": ({"Frames": frames(1)}, "frame 0"),
    "a pause of hours": (broken(1, 0, 9e9), "frame 1.*lasts"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_name_file_place_and_remedy(tmp_path, name):
    content, words = WRONG[name]
    with refused(match=words):
        clips.load_deepmimic(write(tmp_path, content))


@needs_data
def test_recordings_stand_on_the_floor():
    folder = DATA / "deepmimic"
    rates = {"humanoid3d_walk": 30, "humanoid3d_spinkick": 60, "sie_humanoid3d_run_left08": 120}
    for name, fps in rates.items():
        motion = clips.load_deepmimic(folder / f"{name}.txt")
        ankles = motion.positions[:, motion.skeleton.indices(["left_ankle", "right_ankle"]), 2]
        assert motion.fps == fps and 0.0 < float(ankles.min()) < 0.12
