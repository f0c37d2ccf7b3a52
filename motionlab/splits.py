"""Who performs a recording, and whether people train, validate ("val") or test ("test"); sources of recordings by name
and licence, on the standard joints at one frame rate.

A performance may exist in several sources (CMU's subject_trial ids agree between them), so the split is by person, over
all sources at once. ``subjects.toml`` says which persons are kept from training, and why. A collection that is not
named there is split by a hash of the person's name, so that it stays the same from one machine to the next.
"""

import hashlib
import re
import tomllib
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from pathlib import Path

from motionlab.errors import DataError
from motionlab.io.recordings import recordings
from motionlab.motion import FPS, Motion, resample
from motionlab.retarget import retarget

#: Sources that a corpus of real motion is made of (``corpus.assemble``), by their licences; people, not clips, are kept
#: apart there.
REAL = ("cmu_library", "cmu_native", "cmu_amc", "deepmimic", "reactidle", "animated_drawings", "isaacgym_amp_cmu")
SYNTHETIC, RECORDED = "synthetic", "recordings"
PARTS = ("train", "val", "test")
_TABLE = Path(__file__).with_name("subjects.toml")
#: Of ten persons of a collection that ``subjects.toml`` does not know: one validates, two test.
_VAL, _TEST = 1, 2


@cache
def _table(path: Path = _TABLE) -> dict:
    """``subjects.toml``, by section."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def person_of(source: str, path: Path | str) -> str:
    """Returns who performs a file of a source.

    ``subjects.toml`` names a pattern for some sources, in whose first group the person stands, or single files.
    Elsewhere it is the folder that the file lies in, as in AMASS; of a flat folder the file's name up to its first "_"
    or digit.
    """
    known, path = _table(), Path(path)
    if named := known["files"].get(f"{source}/{path.stem}"):
        return named
    if source in known["alone"]:
        return source
    if pattern := known["patterns"].get(source):
        found = re.match(pattern["name"], path.stem)
        return f"{pattern['people']}_{found[1] if found else path.stem}"
    if path.parent.name not in ("", ".", source):
        return f"{source}/{path.parent.name}"
    return f"{source}/{re.split(r'[_0-9]', path.stem)[0] or path.stem}"


def part_of(person: str) -> str:
    """Returns the part that a person belongs to, one of ``PARTS``."""
    known = _table()
    for name in ("val", "test"):
        if person in known[name]["people"]:
            return name
    group = person.split("/")[0]
    named = group == person and any(person.startswith(f"{p['people']}_") for p in known["patterns"].values())
    if group in known["alone"] or named:
        return "train"
    lot = int(hashlib.sha256(person.encode()).hexdigest(), 16) % 10
    return "val" if lot < _VAL else "test" if lot < _VAL + _TEST else "train"


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
