"""Positions without rotations: labelled 3-D points from OpenSim's TRC and C3D."""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab.errors import check_shape
from motionlab.io import judging
from motionlab.io.judging import Axes, Fps, Unit, unit_named
from motionlab.io.reading import Location, check_keys, checked_array, frame_rate, read_bytes, read_text, reading

#: OpenSim's way up: x forward, y up, z right, stood up to face world +y; a C3D's: x stays.
_TRC_AXES, _C3D_AXES = judging.AXES | {"y": "zxy"}, judging.AXES | {"y": "x-zy"}
#: Processors: Intel and DEC write the low byte first, MIPS the high one; DEC's floats are VAX's.
_C3D_BLOCK, _C3D_DEC, _C3D_ORDERS = 512, 85, {84: "<", 85: "<", 86: ">"}
_C3D_TYPES = {-1: "S1", 1: "u1", 2: "i2", 4: "f4"}


@dataclass(frozen=True, eq=False)
class Positions:
    """Labelled 3-D points through time; no rotations, no bones.

    names: the K points, as the file calls them. positions (T, K, 3): metres, world, z up. valid (T, K): False where the
    point was not measured; its position is then 0, never NaN. fps: frames per second. name: where it came from. notes:
    what a loader had to decide.

    Raises:
        ShapeError: the arrays do not fit the names or each other.
    """

    names: tuple[str, ...]
    positions: Tensor
    valid: Tensor
    fps: float
    name: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_shape(self.positions, f"T {len(self.names)} 3", "positions")
        check_shape(self.valid, f"{self.frames} {len(self.names)}", "valid")

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return self.positions.shape[0]


def load_trc(path: str | Path, *, unit: Unit = None, up: Axes = None, axes: Axes = None, fps: Fps = None) -> Positions:
    """Reads the markers of a TRC file in metres, z up.

    An empty cell, ``nan``, a marker at exactly (0, 0, 0), and what a row that ends early lacks was not measured.

    unit, fps: instead of what the file says. up, axes: see :func:`motionlab.io.judging.to_world`; by default OpenSim's
    convention (x forward, y up, z right: "zxy"), unless heads are above feet along another.

    Raises:
        DataError: header and table do not fit each other, a cell is not a number, the unit is not known.
    """
    with reading(path, "export the table again as a TRC file") as at:
        head, names, rows = trc_table(at, read_text(at))
        rate = frame_rate(at, float(head["DataRate"]) if fps is None else fps, "line 3, DataRate", judging.SAY_RATE)
        lasts = rows[-1, 1] - rows[0, 1]  # not above zero, or NaN, where the table has no times
        if fps is None and lasts > 0 and abs(lasts * rate - len(rows) + 1) > 0.5:
            said = f"its times are of {(len(rows) - 1) / lasts:.4g} frames per second, not of {rate:g}, which is taken"
            at.notes.append(f"{said}: frames are missing or doubled, or {judging.SAY_RATE}")
        points = rows[:, 2:].reshape(len(rows), len(names), 3)
        figure = _measured(at, names, points, np.isfinite(points).all(-1), rate)
        at.place = "line 3, Units"
        how = {"says_unit": unit_named(head.get("Units", "")), "says_up": "y", "trust": 0.5, "table": _TRC_AXES}
        return judging.to_world(at, figure, unit=unit, up=up, axes=axes, **how)


def _measured(at: Location, names: tuple[str, ...], points: np.ndarray, valid: np.ndarray, fps: float) -> Positions:
    """Points (T, K, 3) of a file's own unit and axes; those at exactly zero are not measured either, and noted."""
    zero = valid & (points == 0).all(-1)
    if zero.any():
        at.notes.append(f"{zero.sum()} of {zero.size} points are at exactly (0, 0, 0): taken as not measured")
    valid = torch.from_numpy(valid & ~zero)
    points = torch.where(valid[..., None], torch.from_numpy(points), 0.0)
    return Positions(names, points, valid, fps, at.path.stem, notes=tuple(at.notes))


def trc_table(at: Location, text: str) -> tuple[dict[str, str], tuple[str, ...], np.ndarray]:
    """Reads the header of a TRC by name, the names of its K markers, and its rows (T, 2 + 3K): frame, time, places; NaN
    where there is none."""
    lines = text.splitlines()
    if len(lines) < 6 or not lines[0].startswith("PathFileType"):
        raise at.error("expected PathFileType, five header lines and at least one frame", place="line 1")
    at.place = "line 3"
    head = dict(zip(lines[1].split(), lines[2].split(), strict=False))
    check_keys(at, head, ("DataRate", "NumFrames", "NumMarkers"))
    frames, markers = (int(float(head[key])) for key in ("NumFrames", "NumMarkers"))
    at.place = "line 4"
    names = tuple(cell.strip() for cell in lines[3].split("\t")[2:] if cell.strip())
    if len(names) != markers:
        raise at.error(f"NumMarkers promises {markers} markers, got {len(names)} names")
    if len(set(names)) < len(names):
        raise at.error("two markers have the same name", remedy="rename one of them")
    rows, width = [], 2 + 3 * len(names)
    for number, line in enumerate(lines[5:], 6):
        at.place, cells = f"line {number}", [cell.strip() for cell in line.split("\t")]
        if any(cells[width:]):
            raise at.error(f"expected {width - 2} coordinates of {markers} markers, got {len(cells) - 2}")
        rows += [[float(cell or "nan") for cell in cells[:width]]] if any(cells) else []
    if not rows or not names:
        raise at.error("no frames" if names else "no markers", place="line 6" if names else "line 4")
    if short := sum(width - len(row) > 1 for row in rows):  # one empty cell often lacks its tab
        at.notes.append(f"{short} of {len(rows)} rows end early: what they lack was not measured")
    if len(rows) != frames:
        at.notes.append(f"NumFrames promises {frames} frames: the {len(rows)} that are there are read")
    table = [row + [math.nan] * (width - len(row)) for row in rows]
    return head, names, checked_array(at, table, f"T {width}", "table", 1e9, nan=True)


def load_c3d(path: str | Path, *, unit: Unit = None, up: Axes = None, axes: Axes = None, fps: Fps = None) -> Positions:
    """Reads labelled points of a C3D file in metres, z up; analogue channels are skipped.

    Read with NumPy alone: the C++ readers crash or hang on damaged files, and no exception can stop that.

    A point with a negative residual, at exactly (0, 0, 0) or whose coordinates are not finite was not measured.

    unit, up, axes, fps: see :func:`motionlab.io.judging.to_world`; by default what the file's ``POINT:UNITS``,
    ``Y_SCREEN`` (the axis that points up on a screen) and ``RATE`` say, else what heads above feet tell.

    Raises:
        DataError: not a C3D file, damaged, an unknown processor, or a unit or an up axis that neither file nor caller
            states, and the points do not tell.

    Source: The C3D file format user guide (C3D.org), sections on header, parameters and 3-D data.
    """
    with reading(path, "export the C3D file again") as at:
        data = read_bytes(at)
        if len(data) < 2 * _C3D_BLOCK or data[1] != 0x50:
            raise at.error("not a C3D file: no key 0x50 in a header of 512 bytes", place="byte 1")
        start = _C3D_BLOCK * (data[0] - 1)
        at.place = "parameter section"
        if (kind := data[start + 3]) not in _C3D_ORDERS:
            raise at.error(f"processor type {kind} is not read", remedy="convert the file to Intel (84)")
        header = np.frombuffer(data, f"{_C3D_ORDERS[kind]}u2", _C3D_BLOCK // 2)
        numbers = partial(_c3d_numbers, data, kind)
        parameters = _c3d_parameters(data, start, numbers)
        at.place = "POINT"
        points = {k.removeprefix("POINT:"): v for k, v in parameters.items() if k.startswith("POINT:") and v.size}
        every = ["LABELS", *(f"LABELS{n}" for n in range(2, 100))]  # a parameter holds at most 255 labels
        count, names = int(header[1]), tuple(str(name) for key in every for name in points.get(key, []))
        if not count or len(names) < count or len(set(names[:count])) < count:
            raise at.error(f"expected {count} different labels, got {len(names)}", place="POINT:LABELS")
        rate = fps if fps is not None else points.get("RATE", numbers(4, 1, 20))[0]
        rate = frame_rate(at, rate, "POINT:RATE", judging.SAY_RATE)
        xyz, measured = _c3d_table(at, len(data), header, parameters, numbers)
        figure = _measured(at, names[:count], xyz, measured, rate)
        screen = str(points.get("Y_SCREEN", [""])[0]).strip().lower().removeprefix("+")
        at.place = "POINT:UNITS"
        how = {"says_unit": unit_named(points.get("UNITS", [""])[0]), "table": _C3D_AXES}
        how |= {"says_up": screen, "trust": 9.0} if screen in judging.AXES else {}
        return judging.to_world(at, figure, unit=unit, up=up, axes=axes, **how)


def _c3d_numbers(data: bytes, processor: int, kind: int, count: int, start: int) -> np.ndarray:
    """Numbers of a type of ``_C3D_TYPES``, as a processor writes them."""
    if kind == 4 and processor == _C3D_DEC:  # words swapped, the exponent one bias of 2 higher
        words = np.frombuffer(data, "<u2", 2 * count, start).reshape(-1, 2)[:, ::-1]
        return np.ascontiguousarray(words).view("<f4")[:, 0] / 4
    return np.frombuffer(data, np.dtype(_C3D_TYPES[kind]).newbyteorder(_C3D_ORDERS[processor]), count, start)


def _c3d_parameters(data: bytes, start: int, numbers: Callable) -> dict[str, np.ndarray]:
    groups, found = {}, {}
    cursor, end, step = start + 4, min(start + _C3D_BLOCK * data[start + 2], len(data)), 1
    while cursor + 4 <= end and data[cursor] and step > 0:
        length, number = struct.unpack_from("<bb", data, cursor)  # a negative length marks a locked entry
        body = cursor + 2 + abs(length)
        name, step = data[cursor + 2 : body].decode("latin-1").upper(), int(numbers(2, 1, body)[0])
        if number < 0:
            groups[-number] = name
        else:
            found[number, name] = _c3d_value(data, body + 2, numbers)
        cursor = body + step
    return {f"{groups.get(number, number)}:{name}": value for (number, name), value in found.items()}


def _c3d_value(data: bytes, start: int, numbers: Callable) -> np.ndarray:
    kind, axes = struct.unpack_from("<bB", data, start)
    shape = tuple(data[start + 2 : start + 2 + axes])
    values = numbers(kind, math.prod(shape), start + 2 + axes)
    if kind != -1:
        return values
    letters, *rows = shape or (1,)  # the first axis runs along the word
    words = values.tobytes()
    cells = (words[i * letters : (i + 1) * letters] for i in range(math.prod(rows) if letters else 0))
    return np.array([cell.decode("latin-1").strip(" \0") for cell in cells], dtype=str)


def _c3d_table(
    at: Location, length: int, header: np.ndarray, parameters: dict, numbers: Callable
) -> tuple[np.ndarray, np.ndarray]:
    """Points (T, K, 3) in the file's unit, 0 where not measured, and the mask (T, K)."""
    at.place, count = "3-D data", int(header[1])
    scale = float(numbers(4, 1, 12)[0])
    kind = 4 if scale < 0 else 2  # which is also its bytes
    if not 0 < abs(scale) < math.inf:
        raise at.error(f"scale {scale} is not usable")
    width, start = 4 * count + int(header[2]), _C3D_BLOCK * (int(header[8]) - 1)
    held = max(length - start, 0) // (width * kind)
    frames = _c3d_frame_count(at, header, parameters, held)
    if start < _C3D_BLOCK or not 0 < frames <= held:
        raise at.error(f"expected {frames} frames of {width} numbers from byte {start}, the file holds {held}")
    table = numbers(kind, frames * width, start).reshape(frames, width)[:, : 4 * count]
    table = table.reshape(frames, count, 4).astype(np.float64)
    measured = (table[..., 3] >= 0) & np.isfinite(table[..., :3]).all(-1)
    xyz = np.where(measured[..., None], table[..., :3], 0.0) * (1.0 if scale < 0 else scale)
    return checked_array(at, xyz, f"T {count} 3"), measured


def _c3d_frame_count(at: Location, header: np.ndarray, parameters: dict, held: int) -> int:
    """From the 32-bit frame numbers of long recordings, else the header's 16 bits, which end at 65535 or start again:
    then as many as the file has room for."""
    ends = [parameters.get(f"TRIAL:ACTUAL_{end}_FIELD") for end in ("START", "END")]
    if all(end is not None and end.size == 2 for end in ends):
        first, last = (int(end.astype(np.int64) % 65536 @ [1, 65536]) for end in ends)
        return last - first + 1
    if (long := parameters.get("POINT:LONG_FRAMES")) is not None and long.size and long[0] >= 1:
        return int(long[0])
    count = int(header[4]) - int(header[3]) + 1
    more = held if int(header[4]) == 65535 else count + max(held - count, 0) // 65536 * 65536
    if more > count:
        at.notes.append(f"the header counts no further than 65535 frames: {more} are in the file")
    return max(more, count)
