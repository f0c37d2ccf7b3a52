"""Makes training motion of a folder of recordings: loaded, retargeted, at one frame rate, cleaned, labelled, kept.

    found = corpus.assemble("recordings/")          # minutes the first time, seconds after that
    takes = found.part("train")                    # clean stretches of people that models learn from
    print(found.report())                          # what was left out, and why

Each source is parsed once and kept whole or not at all; a recording that changes, or code that would read it otherwise,
is parsed again. A file that cannot be used is named and counted.

Source: thesis 4.1.2, "Data": normalised, on a standard skeleton, sequences held out.
"""

import csv
import hashlib
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from tqdm.auto import tqdm

from motionlab import checkpoint, cleaning, rotation, splits
from motionlab.contact import with_contacts
from motionlab.errors import DataError, MissingData
from motionlab.files import source_hash
from motionlab.io.reading import reading
from motionlab.io.recordings import recordings
from motionlab.motion import FPS, Motion, resample
from motionlab.parallel import run_jobs
from motionlab.retarget import retarget
from motionlab.skeleton import STANDARD

_FORMAT = 5  # of what is kept
_EACH = 16  # recordings of a process, at least
_SLOWEST = 10.0  # fps: between frames further apart nobody knows what happened
#: Modules whose text decides what is kept.
_READERS = (
    "cleaning", "contact", "corpus", "ik", "motion", "rest", "retarget", "rigs", "rotation", "skeleton",
    "io/asf", "io/bvh", "io/clips", "io/judging", "io/reading", "io/recordings", "io/smpl",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Take:
    """A clean stretch of a recording: 22 joints, floor at z = 0, contacts labelled.

    name: source, file, and from which second. person: who performs. said: what an index of the source says of it, or
    the file's name. fps: of the recording. missing: joints that the recording lacks; their rotation is made up.
    """

    motion: Motion
    name: str
    source: str
    person: str
    said: str
    fps: float
    missing: tuple[str, ...]

    @property
    def part(self) -> str:
        """The part that the person belongs to."""
        return splits.part_of(self.person)


@dataclass(frozen=True)
class SourceRow:
    """What became of one source: recordings, seconds of them and how many are kept; seconds cut by fault; files that
    cannot be used, and why."""

    source: str
    recordings: int
    seconds: float
    kept: float
    cut: Mapping[str, float]
    refused: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class Corpus:
    """Clean stretches of many recordings, and what was left out."""

    takes: tuple[Take, ...]
    rows: tuple[SourceRow, ...]

    def part(self, name: str) -> list[Take]:
        """The takes of a part: "train", "val" or "test".

        Raises:
            ValueError: no such part.
        """
        if name not in splits.PARTS:
            raise ValueError(f"part: expected one of {', '.join(splits.PARTS)}, got {name!r}")
        return [take for take in self.takes if take.part == name]

    def report(self) -> str:
        """What was read, what was cut and why, and the parts: a text for the terminal."""
        lines = []
        for row in self.rows:
            lost = ", ".join(f"{name} {s / 60:.1f}" for name, s in sorted(row.cut.items(), key=lambda x: -x[1]))
            line = f"{row.source}: {row.recordings} recordings, {row.seconds / 60:.1f} min, kept {row.kept / 60:.1f}"
            lines.append(f"{line}; cut, min: {lost}" if lost else line)
            reasons = Counter(row.refused.values())
            lines += [f"  refused {n}: {reason}" for reason, n in reasons.most_common(5)]
            lines += [f"    {name}" for name in list(row.refused)[:5]]
        for name in splits.PARTS:
            some = self.part(name)
            seconds, who = sum(t.motion.seconds for t in some), len({t.person for t in some})
            lines.append(f"{name}: {seconds / 60:.1f} min of {who} people, {len(some)} stretches")
        return "\n".join(lines)


def cache_folder() -> Path:
    """Where prepared corpora are kept: below ``$MOTIONLAB_CACHE``, or the user's cache."""
    return Path(os.environ.get("MOTIONLAB_CACHE") or Path.home() / ".cache" / "motionlab") / "corpus"


def assemble(
    folder: Path | str, sources: Sequence[str] | None = None, *, kept: Path | str | None = None,
    workers: int = 1, every: int = 1, reading: Mapping[str, object] | None = None, progress: bool = True,
) -> Corpus:  # fmt: skip
    """Makes a corpus of the recordings in a folder, one sub-folder per source; what is kept from before is read.

    Args:
        sources: names of sub-folders; None: all that hold motions with rotations.
        kept: folder of what is kept; None: :func:`cache_folder`.
        workers: processes (a script that asks for several needs ``if __name__ == "__main__"``). every: only each n-th
            recording of a source. reading: options for those loaders that take them (``unit``, ``up``, ...).

    Raises:
        MissingData: no such folder or source, or nothing usable in it.
    """
    folder, kept = Path(folder), Path(kept) if kept else cache_folder()
    kept.mkdir(parents=True, exist_ok=True)
    found, rows = [], []
    for name in sources or sorted({each.source for each in recordings(folder)}):
        files = [(path, load) for _, path, load in recordings(folder, name, reading=reading)][::every]
        path = kept / f"{name}-{_key(folder, [path for path, _ in files], reading)}.safetensors"
        if (stored := _read(path)) is None:
            checkpoint.keep(path, *_prepared(name, folder, files, workers, progress))
            stored = _read(path)
        takes, row = stored
        found += takes
        rows.append(row)
    if not found:
        refused = [f"{file}: {why}" for row in rows for file, why in row.refused.items()]
        said = f"{len(refused)} recordings are refused, such as {refused[0]}." if refused else "Give longer recordings."
        raise MissingData(f"any usable motion in {folder}", said)
    once, lost = _once(found)
    for k, row in enumerate(rows):
        if again := lost[row.source]:
            rows[k] = replace(row, kept=row.kept - again, cut={**row.cut, "repeated": again})
    return Corpus(tuple(once), tuple(rows))


def _once(takes: Sequence[Take]) -> tuple[list[Take], dict[str, float]]:
    """The takes without those that repeat an earlier one: as long, and the same pose within a hundredth at nine frames;
    and by source how many seconds these last.

    Of the CMU library eight subjects are copies of others (83 and 122, 91 and 105, ...).
    """
    once, lost, seen = [], defaultdict(float), defaultdict(list)
    for take in takes:
        some = take.motion.rot[torch.linspace(0, take.motion.frames - 1, 9).long()]
        if any((some - other).abs().mean() < 0.01 for other in seen[take.motion.frames]):
            lost[take.source] += take.motion.seconds
        else:
            once.append(take)
            seen[take.motion.frames].append(some)
    return once, lost


def _key(folder: Path, files: Sequence[Path], reading: object) -> str:
    """What a kept source depends on: its files as they are, how they are read, and the code that reads them."""
    whole = hashlib.sha256(repr((_FORMAT, reading or None)).encode())
    places = {folder / path.relative_to(folder).parts[0] for path in files}
    beside = [path for place in places for name in ("index.tsv", "*.asf") for path in sorted(place.rglob(name))]
    for path in (*files, *beside):
        state = path.stat()
        whole.update(repr((str(path.relative_to(folder)), state.st_size, state.st_mtime_ns)).encode())
    for name in _READERS:
        whole.update(source_hash((Path(__file__).parent / f"{name}.py").read_text(encoding="utf-8")).encode())
    return whole.hexdigest()[:16]


def _prepared(
    source: str, folder: Path, files: Sequence[tuple[Path, Callable]], workers: int, bar: bool
) -> tuple[dict[str, torch.Tensor], dict]:
    """One source, ready to be kept: tensors of every take by their number, and what to say of them."""
    said = _descriptions(folder / source)
    jobs = [partial(_stretches, folder, path, load, said.get(path.stem, path.stem)) for path, load in files]
    with tqdm(total=len(files), disable=not bar, desc=source, unit="file") as shown:
        found = run_jobs(jobs, max(1, min(workers, len(jobs) // _EACH)), lambda *_: shown.update())
    cut, takes = Counter(), [take for each, _ in found for take in each]
    for _, row in found:
        cut.update(row["cut"])
    row = {
        "source": source, "recordings": len(files), "seconds": sum(row["seconds"] for _, row in found), "cut": cut,
        "refused": {row["file"]: row["refused"] for _, row in found if row["refused"]},
    }  # fmt: skip
    tensors = {f"{name} {k}": x for k, (parts, _) in enumerate(takes) for name, x in parts.items()}
    return tensors, {"takes": [about for _, about in takes], "row": row}


def _stretches(folder: Path, path: Path, load: Callable, said: str) -> tuple[list[tuple[dict, dict]], dict]:
    """The clean stretches of a recording, tensors and what to say of each; and what became of the rest."""
    file = path.relative_to(folder)
    row = {"file": file.as_posix(), "seconds": 0.0, "cut": {}, "refused": ""}
    try:
        recording = load(path)
        if not isinstance(recording, Motion):
            raise DataError("holds positions without rotations", path=path, remedy="leave it out")
        if recording.fps < _SLOWEST:
            raise DataError(f"{recording.fps:g} frames per second are too few", path=path, remedy="leave it out")
        moved = retarget(recording)
        whole = resample(replace(moved.motion, name=file.with_suffix("").as_posix()), FPS, "spline")
        cleaned = cleaning.clean(whole)
    except (DataError, MissingData, ValueError) as error:
        return [], row | {"refused": getattr(error, "message", str(error))}
    about = {"file": file.as_posix(), "said": said, "fps": recording.fps, "missing": list(moved.unmapped)}
    takes = []
    for stretch in map(with_contacts, cleaned.stretches):
        parts = {
            "root": stretch.root.float(), "rot": rotation.matrix_to_quaternion(stretch.rot.float()),
            "contacts": stretch.contacts.to(torch.uint8), "offsets": stretch.skeleton.offsets.float(),
        }  # fmt: skip
        takes.append((parts, about | {"name": stretch.name, "sole": stretch.skeleton.sole}))
    return takes, row | {"seconds": whole.seconds, "cut": dict(cleaned.seconds)}


def _descriptions(place: Path) -> dict[str, str]:
    """What an ``index.tsv`` beside the recordings says of each, by file stem: columns id and description."""
    path = place / "index.tsv"
    if not path.is_file():
        return {}
    with reading(path, "repair it, or take it away"), path.open(encoding="utf-8", errors="replace", newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    return {row["id"]: row.get("description") or "" for row in rows if row.get("id")}


def _read(path: Path) -> tuple[list[Take], SourceRow] | None:
    """A kept source; None where there is none, or it is damaged."""
    if (found := checkpoint.kept(path)) is None:
        return None
    tensors, about = found
    source, takes = about["row"]["source"], []
    for k, each in enumerate(about["takes"]):
        root, rot, contacts, offsets = (tensors[f"{name} {k}"] for name in ("root", "rot", "contacts", "offsets"))
        skeleton = replace(STANDARD, offsets=offsets, sole=each["sole"])
        motion = Motion(skeleton, root, rotation.quaternion_to_matrix(rot), FPS, contacts.float(), name=each["name"])
        person = splits.person_of(source, each["file"])
        takes.append(Take(motion, each["name"], source, person, each["said"], each["fps"], tuple(each["missing"])))
    return takes, SourceRow(**about["row"], kept=sum(t.motion.seconds for t in takes))
