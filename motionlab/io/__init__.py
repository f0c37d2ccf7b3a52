"""Files in and out: every loader gives metres, seconds, z up, and a DataError where a file is at fault."""

from __future__ import annotations

from pathlib import Path

from motionlab.errors import DataError
from motionlab.io import amp, asf, bvh, deepmimic
from motionlab.motion import Motion

#: Loader by file suffix; each takes the path and its own options.
LOADERS = {
    ".bvh": bvh.load,
    ".amc": asf.load_beside,
    ".txt": deepmimic.load,
    ".json": deepmimic.load,
    ".npz": amp.load,
}


def load(path: str | Path, **options) -> Motion:
    """Read one recording with the loader that its suffix names; options go to that loader.

    Raises:
        DataError: no loader for this suffix, or the file is at fault.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in LOADERS:
        known = ", ".join(sorted(LOADERS))
        raise DataError(f"no loader for {suffix or 'a name without suffix'!r}", path=path, remedy=f"one of {known}")
    return LOADERS[suffix](path, **options)
