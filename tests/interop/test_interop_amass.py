"""aitviewer reads the AMASS files that we write and puts every joint where we have it, on a body in SMPL-H's format.

SMPL's own bodies may not be shipped; this one has our bones, one vertex a joint.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from motionlab.io import smpl
from motionlab.skeleton import STANDARD
from tests.interop.asking import ask, needs_python

pytestmark = pytest.mark.interop
PELVIS = torch.tensor([-0.002, -0.23, 0.03])  # J_0, which SMPL's translation leaves out
HANDS = [20, 22, 23, 20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35]
PARENTS = [*STANDARD.parents, *HANDS, *(21 if p == 20 else p + 15 for p in HANDS)]


def write_body(folder: Path) -> None:
    """A body file of SMPL-H's keys, 6890 vertices, of which the first 52 are its joints."""
    joints, count = len(PARENTS), 6890
    rest = STANDARD.rest_positions() + PELVIS
    rest = torch.cat((rest, rest[[20] * 15 + [21] * 15] + 0.02)).numpy()
    arrays = {
        "v_template": np.vstack((rest, np.zeros((count - joints, 3)))),
        "shapedirs": np.zeros((count, 3, 16)),
        "posedirs": np.zeros((count, 3, 9 * (joints - 1))),
        "J_regressor": np.eye(joints, count),
        "weights": np.eye(count, joints) + (np.arange(count) >= joints)[:, None] * np.eye(1, joints),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(joints)]),
        "f": np.array([[0, 1, 2]]),
    }
    arrays |= {f"hands_components{side}": np.eye(45) for side in "lr"} | {f"hands_mean{s}": np.zeros(45) for s in "lr"}
    (folder / "smplh").mkdir()
    np.savez(folder / "smplh/SMPLH_FEMALE.npz", **arrays)  # which aitviewer takes for "neutral"


@needs_python
def test_joints_of_another_reader_are_ours(tmp_path, motions):
    walk = replace(motions[0].cut(0, 60), skeleton=STANDARD, contacts=None)
    write_body(tmp_path)
    smpl.save_motion(tmp_path / "walk.npz", replace(walk, root=walk.root - PELVIS))
    said = ask("aitviewer_reads.py", tmp_path / "walk.npz", tmp_path, tmp_path / "joints.npz", 15).stdout
    assert "FPS 30.0" in said and "neutral" in said
    with np.load(tmp_path / "joints.npz") as found:
        joints, half = found["joints"][:, :22], found["other"][:, :22]
    ours = walk.positions.numpy()
    assert np.abs(joints - ours).max() < 1e-3
    assert len(half) == 30 and np.abs(half - ours[::2]).max() < 0.05  # it believes our rate
    feet = joints[:, [STANDARD.index("left_foot"), STANDARD.index("right_foot")], 2].min()
    assert abs(feet - STANDARD.sole) < 0.015
    assert np.abs(joints - ours[:, :, [0, 2, 1]]).max() > 0.5  # negative control: y up
