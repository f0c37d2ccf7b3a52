"""``show``: motion files as a film, or as key poses; and ``--film`` of the commands that make motion."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from motionlab.commands.motions import READ, add_reading, read_motion, with_standard_joints
from motionlab.commands.printing import add_command
from motionlab.errors import DataError

if TYPE_CHECKING:
    from motionlab.motion import Motion

CUT = {"type": float, "nargs": 2, "metavar": ("FROM", "TO")}  # the option ``--cut``, for :func:`cut`
_MOST = 6  # motions side by side: more are too small to see
_FILMS, _PICTURE = (".mp4", ".gif"), ".png"
_PICTURES = 900  # of a film: 30 s at 30 a second; they are all in memory


def add_show(commands: argparse._SubParsersAction) -> None:
    """Adds the command; nothing heavy is imported before it runs."""
    text = "draw motion files side by side: a film, or a picture of key poses"
    command = add_command(commands, "show", text, "walk.bvh --out walk.mp4", _show)
    option, text = command.add_argument, "a film (.mp4, .gif), or key poses (.png), a row a file"
    option("files", nargs="+", type=Path, metavar="IN", help=f"a motion: {READ}; up to {_MOST} of them")
    option("--out", type=Path, required=True, metavar="FILE", help=text)
    option("--bones", action="store_true", help="a figure of the file's own joints, not a body")
    option("--follow", action="store_true", help="the view moves along with who walks")
    option("--cut", **CUT, help="only these seconds of every file")
    add_reading(command)


def check_film(path: Path, count: int = 1, picture: bool = False) -> None:
    """Checks that a film of so many motions (or, if that is what is wanted, a picture) can be written there.

    Raises:
        DataError: another ending, no such folder, or too many motions.
    """
    endings = (*_FILMS, _PICTURE) if picture else _FILMS
    if path.suffix not in endings:
        raise DataError("no film can be written in this format", path=path, remedy=f"end it in {' or '.join(endings)}")
    if not path.parent.is_dir():
        raise DataError("there is no such folder", path=path.parent, remedy="make it first, or name another")
    if count > _MOST:
        raise DataError(f"{count} motions are too many to see", path=path, remedy=f"show {_MOST} at most")


def draw_film(motions: Mapping[str, Motion], path: Path, *, bones: bool = False, follow: bool = True) -> str:
    """Draws motions side by side, each under its label, a body for each; says what was written."""
    from motionlab.body import BodyModel
    from motionlab.viz import movie

    motions = motions if bones else {label: with_standard_joints(motion) for label, motion in motions.items()}
    how = {"body": None if bones else BodyModel.from_anny(), "roles": {"given": "observation"}}
    film = movie.film(motions, path, follow=follow, most=_PICTURES if path.suffix == ".mp4" else None, **how)
    faster = f", played {film.speed:.1f} times as fast" if film.speed > 1.05 else ""
    return f"{path}: a film of {film.seconds:.1f} s{faster}"


def _show(options: argparse.Namespace) -> int:
    check_film(options.out, len(options.files), picture=True)
    motions = {}
    for label, path in zip(_labels(options.files), options.files, strict=True):
        told = partial(print, f"{label}:", flush=True)
        motion = read_motion(path, options, told)
        given, motion = motion.notes, motion if options.bones else with_standard_joints(motion)
        for note in motion.notes[len(given) :]:
            told(note)
        motions[label] = cut(motion, path, options.cut)
    if options.out.suffix != _PICTURE:
        print(draw_film(motions, options.out, bones=options.bones, follow=options.follow))
        return 0
    from PIL import Image

    from motionlab.body import BodyModel
    from motionlab.viz import movie

    poses = min(8, *(motion.frames for motion in motions.values()))
    body = None if options.bones else BodyModel.from_anny()
    Image.fromarray(movie.strip(motions, poses, body=body)).save(options.out)
    print(f"{options.out}: {poses} key poses")
    return 0


def cut(motion: Motion, path: Path, seconds: list[float] | None) -> Motion:
    """Returns what lies between two times; all, where none are given.

    Raises:
        DataError: nothing does.
    """
    if seconds is None:
        return motion
    begin, end = seconds
    if not 0 <= begin < end or begin * motion.fps > motion.frames - 1:  # not a number is neither
        remedy = f"it lasts {motion.frames / motion.fps:.1f} s: give two times within, the earlier first"
        raise DataError(f"no motion from {begin:g} to {end:g} s", path=path, place="--cut", remedy=remedy)
    return motion.cut(round(begin * motion.fps), min(round(end * motion.fps) + 1, motion.frames))


def _labels(files: list[Path]) -> list[str]:
    """The names of files, with their folders where two have one name."""
    seen = Counter(path.name for path in files)
    labels = [path.name if seen[path.name] == 1 else f"{path.resolve().parent.name}/{path.name}" for path in files]
    twice = next((label for label, count in Counter(labels).items() if count > 1), None)
    if twice:
        raise DataError("two panels would have this name", path=twice, remedy="name each file once, or rename one")
    return labels
