"""Files in and out: every loader gives metres, seconds, z up, and a DataError where a file is at fault."""

from __future__ import annotations

from pathlib import Path

from motionlab.errors import DataError
from motionlab.io import asf, bvh, deepmimic, npz
from motionlab.motion import Motion

#: Loader by file suffix; each takes the path and its own options.
LOADERS = {
    ".bvh": bvh.load,
    ".amc": asf.load_beside,
    ".txt": deepmimic.load,
    ".json": deepmimic.load,
    ".npz": npz.load,
}


def load(path: str | Path, **options) -> Motion:
    """Read one recording with the loader that its suffix names; options go to that loader.

    Raises:
        DataError: no loader for this suffix, the file is at fault, or it holds positions and no rotations.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in LOADERS:
        known = ", ".join(sorted(LOADERS))
        raise DataError(f"no loader for {suffix or 'a name without suffix'!r}", path=path, remedy=f"one of {known}")
    motion = LOADERS[suffix](path, **options)
    if not isinstance(motion, Motion):
        raise DataError("holds positions without rotations", path=path, remedy="read it with io.npz.load")
    return motion
