"""What the commands on motion files share: formats, what a file does not say of itself, and the 22 standard joints."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from motionlab.errors import DataError

if TYPE_CHECKING:
    from motionlab.motion import Motion

WRITTEN = (".bvh", ".npz", ".glb", ".npy")
READ = f"{' '.join(WRITTEN)} .gltf .amc, DeepMimic's .txt, or .pt .pkl of GVHMR, WHAM, PHALP"
_READING = ("unit", "up", "axes", "fps_in", "translations", "asf", "animation", "person")


def add_reading(command: argparse.ArgumentParser, rate: tuple[str, ...] = ("--fps-in", "--fps")) -> None:
    """Adds what a motion file does not say of itself, or says wrongly. rate: names of the frame rate's option."""
    text = "what a file does not say, or says wrongly (default: worked out, and noted)"
    option = command.add_argument_group(text).add_argument
    option("--unit", type=_metres, help="of lengths: m, cm, mm, inch, ft, or metres")
    option("--up", type=_up, metavar="AXIS", help="the file's axis that points up: y, z, ... (--up=-y)")
    text = "instead: the file's axes that become x, y and z, up; as --axes=x-zy"
    option("--axes", type=_axes, metavar="XYZ", help=text)
    option(*rate, dest="fps_in", type=float, metavar="FPS", help="frames per second of the file")
    text = "of bones that change their length: refuse, or keep the mean"
    option("--translations", choices=("strict", "mean"), help=text)
    option("--asf", type=Path, metavar="FILE", help="the skeleton of an .amc (default: beside it)")
    option("--names", type=Path, metavar="FILE.json", help="what its joints are: standard name -> its own")
    option("--person", type=int, metavar="N", help="whom, of a file of several, from 0 (default: 0)")
    option("--animation", metavar="NAME", help="of a .glb: which, by name or number (default: the first)")


def reading(options: argparse.Namespace) -> dict[str, object]:
    """Returns what was given of ``add_reading``, as options of the loaders."""
    given = {name.removesuffix("_in"): getattr(options, name, None) for name in _READING}
    return {name: value for name, value in given.items() if value is not None}


def say_note(note: str) -> None:
    """Prints a note."""
    print(f"note: {note}", flush=True)


def read_motion(path: Path, options: argparse.Namespace, say: Callable[[str], None] = say_note) -> Motion:
    """Reads the motion that a command works on, and says what was guessed.

    Raises:
        DataError: not a readable motion, or an option that is for another format.
    """
    from motionlab import io

    if path.is_dir():
        raise DataError("this is a folder", path=path, remedy="name the files in it that you mean")
    motion = io.load(path, **reading(options))
    for note in motion.notes:
        say(note)
    return with_roles(motion, options)


def with_roles(motion: Motion, options: argparse.Namespace) -> Motion:
    """Takes over which joint is which, where ``--names`` says it: as the refusal of an unknown skeleton prints it,
    blanks left out."""
    from motionlab.io.reading import read_json, reading

    if not options.names:
        return motion
    with reading(options.names, 'write {"pelvis": "its name", ...}') as at:
        found = read_json(at)
        if not isinstance(found, dict) or not all(isinstance(name, str) for name in found.values()):
            raise at.error("expected one object of names")
    roles = {name: own for name, own in found.items() if own}
    return replace(motion, skeleton=replace(motion.skeleton, roles=roles))


def make_folder(path: Path) -> None:
    """Makes a folder, and those above, unless they are there.

    Raises:
        DataError: it cannot be made, or is a file.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"this folder cannot be made: {error.strerror or error}"
        raise DataError(message, path=path, remedy="name another folder") from error


def with_standard_joints(motion: Motion) -> Motion:
    """Puts a motion on the 22 standard joints in its own proportions, unless it is there; says so in its notes.

    Raises:
        DataError: a skeleton whose joints are not known.
    """
    from motionlab.retarget import retarget
    from motionlab.skeleton import STANDARD

    return motion if motion.skeleton.names == STANDARD.names else retarget(motion).motion


def _metres(text: str) -> float:
    """A unit of length by its name, or as metres per unit."""
    from motionlab.io.judging import UNITS, unit_named

    try:
        metres = unit_named(text) or float(text)
    except ValueError:
        metres = math.nan
    if not 0 < metres < math.inf:
        raise argparse.ArgumentTypeError(f"expected metres above zero or one of {', '.join(UNITS)}, got {text!r}")
    return metres


def _up(text: str) -> str:
    """An axis, with or without its sign."""
    from motionlab.io.judging import AXES

    axis = text.lower().removeprefix("+")
    if axis not in AXES:
        raise argparse.ArgumentTypeError(f"expected one of {', '.join(AXES)}, got {text!r}")
    return axis


def _axes(text: str) -> str:
    """Three axes of a right-handed world."""
    from motionlab.io.judging import axes_to_matrix

    try:
        axes_to_matrix(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text
