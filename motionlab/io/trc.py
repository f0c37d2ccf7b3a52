"""TRC: OpenSim's tab-separated tables of marker positions."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from motionlab.io.positions import Positions, axes_to_matrix
from motionlab.io.reading import Spot, frame_rate, read_text, reading

METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001}


def load(path: str | Path, *, axes: str = "zxy") -> Positions:
    """Markers of a TRC file in metres, z up.

    Units and rate come from the file. An empty cell or ``nan`` is a marker that was not measured.

    Args:
        axes: which file axis becomes world x, y and z. The default is OpenSim's convention (x forward, y up,
            z right) stood up to face world +y, as every body here does; it is also what puts Pose2Sim's results
            into the world of its calibration.

    Raises:
        DataError: header and table do not fit each other, a cell is not a number, the unit is not known.
    """
    with reading(path, "export the table again as a TRC file") as at:
        lines = read_text(at).splitlines()
        if len(lines) < 6 or not lines[0].startswith("PathFileType"):
            raise at.error("expected PathFileType, five header lines and at least one frame", place="line 1")
        head = _header(at, lines)
        at.place = "line 4"
        names = tuple(cell.strip() for cell in lines[3].split("\t")[2:] if cell.strip())
        if len(names) != head["NumMarkers"]:
            raise at.error(f"NumMarkers promises {head['NumMarkers']} markers, got {len(names)} names")
        if len(set(names)) < len(names):
            raise at.error("two markers have the same name", remedy="rename one of them")
        rows = [
            _row(at, number, line, len(names))
            for number, line in enumerate(lines[5:], start=6)
            if line.strip()
        ]  # fmt: skip
        if len(rows) != head["NumFrames"]:
            raise at.error(f"NumFrames promises {head['NumFrames']} frames, got {len(rows)}", place="line 3")
        points = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), len(names), 3)
        valid = points.isfinite().all(-1)
        metres = torch.where(valid[..., None], points, 0.0) * METRES[head["Units"]]
        world = (metres @ axes_to_matrix(axes).T).float()
        return Positions(names, world, valid, head["DataRate"], at.path.stem)


def _header(at: Spot, lines: list[str]) -> dict:
    at.place = "line 3"
    head = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    for key in ("DataRate", "NumFrames", "NumMarkers", "Units"):
        if key not in head:
            raise at.error(f"{key} is missing", place="line 2")
    unit = head["Units"].strip().lower()
    if unit not in METRES:
        raise at.error(f"unit {unit!r} is not known", remedy=f"use one of {', '.join(METRES)}")
    counts = {key: int(head[key]) for key in ("NumFrames", "NumMarkers")}
    if min(counts.values()) < 1:
        raise at.error(f"expected at least one frame and one marker, got {counts}")
    return {**counts, "DataRate": frame_rate(at, float(head["DataRate"]), "line 3, DataRate"), "Units": unit}


def _row(at: Spot, number: int, line: str, markers: int) -> list[float]:
    at.place = f"line {number}"
    cells = line.rstrip("\r\n").split("\t")[2:]
    surplus = cells[3 * markers :]
    if any(cell.strip() for cell in surplus) or len(cells) < 3 * markers - 1:
        raise at.error(f"expected {3 * markers} coordinates of {markers} markers, got {len(cells)}")
    values = [float(cell) if cell.strip() else math.nan for cell in cells[: 3 * markers]]
    if any(abs(value) > 1e9 for value in values):
        raise at.error("a coordinate is not a usable number")
    return values + [math.nan] * (3 * markers - len(values))
