"""npz recordings: which of the known layouts a file has, told by its keys."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

from motionlab.io import amass, amp, anidance
from motionlab.io.positions import Positions
from motionlab.io.reading import read_bytes, reading
from motionlab.motion import Motion

#: A key that only this layout has -> its loader.
LAYOUTS: dict[str, Callable] = {
    "poses": amass.load,
    "pose_body": amass.load,
    "local_or_global_rotation_xyzw": amp.load,
    "positions_cm": anidance.load,
}


def loader(path: str | Path) -> Callable:
    """The loader whose keys the file has.

    Raises:
        DataError: not an npz archive, or none of the known keys is in it.
    """
    with reading(path, f"save one of the keys {', '.join(LAYOUTS)}") as at:
        if read_bytes(at)[:2] != b"PK":
            raise at.error("not an npz archive", remedy="save it with numpy.savez")
        with zipfile.ZipFile(at.path) as archive:
            keys = {name.removesuffix(".npy") for name in archive.namelist()}
        found = [load for key, load in LAYOUTS.items() if key in keys]
        if not found:
            raise at.error(f"no known layout; its keys are {', '.join(sorted(keys)[:20]) or 'none'}", place="keys")
        return found[0]


def load(path: str | Path, **options) -> Motion | Positions:
    """Read an AMASS, AMP or AniDance npz; options go to that loader."""
    return loader(path)(path, **options)
