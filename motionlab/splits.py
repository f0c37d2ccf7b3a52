"""Loads sources of recordings by name and licence, on the standard joints at one frame rate; draws evenly from them."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import torch

from motionlab.errors import DataError
from motionlab.humor import state
from motionlab.io.recordings import recordings
from motionlab.motion import FPS, Motion, resample
from motionlab.retarget import retarget

#: Sources on which weights that ship with the project may be trained, by their licences.
SHIPPABLE = ("cmu_amc", "deepmimic", "reactidle", "animated_drawings", "isaacgym_amp_cmu")
#: Those that a corpus of real motion is made of (``corpus.assemble``); people, not clips, are kept apart there.
REAL = ("cmu_library", "cmu_native", *SHIPPABLE)
_WINDOW = 61  # of a window: two seconds
SYNTHETIC, RECORDED = "synthetic", "recordings"


def real_sources(folder: Path | str) -> list[str]:
    """Returns the sources in a folder that a corpus of real motion may be made of: those of ``REAL``, or where there is
    none of them all sub-folders.

    Raises:
        DataError: no such folder, or nothing in it.
    """
    places = sorted(p.name for p in Path(folder).iterdir() if p.is_dir()) if Path(folder).is_dir() else []
    if not places:
        raise DataError("no folders of recordings", path=folder, remedy="give a folder with one sub-folder per source")
    return [name for name in REAL if name in places] or places


def subsample(items: Sequence, most: int | None) -> list:
    """Returns at most ``most`` items, evenly through the sequence; all of them for None."""
    if most is None or len(items) <= most:
        return list(items)
    return [items[round(i * (len(items) - 1) / max(most - 1, 1))] for i in range(most)]


def load_source(folder: Path | str | None, source: str, *, each: int | None = None) -> list[Motion]:
    """Loads the motions of one source on the 22 joints, at 30 frames per second, with the source's own proportions,
    feet on the floor.

    Without a folder, or without that source in it, the list is empty. Loaded once per session.

    Raises:
        DataError: a recording is at fault.
    """
    if folder is None or not (Path(folder) / source).is_dir():
        return []
    found = [(path, load) for _, path, load in recordings(folder, source)]
    return [_load(path, load) for path, load in subsample(found, each)]


@lru_cache(maxsize=512)
def _load(path: Path, load: Callable) -> Motion:
    return resample(retarget(load(path)).motion, FPS)


def state_windows(motions: Sequence[Motion], most: int = 48) -> tuple[torch.Tensor, torch.Tensor]:
    """Computes states (W, 61, 339) with velocities of the past, and contacts (W, 61, 9), evenly over motions; none
    where all are shorter."""
    cuts = [
        (state.from_motion(m, causal=True)[i : i + _WINDOW].float(), m.contacts[i : i + _WINDOW].float())
        for m in motions for i in range(0, m.frames - _WINDOW + 1, _WINDOW)
    ]  # fmt: skip
    if not cuts:
        return torch.zeros(0, _WINDOW, state.STATE), torch.zeros(0, _WINDOW, state.CONTACTS)
    x, c = zip(*subsample(cuts, most), strict=True)
    return torch.stack(x), torch.stack(c)
