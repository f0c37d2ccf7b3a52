import os
from pathlib import Path

import numpy as np
import pytest
import torch
from seeds import trc_text as table

from motionlab.errors import DataError, ShapeError
from motionlab.io import points
from motionlab.io.points import axes_to_matrix


def test_units_rate_and_axes(tmp_path):
    path = tmp_path / "a.trc"
    path.write_text(table(["1\t0.0\t100\t200\t300\t1\t2\t3", "2\t0.016\t-100\t0\t50\t4\t5\t6"]))
    loaded = points.load_trc(path)
    assert loaded.names == ("A", "B") and loaded.fps == 60 and loaded.valid.all()
    # OpenSim: x forward, y up, z right -> x right, y forward, z up
    torch.testing.assert_close(loaded.positions[0, 0], torch.tensor([0.3, 0.1, 0.2]))
    torch.testing.assert_close(points.load_trc(path, axes="xyz").positions[0, 0], torch.tensor([0.1, 0.2, 0.3]))
    path.write_text(table(["1\t0.0\t1\t2\t3\t1\t2\t3"], unit="m"))
    torch.testing.assert_close(points.load_trc(path, axes="xyz").positions[0, 0], torch.tensor([1.0, 2.0, 3.0]))


def test_missing_markers_are_masked(tmp_path):
    path = tmp_path / "a.trc"
    path.write_text(table(["1\t0.0\t\t\t\t1\t2\t3", "2\t0.1\tnan\tnan\tnan\t1\t2\t3", "3\t0.2\t1\t2\t3\t\t\t"]))
    loaded = points.load_trc(path)
    assert loaded.valid.tolist() == [[False, True], [False, True], [True, False]]
    assert (loaded.positions[~loaded.valid] == 0).all()


def test_select_and_seconds(tmp_path):
    path = tmp_path / "a.trc"
    path.write_text(table(["1\t0.0\t100\t200\t300\t1\t2\t3"]))
    loaded = points.load_trc(path)
    assert loaded.select(["B", "A"]).names == ("B", "A") and loaded.seconds == pytest.approx(1 / 60)
    with pytest.raises(KeyError, match="points are A, B"):
        loaded.select(["C"])


@pytest.mark.parametrize("axes", ["xyz", "zxy", "x-zy", "-xzy", "yzx"])
def test_axes_are_rotations_that_pick_file_axes(axes):
    matrix = axes_to_matrix(axes).numpy()
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3))
    assert np.linalg.det(matrix) == pytest.approx(1)


@pytest.mark.parametrize("axes", ["xzy", "xxy", "xy", "", "x y z", "-x-y-z"])
def test_mirrors_and_nonsense_are_no_axes(axes):
    with pytest.raises(ShapeError, match="right-handed"):
        axes_to_matrix(axes)


@pytest.mark.parametrize("unit", ["furlong", ""])
def test_unknown_units_are_refused(tmp_path, unit):
    path = tmp_path / "a.trc"
    path.write_text(table(["1\t0.0\t1\t2\t3\t1\t2\t3"], unit=unit))
    with pytest.raises(DataError, match="line 3: unit"):
        points.load_trc(path)


@pytest.mark.skipif(not os.environ.get("MOTIONLAB_DATA"), reason="set MOTIONLAB_DATA to the unpacked recordings")
def test_real_person_stands_upright():
    loaded = points.load_trc(Path(os.environ["MOTIONLAB_DATA"]) / "pose2sim_openpose/ref3d/Balancing_for_IK.trc")
    assert (loaded.frames, len(loaded.names), loaded.fps) == (100, 21, 60.0) and loaded.valid.all()
    height = loaded.positions[..., 2]
    low, high = (height[:, loaded.names.index(name)].mean() for name in ("LHeel", "Head"))
    assert -0.1 < low < 0.3 and 1.3 < high < 2.0
