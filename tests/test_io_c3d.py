import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import seeds
import torch

from motionlab.errors import DataError
from motionlab.io.points import load_c3d
from tests.recorded import DATA, needs_data

ezc3d = pytest.importorskip("ezc3d")


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


@needs_data
def test_real_takes_agree_with_ezc3d():
    takes = sorted((DATA / "captury_falls").glob("*/mocap.c3d"))
    assert takes
    for path in takes:
        loaded, reference = load_c3d(path), ezc3d.c3d(str(path))
        expected = reference["data"]["points"][:3].transpose(2, 1, 0) / 1000
        np.testing.assert_allclose(loaded.positions.numpy(), expected, atol=1e-6)
        assert list(loaded.names) == reference["parameters"]["POINT"]["LABELS"]["value"]
        assert loaded.fps == 50 and 0 < loaded.positions[..., 2].max() < 2.2


def figure(frames: int = 6) -> tuple[np.ndarray, tuple[str, ...]]:
    """Markers of a person of 1.7 m, y up, in metres."""
    names = ("Head", "LHip", "RHip", "LAnkle", "RAnkle")
    still = np.array([[0, 1.7, 0], [0.1, 0.9, 0], [-0.1, 0.9, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    return still + 0.01 * np.arange(frames)[:, None, None] * np.array([0, 0, 1.0]), names


def by_hand(points: np.ndarray, names, processor=84, unit=b"m", parameters=b"", first=1, last=None) -> bytes:
    """A C3D of floats as a processor writes them: Intel 84, DEC 85, MIPS 86; from the format guide."""
    order = ">" if processor == 86 else "<"

    def floats(values) -> bytes:
        if processor != 85:
            return np.asarray(values, f"{order}f4").tobytes()
        words = np.asarray(np.asarray(values) * 4, "<f4").view("<u2").reshape(-1, 2)[:, ::-1]
        return np.ascontiguousarray(words).tobytes()

    entry = partial(seeds.c3d_entry, order=order)
    block = b"\1\x50\1" + bytes([processor]) + entry(b"POINT", -1, b"\0")
    block += entry(b"LABELS", 1, seeds.c3d_text([name.encode() for name in names], 12))
    block += entry(b"UNITS", 1, seeds.c3d_text([unit], len(unit)) if unit else struct.pack("bBBB", -1, 2, 0, 0) + b"\0")
    block += entry(b"RATE", 1, struct.pack("bB", 4, 0) + floats([100.0]) + b"\0") + parameters
    last = first + len(points) - 1 if last is None else last
    header = struct.pack(f"{order}BBHHHHH", 2, 0x50, len(names), 0, first, last, 0) + floats([-1.0])
    header += struct.pack(f"{order}HH", 3, 0) + floats([100.0])
    table = np.concatenate([points, np.zeros((*points.shape[:2], 1))], -1)
    return header.ljust(512, b"\0") + block.ljust(512, b"\0") + floats(table.ravel())


@pytest.mark.parametrize("processor", [84, 85, 86])
@pytest.mark.parametrize("unit", [b"m", b"Meters", b""])
def test_every_processor_without_a_word_on_what_is_up(tmp_path, processor, unit):
    points, names = figure()
    (tmp_path / "a.c3d").write_bytes(by_hand(points, names, processor, unit))
    loaded = load_c3d(tmp_path / "a.c3d")
    np.testing.assert_allclose(loaded.positions.numpy(), points[..., [0, 2, 1]] * [1, -1, 1], atol=1e-6)
    assert any("up axis y detected" in note for note in loaded.notes)
    assert any("unit m detected" in note for note in loaded.notes) == (not unit)
    assert load_c3d(tmp_path / "a.c3d", up="z", fps=50).fps == 50


def test_points_at_exactly_zero_were_not_measured(tmp_path):
    points, names = figure()
    points[2:4, 0] = 0
    (tmp_path / "a.c3d").write_bytes(by_hand(points, names))
    loaded = load_c3d(tmp_path / "a.c3d")
    assert (~loaded.valid).nonzero().tolist() == [[2, 0], [3, 0]]
    assert any("2 of 30 points" in note for note in loaded.notes)
    assert float(loaded.positions[1, 0, 2]) == pytest.approx(1.7)


@pytest.mark.parametrize(
    ("frames", "last", "entry"),
    [(66000, 65535, None), (66000, 66000 - 65536, None), (66000, 65535, b"LONG_FRAMES"), (66000, 65535, b"TRIAL")],
)
def test_recordings_longer_than_the_header_counts(tmp_path, frames, last, entry):
    points, names = figure(frames)
    more = b""
    if entry == b"LONG_FRAMES":
        more = seeds.c3d_entry(entry, 1, struct.pack("<bBf", 4, 0, frames) + b"\0")
    elif entry == b"TRIAL":
        more = seeds.c3d_entry(entry, -2, b"\0")
        for name, value in ((b"ACTUAL_START_FIELD", 1), (b"ACTUAL_END_FIELD", frames)):
            more += seeds.c3d_entry(name, 2, struct.pack("<bBB2H", 2, 1, 2, value % 65536, value // 65536) + b"\0")
    (tmp_path / "a.c3d").write_bytes(by_hand(points, names, parameters=more, last=last))
    loaded = load_c3d(tmp_path / "a.c3d")
    assert loaded.frames == frames
