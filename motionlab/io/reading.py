"""Reads files that may be damaged: whatever is wrong with one becomes a ``DataError`` with file, place and remedy.

Every loader does its work inside ``with reading(path, remedy) as at``, moves ``at.place`` along as it reads, and raises
``at.error(...)`` where it finds something wrong. So does, here and in the readers, every function that takes ``at``, in
its caller's ``reading``. Nothing here executes what it reads.
"""

import io
import json
import math
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path

import numpy as np

from motionlab.errors import DataError, MissingData

#: Kana, or two signs of Chinese in a row; an accent of Latin-1 before a letter looks like one.
_JAPANESE = re.compile("[\u3041-\u30fe]|[\u4e00-\u9fff]{2}")
LARGEST = 2**31  # bytes: larger files, members and promised arrays are refused before memory is asked for
_USABLE = 1e18  # numbers from here on are refused: products overflow beyond float32's square root
RATES = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 144, 240)  # frames per second that people record at


@dataclass
class Location:
    """Where a loader is: the file, the place in it (a line, a key, a frame), the usual remedy; what it had to decide so
    far, and how the text is written."""

    path: Path
    place: str = ""
    remedy: str = ""
    notes: list[str] = field(default_factory=list)
    encoding: str = "utf-8"

    def error(self, message: str, *, place: str | None = None, remedy: str | None = None) -> DataError:
        """Returns the error to raise here."""
        place, remedy = place if place is not None else self.place, remedy or self.remedy
        return DataError(message, path=self.path, place=place or "whole file", remedy=remedy)


@contextmanager
def reading(path: str | Path, remedy: str = "export the file again") -> Iterator[Location]:
    """Turns every exception that leaves the block into a ``DataError`` that names file, place and remedy.

    It catches ``Exception`` on purpose: a malformed file can surface as almost any type (zlib.error,
    RecursionError, MemoryError, OverflowError, ...). The original stays attached as ``__cause__``.
    ``DataError`` and ``MissingData`` pass through as they are.
    """
    location = Location(Path(path), remedy=remedy)
    try:
        yield location
    except (DataError, MissingData):
        raise
    except FileNotFoundError as error:
        raise location.error("no such file", remedy="check the path") from error
    except OSError as error:
        raise location.error(f"cannot be opened: {error.strerror or error}") from error
    except Exception as error:
        raise location.error(f"cannot be read ({type(error).__name__}: {error})") from error


def read_bytes(at: Location) -> bytes:
    """Reads the whole file, if it is one, not empty and not larger than ``LARGEST``."""
    if at.path.is_dir():
        raise at.error("is a folder, expected a file", remedy="name the file inside")
    size = at.path.stat().st_size
    if not 0 < size <= LARGEST:
        raise at.error("the file is empty" if not size else f"{size} bytes are more than {LARGEST}")
    return at.path.read_bytes()


def read_text(at: Location) -> str:
    """Reads the whole file as text: UTF-8 (a byte-order mark is dropped), else Shift-JIS if that makes words of
    Japanese, else Latin-1; noted. What holds zero bytes is no text."""
    data = read_bytes(at)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp932", errors="ignore")
        at.encoding = "cp932" if data == text.encode("cp932", "ignore") and _JAPANESE.search(text) else "latin-1"
        text = data.decode(at.encoding)
        at.notes.append(f"the text is no UTF-8: read as {'Shift-JIS' if at.encoding == 'cp932' else 'Latin-1'}")
    if "\0" in text:
        raise at.error("holds zero bytes: this is not a text file")
    return text


def text_lines(at: Location, text: str) -> Iterator[str]:
    """Yields the lines that are not blank, stripped; ``at.place`` is there, and behind the last at the whole file."""
    for number, line in enumerate(text.splitlines(), start=1):
        at.place = f"line {number}"
        if line := line.strip():
            yield line
    at.place = ""


def read_json(at: Location, *, nan: bool = False) -> object:
    """Reads the whole file as JSON. NaN and Infinity, which JSON does not have, are refused; ``nan`` lets NaN pass,
    where it stands for what was not measured."""

    def refuse(constant: str) -> float:
        if nan and constant == "NaN":
            return math.nan
        raise at.error(f"{constant} is not a number")

    return json.loads(read_text(at), parse_constant=refuse)


def read_npz(at: Location, keys: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
    """Reads the arrays of an npz by key: those of ``keys`` that are there, or all.

    Never unpickles: an array of Python objects is refused; one that nobody asked for is not touched. One that is too
    large, or shorter than it promises, is refused before memory is asked for.
    """
    if read_bytes(at)[:2] != b"PK":
        raise at.error("not an npz archive", remedy="save it with numpy.savez")
    arrays = {}
    with zipfile.ZipFile(at.path) as archive:
        for member in archive.infolist():
            key = at.place = member.filename.removesuffix(".npy")
            if keys is not None and key not in keys:
                continue
            if member.file_size > LARGEST:
                raise at.error(f"{member.file_size} bytes are more than {LARGEST}")
            arrays[key] = read_npy(at, archive.read(member))
    at.place = ""
    return arrays


def check_keys(at: Location, arrays: dict[str, object], keys: Iterable[str]) -> None:
    """Checks that a file has all of these keys; the error names those that it lacks, and what is there."""
    if missing := ", ".join(key for key in keys if key not in arrays):
        raise at.error(f"missing {missing}; found {', '.join(arrays) or 'none that is known'}", place=missing)


def read_npy(at: Location, data: bytes, objects: Callable | None = None) -> object:
    """Reads the array of a .npy; of one of Python objects what ``objects(at, pickle)`` makes, else it is refused."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    old, new = np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0
    shape, fortran, dtype = (old if version == (1, 0) else new)(stream)
    if dtype.hasobject:
        if objects is not None:
            return objects(at, stream.read())
        raise at.error("holds pickled Python objects, which are never loaded", remedy="save plain arrays: numpy.savez")
    if any(n < 0 for n in shape) or math.prod(shape) * dtype.itemsize > len(data):
        raise at.error(f"promises shape {shape} of {dtype} but has only {len(data)} bytes")
    array = np.frombuffer(stream.read(), dtype=dtype, count=math.prod(shape))
    return array.reshape(shape, order="F" if fortran else "C")


def checked_array(
    at: Location, array: object, shape: str, place: str | None = None, largest: float = _USABLE, *, nan: bool = False
) -> np.ndarray:
    """Checks an array's axes and that every number is finite; returns it as float64. The error names the first that
    is not.

    shape: words such as ``"T 24 3"``: a number is a fixed size, a word any size of at least one. largest: numbers from
    here on are refused. nan: let NaN and None pass, as NaN.
    """
    place = place if place is not None else at.place
    try:
        array = np.asarray(array)
    except ValueError:
        raise at.error("expected numbers, got rows of different lengths", place=place) from None
    if nan and array.dtype == object and all(x is None or isinstance(x, int | float) for x in array.flat):
        array = array.astype(np.float64)
    if array.dtype.kind not in "fiub":
        raise at.error(f"expected numbers, got {array.dtype}", place=place)
    words = shape.split()
    sizes = [int(word) if word.isdigit() else max(size, 1) for word, size in zip(words, array.shape, strict=False)]
    if (array.ndim, *sizes) != (len(words), *array.shape):
        raise at.error(f"expected shape ({', '.join(words)}), got {array.shape}", place=place)
    array = array.astype(np.float64)
    bad = ~(np.abs(array) < largest) & ~(nan & np.isnan(array))
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise at.error(f"{array[where]} at index {where} is not a usable number", place=place)
    return array


def floats(at: Location, words: Sequence[str], count: int) -> list[float]:
    """Reads the ``count`` numbers of a line of text; the error names the first that is not finite, or too large."""
    if len(words) != count:
        raise at.error(f"expected {count} values, got {len(words)}")
    values = []
    with suppress(ValueError):  # up to the first that is none
        values.extend(takewhile(lambda value: abs(value) < _USABLE, map(float, words)))
    if (n := len(values)) < count:
        raise at.error(f"value {n + 1} is {words[n][:40]!r}, not a usable number")
    return values


def frame_rate(at: Location, value: object, place: str = "frame rate", remedy: str | None = None) -> float:
    """Checks a frame rate in frames per second: one finite number above zero, at most 100,000."""
    rate = np.asarray(value)
    if rate.size != 1 or rate.dtype.kind not in "fiu" or not 0 < (fps := float(rate.reshape(()))) <= 1e5:
        raise at.error(f"expected frames per second above zero, got {rate}", place=place, remedy=remedy)
    return fps


def image_size(at: Location, value: object, place: str = "size") -> tuple[float, float]:
    """Checks an image size: width and height in pixels, above zero, below 100,000."""
    pair = checked_array(at, value, "2", place, largest=1e5)
    if not (pair > 0).all():
        raise at.error(f"expected width and height in pixels, got {value!r}", place=place)
    return float(pair[0]), float(pair[1])
