"""``fit``: from a video and its keypoints to a scene, one clip or a folder of them."""

import argparse
from collections import defaultdict
from functools import partial
from inspect import signature
from pathlib import Path

from motionlab.commands import batch
from motionlab.commands.motions import is_watched, text_table
from motionlab.errors import DataError
from motionlab.footage import clip, fit, scene_report
from motionlab.io.video import PICTURES

#: A clip's keypoints are one of the first, or a folder that holds some of the second; its video one of the third, or
#: a folder of images.
_TABLES, _PER_FRAME = (".json", ".csv", ".npz"), (".json", ".txt")
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
_TAKEN = signature(fit.run_clip).parameters


def run(options: argparse.Namespace) -> int:
    """Fits one clip, or every clip of a folder; or lists the people of one."""
    if options.out is None and not options.people:
        raise DataError("nowhere to write to", place="--out", remedy="name a folder: --out OUT/")
    if options.each:
        return _fit_each(options)
    if options.jobs is not None or options.cluster is not None:
        remedy = "give folders of clips and --each"
        raise DataError("one clip is not shared out", place="--jobs, --cluster", remedy=remedy)
    return _list_people(options) if options.people else _fit_one(options)


def _list_people(options: argparse.Namespace) -> int:
    how = {name: getattr(options, name) for name in ("out", "fps", "size", "layout")}
    found = clip.open_clip(options.keypoints, options.video, progress=is_watched() or "lines", **how)
    print(text_table(found.footage.table()))
    for note in found.notes:
        print(f"note: {note}")
    return 0


def _fit_one(options: argparse.Namespace) -> int:
    try:
        record = fit.run_clip(**_given(options), progress=is_watched() or "lines")
    except KeyboardInterrupt:
        if kept := len([*(options.out / "windows").glob("*.safetensors")]):
            print(f"\n{kept} windows are kept in {options.out}; the same command goes on from there")
        raise
    print(*scene_report.lines(record), sep="\n")
    print(f"{options.out}: {', '.join([*record['files'], fit.RESULT])}")
    return 0


def _fit_each(options: argparse.Namespace) -> int:
    if options.people:
        raise DataError("lists the people of one clip", place="--people", remedy="leave out --each, or --people")
    if options.video is None and options.keypoints is None:
        remedy = "name a folder of videos, or --keypoints with a folder of what a detector wrote"
        raise DataError("no folder of clips", place="--each", remedy=remedy)
    found = _clips_of(options.keypoints, options.video)
    clips = [(name, *paths, options.out / name) for name, paths in found.items()]
    how = _given(options)
    for name in ("camera", "prior", "pose_prior", "initial"):  # for workers that stand elsewhere
        how[name] = how[name] and how[name].resolve()
    return batch.run_clips(partial(_fit_clip, how=how), clips, partial(_is_fitted, how=how), options, compared=True)


def _fit_clip(job: tuple, how: dict[str, object]) -> list[str]:
    """Fits one of many; says who is to be doubted."""
    record = fit.run_clip(**how | _of(job))
    doubted = [f"person {row['id']} is doubtful, see report.html" for row in record["people"] if row["doubtful"]]
    guessed = [f"person {row['id']}: {text}" for row in record["people"] for text in scene_report.not_known(row)]
    return [*record["notes"], *doubted, *guessed]


def _is_fitted(job: tuple, how: dict[str, object]) -> bool:
    return fit.is_finished(job[3], how | _of(job))


def _of(job: tuple) -> dict[str, Path | None]:
    return dict(zip(("keypoints", "video", "out"), job[1:], strict=True))


def _given(options: argparse.Namespace) -> dict[str, object]:
    """The options that ``run_clip`` takes."""
    return {name: value for name, value in vars(options).items() if name in _TAKEN}


def _clips_of(keypoints: Path | None, videos: Path | None) -> dict[str, tuple[Path | None, Path | None]]:
    """Returns the clips of two folders, by name: keypoints (None: still to be found) and video (None: there is none).
    Keypoints belong to a video where they are called as it is, or begin so: walk.mp4 and walk_keypoints.json."""
    seen, shown = _named(keypoints, _TABLES, _PER_FRAME), _named(videos, _VIDEOS, PICTURES)
    if keypoints is None or videos is None:
        return {name: (seen.get(name), shown.get(name)) for name in seen or shown}
    of = defaultdict(list)
    for name, path in seen.items():
        whose = [video for video in shown if name.startswith(video) and not name[len(video) :][:1].isalnum()]
        of[max(whose, key=len, default="")].append(path)
    remedy = "call a clip's keypoints as its video, or begin their name so; move away what is no clip"
    if of[""]:
        raise DataError(f"no video is called as {of[''][0].name}", path=videos, place=of[""][0].name, remedy=remedy)
    for name, path in shown.items():
        if len(of[name]) != 1:
            names = ", ".join(other.name for other in of[name]) or "none"
            raise DataError(f"the keypoints of {path.name}: {names}", path=keypoints, place=path.name, remedy=remedy)
    return {name: (of[name][0], path) for name, path in shown.items()}


def _named(folder: Path | None, files: tuple[str, ...], inside: tuple[str, ...]) -> dict[str, Path]:
    """The files of a folder with these suffixes, and the folders that hold some with those, by name without suffix."""
    if folder is None:
        return {}
    if not folder.is_dir():
        raise DataError("no such folder", path=folder, remedy="with --each, name folders that hold the clips")
    found = {}
    for path in sorted(folder.iterdir()):
        each, wanted = (path.iterdir(), inside) if path.is_dir() else ([path], files)
        if path.name.startswith(".") or not any(one.suffix.lower() in wanted for one in each):
            continue
        name = path.name if path.is_dir() else path.stem
        if name in found:
            message = f"{found[name].name} and {path.name} have one name"
            raise DataError(message, path=folder, place=name, remedy="give each clip a name of its own")
        found[name] = path
    if not found:
        raise DataError("holds no clips", path=folder, remedy="with --each, name folders that hold the clips")
    return found
