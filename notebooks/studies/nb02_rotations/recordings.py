"""Root rotations of every source of recordings, falls included."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.io.points import Positions
from motionlab.io.recordings import recordings
from motionlab.splits import MOTIONS, standard

#: Names of hips and neck in joint-position files whose pelvis can be turned into a rotation.
_TRUNK = ("LHip", "RHip", "Neck")


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
