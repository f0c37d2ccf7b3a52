"""Root rotations of recorded people, falls included, by person."""

from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.io.recordings import recordings
from motionlab.motion import FPS, resample
from motionlab.retarget import retarget
from motionlab.splits import person_of, subsample
from studies.shared import captury

#: Sources with joint rotations. CMU's people come once: ``cmu_amc`` only adds trials that the library lacks.
SOURCES = ("cmu_library", "cmu_amc", "bandai_namco", "deepmimic", "reactidle", "animated_drawings")
FALLS = "captury_falls"
#: Names of hips and neck in joint-position files whose pelvis can be turned into a rotation.
_TRUNK = ("LHip", "RHip", "Neck")


def roots(
    folder: Path | str | None, *, each: int | None = None, people: int | None = None
) -> dict[str, tuple[Tensor, ...]]:
    """Loads root rotations (T, 3, 3) at 30 fps by person; empty without a folder.

    A source whose people are not known counts as one person. Falls and floor work come as joint positions: their
    pelvis's left is along the hips, and its up towards the neck. each: recordings of a person, evenly; people: at most.
    """
    if folder is None:
        return {}
    found: dict[str, dict[str, tuple]] = {}
    for source in (s for s in SOURCES if (Path(folder) / s).is_dir()):
        for _, path, load in recordings(folder, source):
            found.setdefault(person_of(source, path), {}).setdefault(path.stem, (path, load))
    chosen = {who: subsample(list(files.values()), each) for who, files in found.items()}
    if (Path(folder) / FALLS).is_dir():
        files = sorted((Path(folder) / FALLS).glob("*/biomech.csv"))
        chosen[FALLS] = subsample([(path, None) for path in files], each)
    return {who: tuple(_root(*file) for file in chosen[who]) for who in subsample(sorted(chosen), people)}


@lru_cache(maxsize=4096)
def _root(path: Path, load) -> Tensor:
    if load is not None:
        return resample(retarget(load(path)).motion, FPS).rot[:, 0]
    left, right, neck = captury.joints(path, _TRUNK).unbind(1)
    turns = rotation.sixd_to_matrix(torch.cat((left - right, neck - (left + right) / 2), dim=-1))
    at = torch.arange(int((len(turns) - 1) / captury.FPS * FPS) + 1) * (captury.FPS / FPS)  # at 30 frames per second
    low = at.floor().long().clamp(max=len(turns) - 2)
    return rotation.slerp(turns[low], turns[low + 1], (at - low).to(turns))
