"""Files in and out: every loader gives metres, seconds, z up, and a DataError where a file is at fault."""

from __future__ import annotations

from pathlib import Path

from motionlab.errors import DataError
from motionlab.io import asf, bvh, c3d, deepmimic, gltf, npz, trc
from motionlab.motion import Motion

#: Loader by file suffix; each takes the path and its own options.
LOADERS = {
    ".bvh": bvh.load,
    ".amc": asf.load_beside,
    ".txt": deepmimic.load,
    ".json": deepmimic.load,
    ".npz": npz.load,
    ".glb": gltf.load,
    ".trc": trc.load,
    ".c3d": c3d.load,
}
_NOT_ONE_FILE = {
    ".asf": "name the .amc: the .asf is found beside it",
    "": "a folder of OpenPose frames is read with motionlab.io.openpose.load",
}


def load(path: str | Path, **options) -> Motion:
    """Read one recording with the loader that its suffix names; options go to that loader.

    Raises:
        DataError: no loader for this suffix, the file is at fault, or it holds positions and no rotations.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in LOADERS:
        remedy = _NOT_ONE_FILE.get(suffix, f"one of {', '.join(sorted(LOADERS))}")
        raise DataError(f"no loader for {suffix or 'a name without suffix'!r}", path=path, remedy=remedy)
    motion = LOADERS[suffix](path, **options)
    if not isinstance(motion, Motion):
        remedy = f"for its positions use motionlab.io.{suffix[1:]}.load"
        raise DataError("holds positions without rotations", path=path, remedy=remedy)
    return motion
