"""What the commands on motion files share: formats, ``--unit`` and ``--up`` of a BVH, and the 22 standard joints."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from motionlab.errors import DataError

if TYPE_CHECKING:
    from motionlab.motion import Motion

WRITTEN = (".bvh", ".npz", ".glb")
READ = f"{' '.join(WRITTEN)} .amc, or DeepMimic's .txt"


def add_axes(command: argparse.ArgumentParser) -> None:
    """Adds what a BVH does not say of itself."""
    command.add_argument("--unit", type=_metres, help="of a .bvh: m, cm, mm, inch or metres (default: detected)")
    command.add_argument(
        "--names", type=Path, metavar="FILE.json", help="what its joints are: standard name -> its own"
    )
    command.add_argument("--up", choices=("y", "z"), help="of a .bvh: the axis that points up (default: detected)")


def read_motion(path: Path, options: argparse.Namespace) -> Motion:
    """Reads the motion that a command works on.

    Raises:
        DataError: not a readable motion, or an option that is for another format.
    """
    from motionlab import io

    if path.is_dir():
        raise DataError("this is a folder", path=path, remedy="name the files in it that you mean")
    guided = {key: value for key in ("unit", "up") if (value := getattr(options, key)) is not None}
    if guided and path.suffix.lower() != ".bvh":
        raise DataError("its unit and axes are known", path=path, remedy="--unit and --up are for .bvh only")
    motion = io.load(path, **guided)
    return replace(motion, skeleton=replace(motion.skeleton, roles=_roles(options.names))) if options.names else motion


def _roles(path: Path) -> dict[str, str]:
    """Reads which joint is which, as the refusal of an unknown skeleton prints it: blanks are left out."""
    from motionlab.io.reading import read_json, reading

    with reading(path, 'write {"pelvis": "its name", ...}') as at:
        found = read_json(at)
        if not isinstance(found, dict) or not all(isinstance(name, str) for name in found.values()):
            raise at.error("expected one object of names")
    return {name: own for name, own in found.items() if own}


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
    from motionlab.io.bvh import UNITS

    try:
        metres = UNITS.get(text) or float(text)
    except ValueError:
        metres = math.nan
    if not 0 < metres < math.inf:
        raise argparse.ArgumentTypeError(f"expected metres above zero or one of {', '.join(UNITS)}, got {text!r}")
    return metres
