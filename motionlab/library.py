"""Recordings as the experiments want them: on the standard joints, at one frame rate, by source."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.contact import with_contacts
from motionlab.io.positions import Positions
from motionlab.io.recordings import inventory, recordings
from motionlab.motion import Motion, resample
from motionlab.retarget import retarget

#: Sources that store joint rotations.
MOTIONS = ("animated_drawings", "bandai_namco", "cmu_amc", "deepmimic", "isaacgym_amp_cmu", "reactidle")
#: Names of hips and neck in joint-position files whose pelvis can be turned into a rotation.
_TRUNK = ("LHip", "RHip", "Neck")


def spread(items: Sequence, most: int | None) -> list:
    """At most ``most`` items, evenly through the sequence; all of them for None."""
    if most is None or len(items) <= most:
        return list(items)
    return [items[round(i * (len(items) - 1) / max(most - 1, 1))] for i in range(most)]


def standard(folder: Path | str | None, source: str, *, each: int | None = None, fps: float = 30.0) -> list[Motion]:
    """Motions of one source on the 22 joints, with the source's own proportions, feet on the floor.

    Without a folder, or without that source in it, the list is empty. Loaded once per session.

    Raises:
        DataError: a recording is at fault.
    """
    if folder is None or not (Path(folder) / source).is_dir():
        return []
    found = [(path, load) for _, path, load in recordings(folder, source)]
    return [_standard(path, load, fps) for path, load in spread(found, each)]


@lru_cache(maxsize=512)
def _standard(path: Path, load: Callable, fps: float) -> Motion:
    return resample(retarget(load(path)).motion, fps)


def roots(folder: Path | str | None, *, each: int | None = None) -> dict[str, list[Tensor]]:
    """Root rotations (T, 3, 3) at 30 fps of every source that has them; empty without a folder.

    Falls and floor work come as joint positions: their pelvis is turned by its hips and the line to the neck.
    """
    found = {source: [m.rot[:, 0] for m in standard(folder, source, each=each)] for source in MOTIONS}
    falls = [] if folder is None or not (Path(folder) / "captury_falls").is_dir() else _fallen(Path(folder))
    return {source: paths for source, paths in (found | {"captury_falls": falls}).items() if paths}


def _fallen(folder: Path) -> list[Tensor]:
    loaded = [load(path) for _, path, load in recordings(folder, "captury_falls") if path.suffix == ".csv"]
    takes = [p for p in loaded if isinstance(p, Positions) and set(_TRUNK) <= set(p.names)]
    return [_thirty(pelvis_rotation(p), p.fps) for p in takes]


def pelvis_rotation(positions: Positions) -> Tensor:
    """Orientation (T, 3, 3) of the pelvis from hips and neck: left along the hips, up towards the neck."""
    left, right, neck = positions.select(_TRUNK).positions.unbind(1)
    across, up = left - right, neck - (left + right) / 2
    return rotation.sixd_to_matrix(torch.cat((across, up), dim=-1))


def _thirty(path: Tensor, fps: float) -> Tensor:
    """A path of rotations at 30 frames per second, by slerp."""
    at = torch.arange(int((len(path) - 1) / fps * 30) + 1) * (fps / 30)
    low = at.floor().long().clamp(max=len(path) - 2)
    return rotation.slerp(path[low], path[low + 1], (at - low).to(path))


def inventory_rows(folder: Path | str) -> list[dict[str, object]]:
    """What a folder of recordings holds, one row per source and kind of file, as a table to show."""
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
        for r in inventory(folder)
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
        found = spread([(path, load) for _, path, load in recordings(folder, source)], each)
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


#: Sources on which weights that ship with the project may be trained, by their licences.
SHIPPABLE = ("cmu_amc", "deepmimic", "reactidle", "animated_drawings", "isaacgym_amp_cmu")


def trainable(folder: Path | str | None, sources: Sequence[str] = SHIPPABLE) -> tuple[list[Motion], list[Motion]]:
    """Motions with contacts on a flat floor, for training and held out (every fifth clip of a source).

    Left out: clips in which no joint is below 30 cm for more than a tenth of the time (climbing, a wrong floor).
    """
    split: tuple[list[Motion], list[Motion]] = [], []
    for source in sources:
        flat = [m for m in standard(folder, source) if m.positions[..., 2].amin(-1).quantile(0.9) < 0.3]
        for i, motion in enumerate(flat):
            split[i % 5 == 2].append(with_contacts(motion))
    return split
