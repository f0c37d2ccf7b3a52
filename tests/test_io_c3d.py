import os
from pathlib import Path

import numpy as np
import pytest
import seeds
import torch

from motionlab.errors import DataError
from motionlab.io.points import load_c3d

ezc3d = pytest.importorskip("ezc3d")
needs_data = pytest.mark.skipif(
    not os.environ.get("MOTIONLAB_DATA"), reason="set MOTIONLAB_DATA to the unpacked recordings"
)


def write(path: Path, points: np.ndarray, unit="mm", up: str | None = "+Z", analog: int = 0) -> Path:
    """A C3D file by ezc3d; points (T, K, 3), NaN where not measured."""
    frames, count, _ = points.shape
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"], point["UNITS"]["value"] = [50.0], [unit]
    point["LABELS"]["value"] = tuple(f"M{k}" for k in range(count))
    if up:
        file.add_parameter("POINT", "Y_SCREEN", [up])
    data = np.ones((4, count, frames))
    data[:3] = points.transpose(2, 1, 0)
    file["data"]["points"] = data
    if analog:
        file["parameters"]["ANALOG"]["RATE"]["value"] = [100.0]
        file["parameters"]["ANALOG"]["LABELS"]["value"] = tuple(f"V{k}" for k in range(analog))
        file["data"]["analogs"] = np.random.default_rng(1).normal(size=(1, analog, frames * 2))
    file.write(str(path))
    return path


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(9, 5, 3)) * 500


@pytest.mark.parametrize("analog", [0, 3])
@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("m", 1.0), ("cm", 0.01)])
def test_reads_what_ezc3d_wrote(tmp_path, points, unit, metres, analog):
    loaded = load_c3d(write(tmp_path / "a.c3d", points, unit, analog=analog))
    np.testing.assert_allclose(loaded.positions.numpy(), points * metres, rtol=1e-5, atol=1e-6)
    assert loaded.names == tuple(f"M{k}" for k in range(5)) and loaded.fps == 50 and loaded.valid.all()


def test_unmeasured_points_are_masked(tmp_path, points):
    points[3, 2] = np.nan
    loaded = load_c3d(write(tmp_path / "a.c3d", points))
    assert (~loaded.valid).nonzero().tolist() == [[3, 2]] and (loaded.positions[3, 2] == 0).all()


def test_up_axis_comes_from_the_file_or_the_caller(tmp_path, points):
    y_up = load_c3d(write(tmp_path / "a.c3d", points, "m", "+Y"))
    np.testing.assert_allclose(y_up.positions[..., 2].numpy(), points[..., 1], rtol=1e-5)
    silent = write(tmp_path / "b.c3d", points, "m", None)
    with pytest.raises(DataError, match="what is up"):
        load_c3d(silent)
    torch.testing.assert_close(load_c3d(silent, axes="x-zy").positions, y_up.positions)


def test_integer_files_are_scaled(tmp_path):
    """Header, one parameter block and 16-bit data made by hand from the format guide; the scale is 0.5."""
    table = np.arange(24, dtype="<i2").reshape(3, 2, 4)
    table[1, 0, 3] = -1
    path = tmp_path / "a.c3d"
    path.write_bytes(seeds.c3d_bytes(table))
    loaded = load_c3d(path)
    expected = np.where(table[..., 3:] < 0, 0, table[..., :3] * 0.5 / 1000)
    np.testing.assert_allclose(loaded.positions.numpy(), expected, rtol=1e-6)
    assert loaded.names == ("A", "BB") and loaded.fps == 25 and not loaded.valid[1, 0]


def test_promised_frames_must_be_there(tmp_path, points):
    path = write(tmp_path / "a.c3d", points)
    data = path.read_bytes()
    path.write_bytes(data[:-512])
    with pytest.raises(DataError, match="3-D data: expected 9 frames"):
        load_c3d(path)


@needs_data
def test_real_takes_agree_with_ezc3d():
    takes = sorted((Path(os.environ["MOTIONLAB_DATA"]) / "captury_falls").glob("*/mocap.c3d"))
    assert takes
    for path in takes:
        loaded, reference = load_c3d(path), ezc3d.c3d(str(path))
        expected = reference["data"]["points"][:3].transpose(2, 1, 0) / 1000
        np.testing.assert_allclose(loaded.positions.numpy(), expected, atol=1e-6)
        assert list(loaded.names) == reference["parameters"]["POINT"]["LABELS"]["value"]
        assert loaded.fps == 50 and 0 < loaded.positions[..., 2].max() < 2.2
