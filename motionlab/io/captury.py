"""Captury's tables: joint positions in space (biomech.csv) and projected into each camera (projectedNN.csv)."""

from __future__ import annotations

from pathlib import Path

import torch

from motionlab.io.positions import Positions, axes_to_matrix
from motionlab.io.reading import Spot, frame_rate, numbers, read_text, reading
from motionlab.observation import Camera, Observation2D

#: Columns that a group takes, by the end of its name.
WIDTHS = {"Position": 3, "Positions": 3, "CenterOfGravity": 3, "Angles": 4}


def load_biomech(path: str | Path, *, fps: float) -> Positions:
    """Joint positions of a biomechanics table in metres, z up.

    Turned half about the vertical, into the world of the C3D file of the same take (x and y change sign there):
    a knee is then the middle of its two markers.

    The columns are counted off by the groups of line 3: the lines below it name only a part of them. The
    ``Angles`` columns are left out: some hold quaternions, some degrees, and the file does not say which.

    Args:
        fps: frames per second; the table does not hold it (``Framerate`` in the take's meta.txt does).

    Raises:
        DataError: not such a table, a row is too short, or a cell is not a number.
    """
    with reading(path, "export the biomechanics table again") as at:
        rows = [line.rstrip("\r").split(";") for line in read_text(at).split("\n")]
        if len(rows) < 6 or rows[1][0] != "Frames":
            raise at.error('expected "Frames;<count>"', place="line 2")
        starts: dict[str, int] = {}
        column = 3
        for group in filter(None, (cell.strip() for cell in rows[2])):
            width = next((w for end, w in WIDTHS.items() if group.endswith(end)), None)
            if width is None:
                break
            if width == 3:
                starts.setdefault(group.removesuffix("s").removesuffix("Position"), column)
            column += width
        if not starts:
            raise at.error("no positions in it", place="line 3")
        frames = int(rows[1][1])
        body = rows[5 : 5 + max(frames, 0)]
        if not body or len(body) != frames:
            raise at.error(f"promises {frames} frames, holds {len(body)}", place="line 2")
        table = torch.tensor([_floats(at, row, 3, column, line) for line, row in enumerate(body, start=6)])
        picks = torch.tensor(list(starts.values()))[:, None] - 3 + torch.arange(3)
        world = torch.from_numpy(numbers(at, table[:, picks].numpy(), f"T {len(starts)} 3", "table")) / 1000
        world = world @ axes_to_matrix("-x-yz").T
        valid = torch.ones(world.shape[:2], dtype=torch.bool)
        return Positions(tuple(starts), world.float(), valid, frame_rate(at, fps, "fps"), at.path.parent.name)


def load_projected(path: str | Path, *, camera: Camera, fps: float) -> Observation2D:
    """Joints projected into one camera, in pixels of its image.

    These are projections of a 3-D fit, not detections: confidence is 1 inside the image and 0 outside.

    Args:
        camera: gives the size of the image; the table measures both axes in image widths.
        fps: frames per second.

    Raises:
        DataError: not such a table, a row is too short, or a cell is not a number.
    """
    with reading(path, "export the projected table again") as at:
        rows = [line.split(",") for line in read_text(at).splitlines() if line.strip()]
        if len(rows) < 2 or not rows[0][0].startswith("Timestamps"):
            raise at.error('expected "Timestamps [ms]" first and at least one frame', place="line 1")
        names = tuple(name.strip() for name in rows[0][1::2] if name.strip())
        if not names or len(set(names)) < len(names):
            raise at.error("expected different joint names in every second column", place="line 1")
        width = 1 + 2 * len(names)
        table = torch.tensor([_floats(at, row, 1, width, line) for line, row in enumerate(rows[1:], start=2)])
        share = torch.from_numpy(numbers(at, table.numpy(), f"T {width - 1}", "table")).unflatten(-1, (-1, 2))
        pixels = share * camera.width
        inside = ((pixels >= 0) & (pixels < torch.tensor([camera.width, camera.height]))).all(-1)
        pixels = torch.where(inside[..., None], pixels, 0.0)
        fps = frame_rate(at, fps, "fps")
        return Observation2D(
            pixels.float(), inside.float(), names, fps, camera, f"{at.path.parent.name} {at.path.stem}"
        )


def _floats(at: Spot, row: list[str], start: int, stop: int, line: int) -> list[float]:
    at.place = f"line {line}"
    if len(row) < stop:
        raise at.error(f"expected {stop} cells, got {len(row)}")
    return [float(cell) for cell in row[start:stop]]
