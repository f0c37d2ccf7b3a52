"""Reads and writes recordings: loaders give metres, seconds, z up, and raise a DataError where a file is at fault."""

import inspect
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from motionlab import humanml
from motionlab.errors import DataError
from motionlab.io import asf, bvh, clips, gltf, judging, points, smpl
from motionlab.io.judging import Axes, Fps, Unit
from motionlab.io.pickles import first_object
from motionlab.io.reading import checked_array, frame_rate, read_bytes, read_npy, reading
from motionlab.motion import Motion
from motionlab.rest import looks_ahead

#: A key that only this layout has -> its loader.
NPZ_LAYOUTS: dict[str, Callable] = {
    **dict.fromkeys((*smpl.POSES, *smpl.PARTS), smpl.load_motion),
    "local_or_global_rotation_xyzw": clips.load_amp,
}


def load_npz(path: str | Path, **options) -> Motion:
    """Reads an AMASS or AMP npz; options go to that loader."""
    return _loader(load_npz, path)(path, **options)


def _loader(loader: Callable, path: str | Path) -> Callable:
    """The loader itself; of an npz that whose keys the file has."""
    if loader is not load_npz:
        return loader
    with reading(path, f"save one of the keys {', '.join(NPZ_LAYOUTS)}") as at, zipfile.ZipFile(at.path) as archive:
        keys = {name.removesuffix(".npy") for name in archive.namelist()}
        found = [load for key, load in NPZ_LAYOUTS.items() if key in keys]
        if not found:
            raise at.error(f"no known layout; its keys are {', '.join(sorted(keys)[:20]) or 'none'}", place="keys")
        return found[0]


def load_npy(
    path: str | Path, *, person: int = 0, unit: Unit = None, up: Axes = None, axes: Axes = None, fps: Fps = None
) -> Motion:
    """Reads a .npy: HumanML3D's joints (T, 22, 3) or 263 numbers a frame, at 20 frames per second and y up unless they
    or the caller tell otherwise; of one that holds an object, see :func:`motionlab.io.smpl.load_motion`.

    Raises:
        DataError: it holds anything else.
    """
    with reading(path, "save joints (T, 22, 3) or HumanML3D's features (T, 263) with numpy.save") as at:
        array = read_npy(at, read_bytes(at), first_object)
        if not isinstance(array, np.ndarray):
            return smpl.load_motion(path, person=person, up=up, axes=axes, fps=fps)
        shape = f"T {humanml.SIZE}" if array.shape[1:] == (humanml.SIZE,) else f"T {humanml.JOINTS} 3"
        joints = torch.from_numpy(checked_array(at, array, shape, "array", 1e6))
        if joints.ndim == 2:
            if not -0.5 < joints[:, -4:].min() <= joints[:, -4:].max() < 1.5:  # feet that stand
                raise at.error("numbers that are normalised", place="array", remedy="multiply by std, and add mean")
            joints = humanml.joints_of(joints)
        rate = humanml.FPS if fps is None else frame_rate(at, fps, "fps")
        motion = humanml.motion_of(joints, rate, at.path.stem)
        if not looks_ahead(motion, {name: j for j, name in enumerate(motion.skeleton.names)}):
            note = "knees and toes point backwards, as of a left-handed file: if so, negate its x (array[..., 0] *= -1)"
            motion = replace(motion, notes=(*motion.notes, note))
        return judging.to_world(at, motion, unit=unit, up=up, axes=axes, says_unit=1.0, says_up="y", trust=0.5)


#: Loader by file suffix; each takes the path and its own options.
LOADERS = {
    ".bvh": bvh.load,
    ".amc": asf.load_beside,
    ".txt": clips.load_deepmimic,
    ".json": clips.load_deepmimic,
    ".npz": load_npz,
    ".pt": smpl.load_motion,
    ".pkl": smpl.load_motion,
    ".npy": load_npy,
    ".glb": gltf.load,
    ".gltf": gltf.load,
    ".trc": points.load_trc,
    ".c3d": points.load_c3d,
}
_NOT_ONE_FILE = {
    ".fbx": "in Blender: import FBX, export BVH",
    ".blend": "in Blender: export BVH",
    ".asf": "name the .amc: the .asf is found beside it",
    ".bin": "the numbers of a .gltf, which reads them",
    ".npz": "its keys are of no motion that is read",
    "": "a folder of OpenPose frames is read with motionlab.io.keypoints.load_person",
    **dict.fromkeys((".json", ".txt"), "neither frames of OpenPose nor of DeepMimic"),
}


def why_not(suffix: str) -> str:
    """Says what to do about a file that no loader reads, by its suffix."""
    return _NOT_ONE_FILE.get(suffix, f"one of {', '.join(sorted(LOADERS))}")


def guided(loader: Callable, path: str | Path, options: dict[str, object], *, strict: bool = False) -> object:
    """Reads a recording with a loader and those of the options (``unit``, ``up``, ...) that it takes.

    Raises:
        DataError: the file is at fault, or (strict) an option is not for its format.
    """
    loader = _loader(loader, path)
    known = inspect.signature(loader).parameters
    if strict and (surplus := [name for name in options if name not in known]):
        words = ", ".join(f"--{name.replace('fps', 'fps-in')}" for name in surplus)
        raise DataError("the file says this of itself", path=path, place=words, remedy=f"leave out {words}")
    return loader(path, **{name: value for name, value in options.items() if name in known})


def load(path: str | Path, **options) -> Motion:
    """Reads one recording with the loader that its suffix names; options go to that loader.

    Raises:
        DataError: no loader for this suffix, the file is at fault, it holds positions and no rotations, or its loader
            has no such option.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in LOADERS:
        raise DataError(f"no loader for {suffix or 'a name without suffix'!r}", path=path, remedy=why_not(suffix))
    motion = guided(LOADERS[suffix], path, options, strict=True)
    if not isinstance(motion, Motion):
        remedy = f"solve a skeleton where it was recorded, and export BVH; points.{LOADERS[suffix].__name__} reads it"
        raise DataError("holds positions without rotations", path=path, remedy=remedy)
    return motion
