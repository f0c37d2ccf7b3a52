"""Valid files, mutated: every loader loads them or says why not, and nothing else ever escapes.

``MOTIONLAB_FUZZ=5000 pytest tests/test_io_mutation.py`` mutates longer than the default, from a fresh seed.
"""

import os
import re
import warnings
from pathlib import Path

import detected
import numpy as np
import pytest
import seeds
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from loaders import LOADERS, check_error, numbers_of

from motionlab.errors import DataError
from motionlab.io.points import Positions

WORDS = "nan inf -1 0 1e400 1e39 1e-320 999999999999 -0.0 2147483648 3.5 { } [ ] , ; true null END".split()
TOKENS = [*(word.encode() for word in WORDS), b'"', b"\t", b"\n", b"\0", b"\xff\xfe", b"\xc3\x28", b"", b"1" * 5000]


@st.composite
def damaged(draw, seed: bytes) -> bytes:
    """A valid file with one to four injuries: bytes flipped, parts cut, lines moved, numbers replaced."""
    data = seed
    for _ in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(["flip", "head", "cut", "cut", "insert", "number", "number", "line", "end"]))
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        if kind == "flip":
            data = data[:at] + bytes([draw(st.integers(0, 255))]) + data[at + 1 :]
        elif kind == "head":
            at = min(at, draw(st.integers(0, 600)))
            data = data[:at] + bytes([draw(st.integers(0, 255))]) + data[at + 1 :]
        elif kind == "cut":
            data = data[:at] + data[at + draw(st.integers(1, 64)) :]
        elif kind == "end":
            data = data[:at]
        elif kind == "insert":
            data = data[:at] + draw(st.sampled_from(TOKENS)) + data[at:]
        elif kind == "number":
            found = list(re.finditer(rb"-?\d+(?:\.\d+)?", data))
            if found:
                one = found[at % len(found)]
                data = data[: one.start()] + draw(st.sampled_from(TOKENS)) + data[one.end() :]
        else:
            lines = data.splitlines(keepends=True)
            if lines:
                first, second = at % len(lines), draw(st.integers(0, 10**6)) % len(lines)
                how = draw(st.sampled_from(["drop", "twice", "swap"]))
                if how == "swap":
                    lines[first], lines[second] = lines[second], lines[first]
                else:
                    lines[first : first + 1] = [lines[first]] * (2 if how == "twice" else 0)
                data = b"".join(lines)
    return data


@st.composite
def changed(draw, arrays: dict) -> bytes:
    """A valid npz whose arrays are of other shapes, types and numbers; damage to the bytes would only hit the CRC."""
    arrays = dict(arrays)
    for _ in range(draw(st.integers(1, 3))):
        key = draw(st.sampled_from(sorted(arrays)))
        array = np.array(arrays[key])
        how = draw(st.sampled_from(["drop", "shape", "type", "value", "value", "cut", "empty", "scale"]))
        if how == "drop" and len(arrays) > 1:
            del arrays[key]
        elif how == "shape":
            arrays[key] = array.reshape(draw(st.sampled_from([(-1,), (1, -1), (*array.shape, 1)])))
        elif how == "type":
            kind = draw(st.sampled_from(["U8", "f4", "f2", "i8", "u1", "?", "c16", "S3", "f8", ">f8"]))
            arrays[key] = np.zeros(array.shape, kind) if array.dtype.kind in "US" else array.astype(kind)
        elif how == "value" and array.size and array.dtype.kind in "fiu":
            array = array.astype(float)
            bad = [np.nan, np.inf, -1, 0, 1e17, 1e30, -1e308, 1e-310, 2.5, 2**31, -(2**40)]
            array.flat[draw(st.integers(0, array.size - 1))] = draw(st.sampled_from(bad))
            arrays[key] = array
        elif how == "cut" and array.ndim:
            arrays[key] = array[: draw(st.integers(0, len(array)))]
        elif how == "empty":
            arrays[key] = np.zeros(draw(st.sampled_from([(0,), (), (0, 3), (3, 0)])))
        elif how == "scale" and array.dtype.kind in "fiu":
            arrays[key] = array.astype(float) * draw(st.sampled_from([0.0, -1.0, 1e-12, 1e12]))
    return seeds.npz(**arrays)


def loads_or_says_why(kind: str, folder: Path, data: bytes) -> None:
    path = folder / f"bad{kind}"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as a user runs it: a warning must not be what stops bad numbers
        try:
            value = LOADERS[kind](path)
        except DataError as error:
            check_error(error)
        else:
            assert all(tensor.isfinite().all() for tensor in numbers_of(value))


EXAMPLES = int(os.environ.get("MOTIONLAB_FUZZ", "40"))
mutations = settings(
    max_examples=EXAMPLES,
    derandomize="MOTIONLAB_FUZZ" not in os.environ,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("mutations")


@pytest.mark.parametrize("kind", seeds.SEEDS)
def test_mutated_files_load_or_say_why(folder, kind):
    @mutations
    @given(data=damaged(seeds.SEEDS[kind]))
    def run(data: bytes) -> None:
        loads_or_says_why(kind, folder, data)

    run()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the changes themselves overflow
@pytest.mark.parametrize(
    ("kind", "arrays"),
    [
        ("amp.npz", seeds.amp_arrays()),
        ("amass.npz", seeds.amass_arrays()),
        ("smpl.npz", seeds.smpl_arrays()),
        ("plain.npz", detected.plain_arrays()),
    ],
    ids=["amp", "amass", "smpl", "keypoints"],
)
def test_changed_archives_load_or_say_why(folder, kind, arrays):
    @mutations
    @given(data=changed(arrays))
    def run(data: bytes) -> None:
        loads_or_says_why(kind, folder, data)

    run()


def test_a_loader_that_lets_something_escape_is_caught(folder, monkeypatch):
    """Negative control: without its guard, the same mutations bring a bare exception out of a loader."""

    def unguarded(path: Path) -> Positions:
        rows = [[float(cell) for cell in line.split("\t")] for line in path.read_text().splitlines()[5:]]
        points = torch.tensor(rows)[:, 2:].unflatten(-1, (-1, 3))
        return Positions(("A", "B"), points, torch.ones(points.shape[:2], dtype=torch.bool), 60.0)

    monkeypatch.setitem(LOADERS, ".trc", unguarded)
    with pytest.raises((ValueError, RuntimeError, IndexError, ExceptionGroup)) as caught:
        test_mutated_files_load_or_say_why(folder, ".trc")
    assert not isinstance(caught.value, DataError)
