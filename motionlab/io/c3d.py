"""C3D: the binary format of motion-capture laboratories. Points only; analogue channels are skipped.

Read here with NumPy alone: the C++ readers crash or hang on damaged files, and no exception can stop that.
Source: The C3D file format user guide (C3D.org), sections on header, parameters and 3-D data.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import torch

from motionlab.io.positions import Positions, axes_to_matrix
from motionlab.io.reading import Spot, frame_rate, numbers, read_bytes, reading

BLOCK = 512
INTEL = 84
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
UP = {"+Z": "xyz", "+Y": "x-zy"}
DTYPES = {-1: np.dtype("S1"), 1: np.dtype("u1"), 2: np.dtype("<i2"), 4: np.dtype("<f4")}


def load(path: str | Path, *, axes: str | None = None, unit: str | None = None) -> Positions:
    """Labelled points of a C3D file in metres, z up.

    A point with a negative residual, or whose coordinates are not finite, was not measured.

    Args:
        axes: which file axis becomes world x, y and z, such as ``"xyz"`` or ``"x-zy"``; None reads it from the
            file's ``POINT:Y_SCREEN`` (the axis that points up on a screen).
        unit: ``"m"``, ``"cm"`` or ``"mm"``; None reads ``POINT:UNITS``.

    Raises:
        DataError: not a C3D file, damaged, a processor type other than Intel, or a unit or an up axis that
            neither the file nor the caller states.
    """
    with reading(path, "export the C3D file again") as at:
        data = read_bytes(at)
        if len(data) < 2 * BLOCK or data[1] != 0x50:
            raise at.error("not a C3D file: no key 0x50 in a header of 512 bytes", place="byte 1")
        header = np.frombuffer(data, "<u2", BLOCK // 2)
        parameters = _parameters(at, data, BLOCK * (data[0] - 1))
        at.place = "POINT"
        points = {k.removeprefix("POINT:"): v for k, v in parameters.items() if k.startswith("POINT:")}
        count, names = int(header[1]), _names(points)
        if not count or len(names) < count or len(set(names[:count])) < count:
            raise at.error(f"expected {count} different labels, got {len(names)}", place="POINT:LABELS")
        unit = unit or str(points.get("UNITS", [""])[0]).strip().lower()
        if unit not in METRES:
            raise at.error(f"unit {unit!r} is not known", place="POINT:UNITS", remedy='pass unit="mm" or another')
        axes = axes or UP.get(str(points.get("Y_SCREEN", [""])[0]).strip().upper())
        if axes is None:
            raise at.error("the file does not say what is up", place="POINT:Y_SCREEN", remedy='pass axes="xyz"')
        rate = points.get("RATE", [np.frombuffer(data, "<f4", 1, 20)[0]])[0]
        fps = frame_rate(at, rate, "POINT:RATE")
        xyz, measured = _frames(at, data, header, parameters, count)
        world = (torch.from_numpy(xyz) * METRES[unit] @ axes_to_matrix(axes).T).float()
        return Positions(names[:count], world, torch.from_numpy(measured), fps, at.path.stem)


def _names(points: dict) -> tuple[str, ...]:
    keys = ["LABELS", *(f"LABELS{n}" for n in range(2, 100))]  # a parameter holds at most 255 labels
    return tuple(str(name) for key in keys for name in points.get(key, []))


def _parameters(at: Spot, data: bytes, start: int) -> dict[str, np.ndarray]:
    at.place = "parameter section"
    if not BLOCK <= start <= len(data) - 4:
        raise at.error(f"lies at byte {start} of {len(data)}")
    if data[start + 3] != INTEL:
        raise at.error(f"processor type {data[start + 3]} is not read", remedy="convert the file to Intel (84)")
    groups, found = {}, {}
    cursor, end = start + 4, min(start + BLOCK * data[start + 2], len(data))
    while cursor + 4 <= end:
        length, number = struct.unpack_from("<bb", data, cursor)  # a negative length marks a locked entry
        if length == 0:
            break
        name = data[cursor + 2 : cursor + 2 + abs(length)].decode("latin-1").upper()
        body = cursor + 2 + abs(length)
        (step,) = struct.unpack_from("<h", data, body)
        if number < 0:
            groups[-number] = name
        else:
            found[number, name] = _value(at, data, body + 2, f"parameter {name}")
        if step <= 0:
            break
        cursor = body + step
    return {f"{groups.get(number, number)}:{name}": value for (number, name), value in found.items()}


def _value(at: Spot, data: bytes, start: int, place: str) -> np.ndarray:
    kind, axes = struct.unpack_from("<bB", data, start)
    if kind not in DTYPES or axes > 7:
        raise at.error(f"type {kind} with {axes} axes is not known", place=place)
    shape = tuple(data[start + 2 : start + 2 + axes])
    values = np.frombuffer(data, DTYPES[kind], math.prod(shape), start + 2 + axes)
    if kind != -1:
        return values
    letters, *rows = shape or (1,)  # the first axis runs along the word
    words = values.tobytes()
    cells = (words[i * letters : (i + 1) * letters] for i in range(math.prod(rows)))
    return np.array([cell.decode("latin-1").strip(" \0") for cell in cells], dtype=str)


def _frames(at: Spot, data: bytes, header: np.ndarray, parameters: dict, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (T, K, 3) in the file's unit, 0 where not measured, and the mask (T, K)."""
    at.place = "3-D data"
    (scale,) = struct.unpack_from("<f", data, 12)
    kind = np.dtype("<f4") if scale < 0 else np.dtype("<i2")
    if not math.isfinite(scale) or scale == 0:
        raise at.error(f"scale {scale} is not usable")
    frames = _frame_count(header, parameters)
    width, start = 4 * count + int(header[2]), BLOCK * (int(header[8]) - 1)
    held = max(len(data) - start, 0) // (width * kind.itemsize)
    if start < BLOCK or not 0 < frames <= held:
        raise at.error(f"expected {frames} frames of {width} numbers from byte {start}, the file holds {held}")
    table = np.frombuffer(data, kind, frames * width, start).reshape(frames, width)[:, : 4 * count]
    table = table.reshape(frames, count, 4).astype(np.float64)
    measured = (table[..., 3] >= 0) & np.isfinite(table[..., :3]).all(-1)
    xyz = np.where(measured[..., None], table[..., :3], 0.0) * (1.0 if scale < 0 else scale)
    return numbers(at, xyz, f"T {count} 3"), measured


def _frame_count(header: np.ndarray, parameters: dict) -> int:
    """From the header's 16-bit frame numbers, or the 32-bit ones of long recordings."""
    ends = [parameters.get(f"TRIAL:ACTUAL_{end}_FIELD") for end in ("START", "END")]
    if all(end is not None and end.size == 2 for end in ends):
        first, last = (int(end.astype("<i2").view("<u2").astype(np.int64) @ [1, 65536]) for end in ends)
    else:
        first, last = int(header[3]), int(header[4])
    return last - first + 1
