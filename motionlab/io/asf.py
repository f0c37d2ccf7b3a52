"""ASF/AMC, the files of the CMU motion capture database: a skeleton and the joint angles of one take."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.io.asf_text import Asf, parse_amc, parse_asf
from motionlab.io.reading import frame_rate, read_text, reading
from motionlab.motion import Motion
from motionlab.skeleton import UPRIGHT, Skeleton

#: CMU's recordings are at 120 frames per second; the files do not say so.
CMU_FPS = 120.0
INCH = 0.0254


def load(asf: str | Path, amc: str | Path, *, fps: float | None = None, unit: float | None = None) -> Motion:
    """Read a skeleton and one take: metres, z up, the skeleton of the ASF.

    A joint carries the name of the bone that starts there; where a bone has no child its far end is a
    leaf joint ``<bone>_end``. With C the bone's axis and M the turn by its degrees of freedom, both
    applied in the order written about fixed axes, the rotation against the parent is C M C^T: bones and
    their offsets are given in the world's axes of the rest pose (x left, y up, z forward).

    Args:
        fps: frames per second; None: 120, CMU's rate, which is noted.
        unit: metres per unit of length; None: 1 / ``length`` inches, CMU's convention (1/0.45 inch), noted.

    Source: Acclaim ASF/AMC format, as used by mocap.cs.cmu.edu.
    Raises:
        DataError: either file is at fault; names the file, the line and the remedy.
    """
    notes = []
    with reading(asf, "take the .asf of the subject again") as at:
        figure = parse_asf(at, read_text(at))
        if unit is None:
            unit = INCH / figure.length
            notes.append(f"unit not in the file: 1/{figure.length:g} inch = {unit:.5f} m, CMU's convention")
        skeleton = _skeleton(figure, unit)
    with reading(amc, "take the .amc of the take again, with the .asf of the same subject") as at:
        degrees, table = parse_amc(at, read_text(at), figure)
        if fps is None:
            fps = CMU_FPS
            notes.append(f"frame rate not in the file: {fps:g}, CMU's")
        fps = frame_rate(at, fps, "fps argument")
        to_radians = np.pi / 180 if degrees else 1.0
        rot = torch.eye(3, dtype=torch.float64).expand(len(table), len(skeleton), 3, 3).clone()
        column = len(figure.bones["root"].dof)
        for name in list(figure.bones)[1:]:
            dof = figure.bones[name].dof
            angles = torch.from_numpy(table[:, column : column + len(dof)] * to_radians)
            rot[:, skeleton.index(name)] = _turn(figure, name, angles, dof)
            column += len(dof)
        first, axes = table[:, : len(figure.bones["root"].dof)], figure.bones["root"].dof
        moves = [axes.index(f"t{axis}") for axis in "xyz"]
        turns = [i for i, axis in enumerate(axes) if axis[0] == "r"]
        rot[:, 0] = _turn(figure, "root", torch.from_numpy(first[:, turns] * to_radians), [axes[i] for i in turns])
        world = UPRIGHT.double()
        root = (torch.from_numpy(first[:, moves]) + torch.tensor(figure.position, dtype=torch.float64)) * unit @ world.T
        rot[:, 0] = world @ rot[:, 0]
        return Motion(skeleton, root.float(), rot.float(), fps, name=at.path.stem, notes=tuple(notes))


def load_beside(amc: str | Path, *, asf: str | Path | None = None, **options) -> Motion:
    """:func:`load` with the .asf found beside the .amc, as CMU names them: 02.asf for 02_01.amc."""
    amc = Path(amc)
    return load(asf or amc.with_name(f"{amc.stem.split('_')[0]}.asf"), amc, **options)


def _turn(figure: Asf, name: str, angles: Tensor, dof: list[str]) -> Tensor:
    """C M C^T (T, 3, 3); turns about fixed axes in the order written are intrinsic ones in reverse."""
    bone = figure.bones[name]
    order = "".join(axis[1] for axis in dof).upper()
    turn = rotation.euler_to_matrix(angles.flip(-1), order[::-1])
    axis = torch.deg2rad(torch.tensor(bone.axis, dtype=torch.float64)) if figure.degrees else torch.tensor(bone.axis)
    frame = rotation.euler_to_matrix(axis.double().flip(-1), bone.axis_order[::-1])
    return frame @ turn @ frame.mT


def _skeleton(figure: Asf, unit: float) -> Skeleton:
    names, parents, offsets = ["root"], [-1], [[0.0, 0.0, 0.0]]
    stack = [(child, "root") for child in reversed(figure.children.get("root", []))]
    while stack:
        name, parent = stack.pop()
        above = figure.bones[parent]
        parents.append(names.index(parent))
        names.append(name)
        offsets.append([unit * above.length * x for x in above.direction])
        bone = figure.bones.get(name)
        children = figure.children.get(name, [])
        if bone is not None and not children and bone.length > 0:
            children = [f"{name}_end"]
        stack += [(child, name) for child in reversed(children)]
    return Skeleton(tuple(names), tuple(parents), torch.tensor(offsets))
