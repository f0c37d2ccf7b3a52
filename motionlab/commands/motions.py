"""What the commands on motion files share: the formats that are written, and ``--unit`` and ``--up`` of a BVH."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from motionlab.errors import DataError

if TYPE_CHECKING:
    from motionlab.motion import Motion

WRITTEN = (".bvh", ".npz", ".glb")


def add_axes(command: argparse.ArgumentParser) -> None:
    """Adds what a BVH does not say of itself."""
    command.add_argument("--unit", type=_metres, help="of a .bvh: m, cm, mm, inch or metres (default: detected)")
    command.add_argument("--up", choices=("y", "z"), help="of a .bvh: the axis that points up (default: detected)")


def read_motion(path: Path, options: argparse.Namespace) -> Motion:
    """Reads the motion that a command works on.

    Raises:
        DataError: not a readable motion, or an option that is for another format.
    """
    from motionlab import io

    guided = {key: value for key in ("unit", "up") if (value := getattr(options, key)) is not None}
    if guided and path.suffix.lower() != ".bvh":
        raise DataError("its unit and axes are known", path=path, remedy="--unit and --up are for .bvh only")
    return io.load(path, **guided)


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
