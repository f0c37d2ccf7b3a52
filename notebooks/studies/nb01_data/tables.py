"""Tables of notebook 01: what a folder of recordings holds, and what retargeting costs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from motionlab.io.recordings import inventory, recordings
from motionlab.retarget import retarget
from motionlab.splits import MOTIONS, evenly

LARGE = ("cmu_library", "cmu_native")


def inventory_rows(folder: Path | str) -> list[dict[str, object]]:
    """What a folder of recordings holds, one row per source and kind of file, as a table to show.

    The two large sources have a table of their own (``real_motion``).
    """
    small = sorted(p.name for p in Path(folder).iterdir() if p.is_dir() and p.name not in LARGE)
    return [
        {
            "source": r.source,
            "files": r.kind,
            "clips": r.clips,
            "minutes": r.minutes,
            "fps": _range(sorted(set(r.fps))),
            "points": _range(sorted(set(r.points))),
            "seen, %": 100 * r.seen,
            "loader": r.loader,
            "cannot be read": len(r.unread),
            "shipped weights may train on it": {True: "yes", False: "no", None: "not known"}[r.trainable],
        }
        for source in small
        for r in inventory(folder, source)
    ]


def retarget_rows(folder: Path | str, *, each: int | None = None) -> list[dict[str, object]]:
    """One row per source of joint rotations: clips, minutes, fps, joints, residual and skate of the transfer.

    residual: mean distance in cm between a joint and the one it stands for, on the source's own bone lengths
    and on the standard's proportions scaled to its legs. skate: mm per frame of feet that rest, in the file and
    on the standard's proportions, feet planted.

    Raises:
        DataError: a recording is at fault.
    """
    rows = []
    for source in MOTIONS:
        if not (Path(folder) / source).is_dir():
            continue
        found = evenly([(path, load) for _, path, load in recordings(folder, source)], each)
        motions = [load(path) for path, load in found]
        own = [retarget(m) for m in motions]
        other = [retarget(m, proportions="standard") for m in motions]
        rates, joints = sorted({m.fps for m in motions}), sorted({len(m.skeleton) for m in motions})
        rows.append(
            {
                "source": source,
                "clips": len(motions),
                "minutes": sum(m.seconds for m in motions) / 60,
                "fps": _range(rates),
                "joints": _range(joints),
                "residual, own bones, cm": 100 * _mean(r.residual for r in own),
                "residual, standard bones, cm": 100 * _mean(r.residual for r in other),
                "worst clip, cm": 100 * max(r.residual for r in other),
                "skate in the file, mm/frame": _mean(r.skate[0] for r in other),
                "skate after, mm/frame": _mean(r.skate[1] for r in other),
            }
        )
    return rows


def _mean(values: Iterable[float]) -> float:
    """Mean of the values that are numbers; NaN of none."""
    known = [value for value in values if value == value]
    return sum(known) / len(known) if known else float("nan")


def _range(values: Sequence[float]) -> str:
    return f"{values[0]:g}" if len(values) == 1 else f"{values[0]:g} to {values[-1]:g}"
