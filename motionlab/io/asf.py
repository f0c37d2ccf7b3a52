"""ASF/AMC, the files of the CMU motion capture database: a skeleton and the joint angles of one take."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError
from motionlab.io.judging import UNITS, Fps, Unit
from motionlab.io.reading import Location, floats, frame_rate, read_text, reading, text_lines
from motionlab.motion import Motion
from motionlab.skeleton import UPRIGHT, Skeleton

_CMU_FPS = 120.0  # of CMU's recordings; the files do not say so


@dataclass
class _Bone:
    """One bone as the file gives it: unit direction, length in file units, axis frame, degrees of freedom, the bones
    at its end; of the root also where it stands."""

    direction: Sequence[float] = (0.0, 0.0, 0.0)
    length: float = 0.0
    axis: Sequence[float] = (0.0, 0.0, 0.0)
    axis_order: str = "XYZ"
    dof: Sequence[str] = ()
    position: Sequence[float] = (0.0, 0.0, 0.0)
    children: list[str] = field(default_factory=list)


def load(asf: str | Path, amc: str | Path, *, fps: Fps = None, unit: float | None = None) -> Motion:
    """Reads a skeleton and one take: metres, z up, the skeleton of the ASF.

    A joint carries the name of the bone that starts there; where a bone has no child its far end is a
    leaf joint ``<bone>_end``. With C the bone's axis and M the turn by its degrees of freedom, both
    applied in the order written about fixed axes, the rotation against the parent is C M C^T: bones and
    their offsets are given in the world's axes of the rest pose (x left, y up, z forward).

    fps: frames per second; None: 120, CMU's rate, which is noted. unit: metres per unit of length; None: 1 / ``length``
    inches, CMU's convention (1/0.45 inch), noted.

    Source: Acclaim ASF/AMC format, as used by mocap.cs.cmu.edu.
    Raises:
        DataError: either file is at fault; names the file, the line and the remedy.
    """
    notes = []
    with reading(asf, "take the .asf of the subject again") as at:
        bones, length, asf_degrees = _parse_asf(at, read_text(at))
        if unit is None:
            unit = UNITS["inch"] / length
            notes.append(f"the file names no unit: taken as 1/{length:g} inch = {unit:.5f} m, as CMU does")
        skeleton = _skeleton(at, bones, unit)
    with reading(amc, "take the .amc of the take again, with the .asf of the same subject") as at:
        degrees, frames = _parse_amc(at, read_text(at), bones, asf_degrees)
        if fps is None:
            fps = _CMU_FPS
            notes.append(f"the file names no frame rate: taken as {fps:g}, as CMU does")
        fps = frame_rate(at, fps, "fps argument")
        upright, own = UPRIGHT.double(), bones["root"]
        rot = torch.eye(3, dtype=torch.float64).expand(len(frames["root"]), len(skeleton), 3, 3).clone()
        for name, values in frames.items():
            rot[:, skeleton.index(name)] = _turn(bones[name], values, degrees, asf_degrees)
        moved = torch.from_numpy(frames["root"][:, [own.dof.index(f"t{axis}") for axis in "xyz"]])
        root = (moved + torch.tensor(own.position, dtype=torch.float64)) * unit @ upright.T
        rot[:, 0] = upright @ rot[:, 0]
        return Motion(skeleton, root.float(), rot.float(), fps, name=at.path.stem, notes=tuple(notes))


def load_beside(amc: str | Path, *, asf: str | Path | None = None, fps: Fps = None, unit: Unit = None) -> Motion:
    """Reads an .amc with the .asf beside it whose name its own begins with, the longest: 02.asf for 02_01.amc, and
    HDM_bd.asf for HDM_bd_walk.amc.

    Raises:
        DataError: see ``load``; or there is no such .asf.
    """
    amc = Path(amc)
    if asf is None and amc.is_file():
        names = [path for path in amc.parent.iterdir() if path.suffix.lower() == ".asf"]
        fits = [path for path in names if amc.stem.lower().startswith(path.stem.lower())]
        if not fits:
            what, path = "no skeleton file that is called as the .amc begins", f"{amc.stem.split('_')[0]}.asf"
            remedy = "put the subject's .asf beside it, or name it with asf=, or --asf"
            raise DataError(what, path=amc.with_name(path), remedy=remedy, place=amc.name)
        asf = max(fits, key=lambda path: len(path.stem))
    return load(asf or amc.with_suffix(".asf"), amc, fps=fps, unit=UNITS.get(unit, unit))


def _turn(bone: _Bone, values: np.ndarray, degrees: bool, axis_degrees: bool) -> Tensor:
    """C M C^T (T, 3, 3); turns about fixed axes in the order written are intrinsic ones in reverse."""
    turning = [k for k, dof in enumerate(bone.dof) if dof[0] == "r"][::-1]
    angles = torch.from_numpy(values[:, turning] * (np.pi / 180 if degrees else 1.0))
    turn = rotation.euler_to_matrix(angles, "".join(bone.dof[k][1] for k in turning).upper())
    axis = torch.tensor(bone.axis, dtype=torch.float64).flip(0)
    frame = rotation.euler_to_matrix(torch.deg2rad(axis) if axis_degrees else axis, bone.axis_order[::-1])
    return frame @ turn @ frame.mT


def _skeleton(at: Location, bones: dict[str, _Bone], unit: float) -> Skeleton:
    names, parents, offsets = ["root"], [-1], [[0.0, 0.0, 0.0]]
    stack = [(child, "root") for child in reversed(bones["root"].children)]
    while stack:
        name, parent = stack.pop()
        above = bones[parent]
        parents.append(names.index(parent))
        names.append(name)
        offsets.append([unit * above.length * x for x in above.direction])
        if name in bones:
            children = bones[name].children or [f"{name}_end"] * (bones[name].length > 0 and f"{name}_end" not in bones)
            stack += [(child, name) for child in reversed(children)]
    if lost := [name for name in bones if name not in names]:
        raise at.error(f"{', '.join(lost)} hang on nothing", place="section :hierarchy")
    return Skeleton(tuple(names), tuple(parents), torch.tensor(offsets))


def _parse_asf(at: Location, text: str) -> tuple[dict[str, _Bone], float, bool]:
    """The bones by name, "root" first, the unit of length, and whether angles are degrees."""
    sections: dict[str, list[tuple[str, str, list[str]]]] = {}  # of lines: their place, first word, and others
    lines = []
    for key, *words in map(str.split, text_lines(at, re.sub("#.*", "", text))):
        if key[0] == ":":
            lines, (key, *words) = sections.setdefault(key[1:].lower(), []), words or [""]
        lines += [(at.place, key, words)] if key else []
    if missing := [key for key in ("units", "root", "bonedata", "hierarchy") if not sections.get(key)]:
        raise at.error(f"no section :{', :'.join(missing)}: truncated, or no ASF")
    bones, bone, name = {"root": _Bone(dof=["tx", "ty", "tz", "rx", "ry", "rz"])}, None, ""
    for at.place, key, words in sections["root"]:
        _tell(at, bones["root"], key, words)
    for at.place, key, words in sections["bonedata"]:
        if (key == "begin") != (bone is None):
            raise at.error(f"expected begin, got {key!r}" if bone is None else f"bone {name} has no end")
        if key == "begin":
            bone, name = _Bone(), ""
        elif key == "end":
            if not name or name in bones:
                raise at.error(f"a second bone named {name!r}" if name else "a bone without a name")
            bones[name], bone = bone, None
        elif key == "name":
            name = " ".join(words)
        else:
            _tell(at, bone, key, words)
    if bone is not None:
        raise at.error(f"bone {name} has no end: the file is truncated")
    placed = {"root"}
    for at.place, parent, below in sections["hierarchy"]:
        if parent in ("begin", "end"):
            continue
        for name in (parent, *below):
            if name not in bones:
                raise at.error(f"bone {name!r} is not in :bonedata")
        for name in below:
            if name in placed:
                raise at.error(f"{name} has two parents")
            placed.add(name)
            bones[parent].children.append(name)
    at.place = "section :units"
    units = {key.lower(): words for _, key, words in sections["units"]}
    (length,) = floats(at, units.get("length", []), 1)
    if not 1e-6 < length < 1e6 or units.get("angle") not in (["deg"], ["rad"]):
        raise at.error("expected 'length' above zero (1e-6 to 1e6) and 'angle deg' or 'angle rad'")
    at.place = ""
    return bones, length, units["angle"] == ["deg"]


def _tell(at: Location, bone: _Bone, key: str, words: list[str]) -> None:
    """Takes what a line says of a bone or of the root, which moves and has the numbers of its axis elsewhere."""
    if key in ("direction", "position", "orientation"):
        setattr(bone, "axis" if key == "orientation" else key, floats(at, words, 3))
    elif key == "length":
        (bone.length,) = floats(at, words, 1)
    elif key == "axis":
        if "tx" not in bone.dof:
            bone.axis, words = floats(at, words[:3], 3), words[3:]
        bone.axis_order = "".join(words).upper()
        if sorted(bone.axis_order) != ["X", "Y", "Z"]:
            raise at.error(f"axis order must be X, Y and Z in some order, got {' '.join(words)!r}")
    elif key in ("dof", "order"):
        free = [f"{kind}{axis}" for kind in ("tr" if key == "order" else "r") for axis in "xyz"]
        bone.dof = [word.lower() for word in words]
        if len({*free} & {*bone.dof}) != len(bone.dof) or (key == "order" and len(bone.dof) < len(free)):
            raise at.error(f"degrees of freedom must be of {' '.join(free)}, each once, got {' '.join(words)}")


def _parse_amc(at: Location, text: str, bones: dict[str, _Bone], degrees: bool) -> tuple[bool, dict[str, np.ndarray]]:
    """Whether angles are degrees, and the values (T, D) of every bone that has degrees of freedom."""
    values: dict[str, list] = {name: [] for name, bone in bones.items() if bone.dof}
    frames = 0
    for name, *words in map(str.split, text_lines(at, text)):
        if name[0] == ":":
            degrees = {":DEGREES": True, ":RADIANS": False}.get(name.upper(), degrees)
        elif not words and name.isdigit():
            if int(name) != frames + 1:
                raise at.error(f"frame {name} follows frame {frames}")
            frames += 1
        elif name[0] != "#":
            if not frames or name not in values:
                raise at.error(f"expected {'a bone that turns' if frames else 'frame number 1'}, got {name[:40]!r}")
            if len(values[name]) != frames - 1:
                raise at.error(f"{name} twice in one frame, or not in the one before")
            values[name].append(floats(at, words, len(bones[name].dof)))
    if missing := [name for name, rows in values.items() if len(rows) < max(frames, 1)]:
        raise at.error(f"frame {max(frames, 1)} without {', '.join(missing)}: truncated, or no AMC")
    return degrees, {name: np.array(rows) for name, rows in values.items()}
