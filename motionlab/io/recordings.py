"""A folder of recordings: what is in it, and which loader reads it.

The folder has one sub-folder per source, which is searched for files that a loader knows; other files are passed over.
"""

import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from motionlab import io
from motionlab.errors import DataError, MissingData
from motionlab.io import keypoints
from motionlab.io.points import Positions
from motionlab.motion import Motion
from motionlab.observation import Observation2D

_TEXTS = (".json", ".txt")
_SET = "Set MOTIONLAB_DATA to a folder with one sub-folder of recordings per source."


class Recording(NamedTuple):
    """One recording: ``loader(path)`` gives a Motion, Positions or Observation2D."""

    source: str
    path: Path
    loader: Callable[[Path], Motion | Positions | Observation2D]


#: What the project's own keypoints do not say of themselves; 30 frames per second are presumed.
_SAID = {
    "pose2sim_openpose": {"fps": 60, "layout": "BODY_25B"},
    "3dance_openpose": {"fps": 30},
    "openpose_crowd": {"fps": 30},
}


@dataclass(frozen=True)
class Row:
    """One line of the inventory: recordings of one kind of one source.

    clips, minutes: of those that can be read. fps, points: lowest and highest over them, 0 where there is none.
    points: joints, markers or keypoints. seen: share of points that were measured or detected. unread: why each of the
    others cannot be read; the message names the file. guessed: see ``guesses``.
    """

    source: str
    kind: str
    clips: int
    minutes: float
    fps: tuple[float, float]
    points: tuple[int, int]
    seen: float
    unread: tuple[DataError | MissingData, ...] = ()
    guessed: tuple[str, ...] = ()


def recordings(folder: str | Path, source: str | None = None, *, reading: Mapping | None = None) -> Iterator[Recording]:
    """Finds every recording of the folder, or of one source, sorted by source and path.

    reading: options for those loaders that take them (``unit``, ``up``, ``fps``, ...).

    Raises:
        MissingData: the folder, or the source in it, is not there or holds nothing that a loader knows.
    """
    for name, _, path, loader in _found(Path(folder), source, None):
        yield Recording(name, path, partial(io.guided, loader, options=reading) if reading else loader)


def passed_over(folder: str | Path) -> list[str]:
    """Finds the files of a folder that are no recordings: for each source and kind how many, one of them, and why.

    Raises:
        MissingData: see ``recordings``.
    """
    found = []
    for name, place in _places(Path(folder)).items():
        paths = [*place]
        used = {path for _, path, _ in _files(name, paths, None)}
        kinds: dict[str, list[str]] = {}
        for path in sorted(filter(Path.is_file, paths)):
            if not {path, path.parent} & used:
                kinds.setdefault(path.suffix.lower(), []).append(path.name)
        for suffix, names in kinds.items():
            what = f"{len(names)} {suffix or 'files without ending'}, such as {names[0]}"
            found.append(f"{name}: {what}: {io.why_not(suffix)}")
    return found


def inventory(
    folder: str | Path, source: str | None = None, *, video_fps: float | None = None, reading: Mapping | None = None
) -> list[Row]:
    """Loads every recording and counts: one row per source and kind of file. Arguments as of ``recordings``.

    A recording that cannot be read stops nothing: it stands in ``unread`` of its row. video_fps: frames per second of
    OpenPose folders of one's own, which do not store it.

    Raises:
        MissingData: see ``recordings``.
    """
    groups: dict[tuple[str, str], tuple[list, list]] = {}
    for name, kind, path, loader in _found(Path(folder), source, video_fps):
        read, unread = groups.setdefault((name, kind), ([], []))
        try:
            read.append((path, *_size(io.guided(loader, path, reading or {}))))
        except (DataError, MissingData) as error:
            unread.append(error)
    rows = []
    for (name, kind), (read, unread) in groups.items():
        _, frames, rates, points, *_ = zip(*read, strict=True) if read else ((0,),) * 4
        minutes = sum(t / fps for _, t, fps, *_ in read) / 60
        seen = sum(share * t for _, t, _, _, share, _ in read) / max(sum(frames), 1)
        spans = ((min(each), max(each)) for each in (rates, points))
        guessed = guesses((path, notes) for path, *_, notes in read)
        rows.append(Row(name, kind, len(read), minutes, *spans, seen, tuple(unread), guessed))
    return rows


def guesses(noted: Iterable[tuple[Path, Sequence[str]]]) -> tuple[str, ...]:
    """Sums up notes of files, doubts first: those that differ by numbers alone are one, of which the first is told."""
    kinds: dict[str, list[str]] = {}
    for path, note in ((path, note) for path, notes in noted for note in notes):
        kinds.setdefault(re.sub(r"[\d.]+", "0", note.partition(":")[0]), []).append(f"{path.name}: {note}")
    told = sorted(kinds.values(), key=lambda each: ("--" not in each[0], -len(each)))  # what offers an option doubts
    return tuple(f"{len(each)} such as {each[0]}" if len(each) > 1 else each[0] for each in told)


def _size(value: Motion | Positions | Observation2D) -> tuple[int, float, int, float, tuple]:
    """Frames, frames per second, points, share of points seen, and notes of a recording."""
    if isinstance(value, Motion):
        return value.frames, value.fps, len(value.skeleton), 1.0, value.notes
    mask = value.valid if isinstance(value, Positions) else value.visible
    return value.frames, value.fps, len(value.names), float(mask.float().mean()), getattr(value, "notes", ())


def _places(folder: Path) -> dict[str, Iterable[Path]]:
    """What is in the sources, by name: in the sub-folders at any depth, and beside them where files lie there."""
    if folder.is_file():
        return {folder.name: [folder]}
    if not folder.is_dir():
        raise MissingData(f"the data folder {folder}", _SET)
    beside = [*folder.iterdir()]
    places = {path.name: path.rglob("*") for path in beside if path.is_dir()}
    return places | ({folder.resolve().name: beside} if any(path.is_file() for path in beside) else {})


def _found(folder: Path, source: str | None, video_fps: float | None) -> Iterator[tuple[str, str, Path, Callable]]:
    places, one = _places(folder), None
    if source is not None and source not in places:
        raise MissingData(f"source {source!r} in {folder}", f"There are: {', '.join(sorted(places))}.")
    for name in sorted(places) if source is None else [source]:
        for one in _files(name, places[name], video_fps):
            yield name, *one
    if one is None:
        raise MissingData(f"any recording in {folder}", "; ".join([*passed_over(folder), _SET]))


def _files(name: str, place: Iterable[Path], video_fps: float | None) -> Iterator[tuple[str, Path, Callable]]:
    views = set()
    for path in sorted(filter(Path.is_file, place)):
        suffix, head = path.suffix.lower(), b""
        if suffix in _TEXTS:  # told by their beginnings
            head = b'{"Frames"'  # of one that cannot be opened, its loader says so
            with suppress(OSError), path.open("rb") as file:
                head = file.read(4096)
        if b'"people"' in head and path.parent not in views:
            views.add(path.parent)
            yield "openpose", path.parent, partial(keypoints.load_person, **_SAID.get(name, {"fps": video_fps}))
        elif suffix in io.LOADERS and (suffix not in _TEXTS or (b'"Frames"' in head and b"{" in head[:9])):
            if suffix != ".npz" or _may_be_motion(path):
                yield suffix[1:], path, io.LOADERS[suffix]


def _may_be_motion(path: Path) -> bool:
    """Whether an npz has a key that a loader reads; of one that cannot be opened, its loader says so."""
    with suppress(Exception), zipfile.ZipFile(path) as archive:
        return any(name.removesuffix(".npy") in io.NPZ_LAYOUTS for name in archive.namelist())
    return True
