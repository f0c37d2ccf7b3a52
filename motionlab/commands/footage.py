"""``fit``: from a video and its keypoints to a scene, one clip or a folder of them."""

from __future__ import annotations

import argparse
from collections import defaultdict
from functools import partial
from pathlib import Path

from motionlab.commands.printing import add_command, add_sharing, is_watched, text_table
from motionlab.errors import DataError

#: A clip's keypoints are one of the first, or a folder that holds some of the second; its video one of the third, or
#: a folder of images.
_TABLES, _PER_FRAME = (".json", ".csv", ".npz"), (".json", ".txt")
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
_PASSED_ON = ("person", "fps", "size", "layout", "camera", "camera_name", "prior", "pose_prior", "initial", "pelvis",
              "height", "draws", "solver", "quick")  # fmt: skip


def add_fit(commands: argparse._SubParsersAction) -> None:
    """Adds the command; nothing heavy is imported before it runs."""
    text = "find the 3-D motion of the people in a video, from 2-D keypoints"
    command = add_command(commands, "fit", text, "clip.mp4 --keypoints keypoints/ --out scene/", _fit)
    option = command.add_argument
    option("video", nargs="?", type=Path, help="a video, or a folder of images; without it: on paper")
    option(
        "--keypoints", type=Path, metavar="PATH",
        help="what a 2-D pose detector wrote, told by content: a file, or a folder with a file per frame "
        "(default: found in the video, needs motionlab[detect])",
    )  # fmt: skip
    option("--out", type=Path, metavar="FOLDER/", help="gets motion, scene, film and report")
    option("--people", action="store_true", help="list who was seen, and stop")
    option(
        "--person", nargs="+", default=["longest"], metavar="ID", help="longest, largest, all, or ids (see --people)"
    )
    option("--size", type=_size, metavar="WxH", help="of the image, where no file says it, in pixels")
    option("--fps", type=float, help="of the keypoints, where neither they nor the video say it")
    option("--layout", help="of the keypoints, where it is not told: BODY_25, COCO_17, HALPE_26, ...")
    option(
        "--camera", type=Path, metavar="FILE", help="Qualisys XML, Captury .calib, Pose2Sim's TOML, OpenCV's YAML or "
        'XML, EasyMocap, COLMAP, or JSON: "intrinsics" (3x3, px), "width", "height"; if known "distortion" (k1, k2, '
        'p1, p2, k3), "rotation" (3x3) and "translation" from the world, z up, floor z = 0'
    )  # fmt: skip
    option("--camera-name", help="which of the file's cameras (default: by the number in PATH's name)")
    option("--prior", type=Path, metavar="FILE", help="of motion: an official HuMoR .pth, or your own")
    option("--pose-prior", type=Path, metavar="FILE", help="a VPoser snapshot, or your own")
    option("--initial", type=Path, metavar="FILE", help="of first states: official .npz, or your own")
    option(
        "--pelvis", type=float, nargs=3, metavar=("X", "Y", "Z"),
        help="needed with official files: the pelvis from SMPL's translation, J_0 of the mean body in metres",
    )  # fmt: skip
    option("--height", type=_height, metavar="METRES", help="of the person who is fitted, where that is no adult's")
    option(
        "--draws", type=int, default=0, metavar="K",
        help="of a clip of up to 6 s, K other motions that explain as well what was seen, and how far off hidden limbs "
        "may be",
    )  # fmt: skip
    option(
        "--solver", choices=("shooting", "rollout"), default="shooting",
        help="of stage 3; rollout: HuMoR's schedule, in all stages, with its unknowns and weights, a minute or more",
    )  # fmt: skip
    option("--quick", action="store_true", help="few steps, a small film: a first look")
    option(
        "--each", action="store_true",
        help="the two paths are folders of clips, put together by their names: a scene for each, in FOLDER/NAME/",
    )  # fmt: skip
    add_sharing(command, "with --each")


def _size(text: str) -> tuple[int, int]:
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isdecimal() and 0 < int(side) < 100_000 for side in sides):
        raise argparse.ArgumentTypeError(f"expected width x height in pixels, such as 1280x720, got {text!r}")
    return int(sides[0]), int(sides[1])


def _height(text: str) -> float:
    try:
        height = float(text)
    except ValueError:
        height = 0.0
    if not 0.3 <= height <= 2.5:
        raise argparse.ArgumentTypeError(f"expected metres, such as 1.10, got {text!r}")
    return height


def _fit(options: argparse.Namespace) -> int:
    if options.out is None and not options.people:
        raise DataError("nowhere to write to", place="--out", remedy="name a folder: --out OUT/")
    if options.each:
        return _fit_each(options)
    if options.jobs is not None or options.cluster is not None:
        remedy = "give folders of clips and --each"
        raise DataError("one clip is not shared out", place="--jobs, --cluster", remedy=remedy)
    return _list_people(options) if options.people else _fit_one(options)


def _list_people(options: argparse.Namespace) -> int:
    from motionlab.footage import clip

    how = {name: getattr(options, name) for name in ("out", "fps", "size", "layout")}
    found = clip.open_clip(options.keypoints, options.video, progress=is_watched() or "lines", **how)
    print(text_table(found.footage.table()))
    for note in found.notes:
        print(f"note: {note}")
    return 0


def _fit_one(options: argparse.Namespace) -> int:
    from motionlab.footage import fit, scene_report

    how = {name: getattr(options, name) for name in _PASSED_ON} | {"progress": is_watched() or "lines"}
    try:
        record = fit.run_clip(options.keypoints, options.out, video=options.video, **how)
    except KeyboardInterrupt:
        kept = len(list((options.out / "windows").glob("*.safetensors")))
        print(f"\n{kept} windows are kept in {options.out}; the same command goes on from there" if kept else "")
        raise
    for line in scene_report.lines(record):
        print(line)
    print(f"{options.out}: {', '.join([*record['files'], fit.RESULT])}")
    return 0


def _fit_each(options: argparse.Namespace) -> int:
    from motionlab.commands import batch

    if options.people:
        raise DataError("lists the people of one clip", place="--people", remedy="leave out --each, or --people")
    if options.video is None and options.keypoints is None:
        remedy = "name a folder of videos, or --keypoints with a folder of what a detector wrote"
        raise DataError("no folder of clips", place="--each", remedy=remedy)
    found = _clips_of(options.keypoints, options.video)
    clips = [(name, *paths, options.out / name) for name, paths in found.items()]
    how = {name: getattr(options, name) for name in _PASSED_ON}
    for name in ("camera", "prior", "pose_prior", "initial"):  # for workers that stand elsewhere
        how[name] = how[name] and how[name].resolve()
    return batch.run_clips(partial(_fit_clip, how=how), clips, partial(_is_fitted, how=how), options, compared=True)


def _fit_clip(clip: tuple, how: dict[str, object]) -> list[str]:
    """Fits one of many; says who is to be doubted."""
    from motionlab.footage import fit, scene_report

    _, keypoints, video, out = clip
    record = fit.run_clip(keypoints, out, video=video, **how)
    doubted = [f"person {row['id']} is doubtful, see report.html" for row in record["people"] if row["doubtful"]]
    guessed = [f"person {row['id']}: {text}" for row in record["people"] for text in scene_report.not_known(row)]
    return [*record["notes"], *doubted, *guessed]


def _is_fitted(clip: tuple, how: dict[str, object]) -> bool:
    from motionlab.footage import fit

    _, keypoints, video, out = clip
    return fit.is_finished(out, {"keypoints": keypoints, "video": video} | how)


def _clips_of(keypoints: Path | None, videos: Path | None) -> dict[str, tuple[Path | None, Path | None]]:
    """Returns the clips of two folders, by name: keypoints (None: still to be found) and video (None: there is none).
    Keypoints belong to a video where they are called as it is, or begin so: walk.mp4 and walk_keypoints.json."""
    from motionlab.io.video import PICTURES

    seen = _named(keypoints, _TABLES, _PER_FRAME)
    if videos is None:
        return {name: (path, None) for name, path in seen.items()}
    shown = _named(videos, _VIDEOS, PICTURES)
    if keypoints is None:
        return {name: (None, path) for name, path in shown.items()}
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
