"""AMP clips: quaternion order and local rotations against scipy, and wrong files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from loaders import refused
from scipy.spatial.transform import Rotation
from seeds import amp_arrays as clip

from motionlab.io import clips
from tests.twins import fk as twin_fk

KEY = "local_or_global_rotation_xyzw"


def write(folder: Path, arrays: dict[str, np.ndarray] | bytes) -> Path:
    path = folder / "clip.npz"
    if isinstance(arrays, bytes):
        path.write_bytes(arrays)
    else:
        np.savez(path, **arrays)
    return path


def test_agrees_with_scipy_and_a_scalar_tree(tmp_path):
    arrays = clip()
    motion = clips.load_amp(write(tmp_path, arrays))
    assert motion.fps == 60 and motion.skeleton.names[3] == "left_thigh"
    rot = Rotation.from_quat(arrays[KEY][1]).as_matrix()
    expected, _ = twin_fk([-1, 0, 1, 0], arrays["local_translation"], arrays["root_translation"][1], rot)
    np.testing.assert_allclose(motion.positions[1].numpy(), expected, atol=1e-5)


def test_global_rotations_are_made_local(tmp_path):
    arrays = clip()
    local = clips.load_amp(write(tmp_path, arrays))
    world = Rotation.from_matrix(local.world[1].double().numpy().reshape(-1, 3, 3)).as_quat().reshape(3, 4, 4)
    again = clips.load_amp(write(tmp_path, arrays | {KEY: world, "is_local": np.array(False)}))
    torch.testing.assert_close(again.rot, local.rot, atol=1e-5, rtol=0)
    wrong = clips.load_amp(write(tmp_path, arrays | {KEY: world}))
    assert (wrong.rot - local.rot).abs().max() > 0.1


def without(key: str) -> dict[str, np.ndarray]:
    return {k: v for k, v in clip().items() if k != key}


def nan(key: str) -> dict[str, np.ndarray]:
    arrays = clip()
    arrays[key].flat[5] = np.nan
    return arrays


WRONG = {
    **{f"no {key}": (without(key), f"missing {key}") for key in clip()},
    "pickled names": (clip() | {"node_names": np.array(["a", None, "c", "d"], dtype=object)}, "node_names.*pickled"),
    "names are numbers": (clip() | {"node_names": np.arange(4)}, "node_names"),
    "duplicate names": (clip() | {"node_names": np.array(["a", "b", "b", "c"])}, "node_names.*different"),
    "cyclic parents": (clip() | {"parent_indices": np.array([-1, 2, 1, 0])}, "parent_indices.*before children"),
    "two roots": (clip() | {"parent_indices": np.array([-1, 0, -1, 0])}, "parent_indices"),
    "NaN rotation": (nan(KEY), f"{KEY}.*not a usable number"),
    "zero quaternion": (clip() | {KEY: np.zeros((3, 4, 4))}, "frame 0, pelvis.*length 0"),
    "a joint too few": (clip() | {KEY: clip()[KEY][:, :3]}, f"{KEY}.*expected shape"),
    "zero frames": (clip() | {KEY: np.zeros((0, 4, 4))}, "expected shape"),
    "fps a word": (clip() | {"fps": np.array("sixty")}, "fps"),
    "is_local a word": (clip() | {"is_local": np.array("yes")}, "is_local"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_name_file_place_and_remedy(tmp_path, name):
    content, words = WRONG[name]
    with refused(match=words):
        clips.load_amp(write(tmp_path, content))
