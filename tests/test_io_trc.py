import re

import numpy as np
import pytest
import torch
from seeds import trc_text as table

from motionlab.errors import ShapeError
from motionlab.io import points
from motionlab.io.judging import axes_to_matrix
from tests.recorded import DATA, needs_data


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


@pytest.mark.parametrize("axes", ["xyz", "zxy", "x-zy", "-xzy", "yzx"])
def test_axes_are_rotations_that_pick_file_axes(axes):
    matrix = axes_to_matrix(axes).numpy()
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3))
    assert np.linalg.det(matrix) == pytest.approx(1)


@pytest.mark.parametrize("axes", ["xzy", "xxy", "xy", "", "x y z", "-x-y-z"])
def test_mirrors_and_nonsense_are_no_axes(axes):
    with pytest.raises(ShapeError, match="right-handed"):
        axes_to_matrix(axes)


@needs_data
def test_real_person_stands_upright():
    loaded = points.load_trc(DATA / "pose2sim_openpose/ref3d/Balancing_for_IK.trc")
    assert (loaded.frames, len(loaded.names), loaded.fps) == (100, 21, 60.0) and loaded.valid.all()
    height = loaded.positions[..., 2]
    low, high = (height[:, loaded.names.index(name)].mean() for name in ("LHeel", "Head"))
    assert -0.1 < low < 0.3 and 1.3 < high < 2.0


def lab(axes: str, change=lambda text: text, **how) -> str:
    """A person of 1.7 m, as labs write tables: which file axis is up, right and forward."""
    still = {"Head": (0, 1.7, 0), "LHip": (0, 0.9, -0.1), "RHip": (0, 0.9, 0.1), "LAnkle": (0, 0.1, -0.1)}
    pick = ["xyz".index(letter) for letter in axes]
    cells = "\t".join(str(point[k]) for point in still.values() for k in pick)
    return change(table([f"{n + 1}\t{n / 60}\t{cells}" for n in range(4)], tuple(still), "m", **how))


@pytest.mark.parametrize(("axes", "up"), [("xyz", "y"), ("xzy", "z"), ("yxz", "x")])
def test_what_is_up_in_a_lab_is_seen_by_the_heads(tmp_path, axes, up):
    (tmp_path / "a.trc").write_text(lab(axes))
    loaded = points.load_trc(tmp_path / "a.trc")
    np.testing.assert_allclose(loaded.positions[:, :, 2], [[1.7, 0.9, 0.9, 0.1]] * 4, atol=1e-6)
    assert any(f"up axis {up} detected" in note and "--up" in note for note in loaded.notes)
    given = points.load_trc(tmp_path / "a.trc", up="y")
    assert not given.notes and float(given.positions[0, 0, 2]) == pytest.approx((0, 1.7, 0)["xyz".index(axes[1])])


HABITS = {  # what labs write -> words of the note
    "padded header": (lambda t: t.replace("60.0\t60.0\t4\t4\tm", " 60.0\t\t 60.0\t\t 4\t\t 4 \t\tm"), ""),
    "a count with a point": (lambda t: t.replace("60.0\t60.0\t4\t4\tm", "60.0\t60.0\t4.0\t4.0\tm"), ""),
    "a wrong count": (lambda t: t.replace("60.0\t60.0\t4\t4", "60.0\t60.0\t100\t4"), "promises 100 frames: the 4"),
    "no count": (lambda t: t.replace("60.0\t60.0\t4\t4", "60.0\t60.0\t0\t4"), "promises 0 frames: the 4"),
    "no unit": (lambda t: t.replace("4\t4\tm", "4\t4\t"), "unit m detected"),
    "another unit": (lambda t: t.replace("4\t4\tm", "4\t4\tmetric"), "unit m detected"),
    "meters": (lambda t: t.replace("4\t4\tm", "4\t4\tMeters"), ""),
}


@pytest.mark.parametrize("habit", HABITS)
def test_headers_as_labs_write_them(tmp_path, habit):
    change, words = HABITS[habit]
    assert change(lab("xyz")) != lab("xyz")
    (tmp_path / "a.trc").write_text(lab("xyz", change))
    loaded = points.load_trc(tmp_path / "a.trc")
    assert loaded.frames == 4 and loaded.valid.all() and float(loaded.positions[0, 0, 2]) == pytest.approx(1.7)
    assert [words in note for note in loaded.notes if "up axis" not in note] == [True] * bool(words)


def test_zeros_and_rows_that_end_early_were_not_measured(tmp_path):
    rows = ["1\t0.0\t0\t0\t0\t1\t2\t3", "2\t0.1\t1\t2\t3\t4", "3\t0.2\t1\t2\t3"]
    (tmp_path / "a.trc").write_text(table(rows, unit="m"))
    loaded = points.load_trc(tmp_path / "a.trc")
    assert loaded.valid.tolist() == [[False, True], [True, False], [True, False]]
    notes = " ".join(loaded.notes)
    assert "1 of 6 points" in notes and "2 of 3 rows end early" in notes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.replace("60.0\t60.0\t8", "30\t60.0\t8"), "times are of 60 frames per second, not of 30"),
        (lambda t: "\n".join(line for line in t.split("\n") if not line.startswith("3\t")), "frames are missing"),
        (lambda t: t, ""),
        (lambda t: re.sub(r"(?m)^(\d)\t[\d.]+\t", r"\1\t\t", t), ""),  # no times say nothing
    ],
)
def test_times_that_speak_against_the_rate_or_leave_frames_out(tmp_path, change, words):
    rows = [f"{n + 1}\t{n / 60:.6f}\t0\t1.7\t0\t0\t0.1\t{n}" for n in range(8)]
    (tmp_path / "a.trc").write_text(change(table(rows, ("Head", "LAnkle"), "m")))
    notes = [note for note in points.load_trc(tmp_path / "a.trc", up="y", fps=None).notes if "NumFrames" not in note]
    assert [words in note for note in notes] == [True] * bool(words)
    assert not any("times are" in note for note in points.load_trc(tmp_path / "a.trc", fps=60).notes)
