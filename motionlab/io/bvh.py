"""BVH: a skeleton and its joint angles as text, in whatever unit, axes and channel order the exporter liked.

A file does not say its unit or its up axis. Both can be given; what is not given is worked out from the
recording and written into ``Motion.notes``, together with everything else that had to be decided.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.io.bvh_text import Joint, parse
from motionlab.io.reading import Spot, read_text, reading
from motionlab.io.writing import check_writable
from motionlab.motion import Motion
from motionlab.skeleton import UPRIGHT, Skeleton
from motionlab.writing import write_whole

#: Metres per unit of length.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
#: World with z up from a file's world. A figure at rest in a y-up file faces +z there and +y here.
WORLD = {"y": UPRIGHT, "z": torch.eye(3)}
#: A figure's height in metres is plausible between these; one that fits no unit is scaled to ``ASSUMED``.
PLAUSIBLE, ASSUMED = (0.5, 2.5), 1.70
#: A person's longest chain of bones, foot to hand, over the height: the size of a figure in any pose.
CHAIN = 1.4
#: Shares of the longest chain: below SAME a joint sits at its OFFSET, above RIGID its bone changes length.
SAME, RIGID = 0.002, 0.02
_REMEDY = "export the BVH again, or repair the line"


def load(
    path: str | Path, *, unit: str | float | None = None, up: str | None = None, translations: str = "strict"
) -> Motion:
    """Read a BVH file: metres, z up, the file's own skeleton and rest pose.

    Position channels replace a joint's OFFSET. A Motion translates at one joint, so the root is the
    deepest joint of the unbranched chain at the top whose position channels move (Bandai-Namco: Hips
    under a resting joint_Root); the joints above it are composed into it and noted. End Sites with a
    length become leaf joints named ``<parent>_end``; those of length zero say nothing and are dropped.

    Args:
        unit: metres per unit, or "m", "cm", "mm", "inch"; None: the one of m, cm, mm that makes the
            figure 0.5 to 2.5 m tall, else the figure is scaled to 1.70 m. Noted.
        up: "y" or "z"; None: the axis along which the figure is taller, on average over the frames. Noted.
        translations: a joint below the root that moves against its parent is kept at its mean position
            and noted; "strict" refuses if it moves more than 2 % of the longest chain, "mean" never.

    Raises:
        DataError: the file is not a readable BVH; names the file, the line and the remedy.
        ValueError: unit, up or translations is none of the above.
    """
    if unit is not None:
        _check_unit(unit)
    if up not in (None, *WORLD) or translations not in ("strict", "mean"):
        raise ValueError(f"expected up 'y' or 'z' and translations 'strict' or 'mean', got {up!r}, {translations!r}")
    with reading(path, _REMEDY) as at:
        joints, values, fps = parse(at, read_text(at))
        motion = _assemble(at, joints, values, fps, translations)
        return _to_world(at, motion, unit, up)


def _check_unit(unit: object) -> None:
    if not (unit in UNITS or (isinstance(unit, int | float) and 0 < unit < np.inf)):
        raise ValueError(f"unit: expected metres per unit or one of {', '.join(UNITS)}, got {unit!r}")


def _assemble(at: Spot, joints: list[Joint], values: np.ndarray, fps: float, translations: str) -> Motion:
    """The recording in the file's own units and axes."""
    place, rot = _local(joints, values)
    kept = [i for i, joint in enumerate(joints) if not joint.is_end or any(joint.offset)]
    row = {i: k for k, i in enumerate(kept)} | {-1: -1}
    parents = [row[joints[i].parent] for i in kept]
    skeleton, root, rot, notes = _reroot(
        at, [joints[i] for i in kept], parents, place[:, kept], rot[:, kept], translations
    )
    return Motion(skeleton, root, rot, fps, name=at.path.stem, notes=tuple(notes))


def _local(joints: list[Joint], values: np.ndarray) -> tuple[np.ndarray, Tensor]:
    """Where each joint stands (T, J, 3) and how it is turned (T, J, 3, 3) against its parent."""
    offset = np.array([joint.offset for joint in joints])
    place = np.broadcast_to(offset, (len(values), *offset.shape)).copy()
    rot = torch.eye(3, dtype=torch.float64).expand(len(values), len(joints), 3, 3).clone()
    by_order: dict[str, list[tuple[int, list[int]]]] = {}
    column = 0
    for i, joint in enumerate(joints):
        turns = []
        for channel in joint.channels:
            if channel.endswith("position"):
                place[:, i, "xyz".index(channel[0])] = values[:, column]
            else:
                turns.append(column)
            column += 1
        order = "".join(channel[0].upper() for channel in joint.channels if channel.endswith("rotation"))
        by_order.setdefault(order, []).append((i, turns))
    for order, rows in by_order.items():
        which, columns = zip(*rows, strict=True)
        if order:
            angles = torch.from_numpy(np.deg2rad(values[:, np.array(columns)]))
            rot[:, list(which)] = rotation.euler_to_matrix(angles, order)
    return place, rot


def _reroot(at: Spot, joints: list[Joint], parents: list[int], place: np.ndarray, rot: Tensor, translations: str):
    """Skeleton, root positions, rotations and notes, with the root at the joint that moves."""
    notes = []
    offset = torch.tensor([joint.offset for joint in joints], dtype=torch.float64)
    reach = _longest_chain(Skeleton(tuple(joint.name for joint in joints), tuple(parents), offset)) or 1e-12
    offset = offset.numpy()
    strays = np.abs(place - offset).max((0, 2)) > SAME * reach
    top, chain, children = 0, [0], Counter(parents)
    while children[chain[-1]] == 1:
        chain.append(parents.index(chain[-1]))
        top = chain[-1] if strays[chain[-1]] else top
    above = chain[: chain.index(top)]
    root, first = torch.from_numpy(place[:, top]), rot[:, top]
    for joint in reversed(above):
        root = torch.from_numpy(place[:, joint]) + (rot[:, joint] @ root[..., None])[..., 0]
        first = rot[:, joint] @ first
    if above:
        names = ", ".join(joints[j].name for j in above)
        notes.append(f"root is {joints[top].name}, whose position channels move; {names} composed into it")
    kept = [j for j in range(len(joints)) if j not in set(above)]
    mean = place.mean(0)
    for j in kept[1:]:
        moves = np.abs(place[:, j] - mean[j]).max()
        if moves > SAME * reach:
            what = f"{joints[j].name} moves {moves / reach:.1%} of the figure against its parent"
            if translations == "strict" and moves > RIGID * reach:
                line = f"line {joints[j].line}"
                raise at.error(f"{what}: bones of changing length", place=line, remedy='translations="mean"')
            notes.append(f"{what}: mean kept")
        elif strays[j]:
            off = np.abs(mean[j] - offset[j]).max() / reach
            notes.append(f"{joints[j].name} rests {off:.1%} of the figure off its OFFSET")
    rot = rot[:, kept].clone()
    rot[:, 0] = first
    offsets = torch.from_numpy(np.where(strays[:, None], mean, offset)[kept])
    offsets[0] = 0
    order = {j: i for i, j in enumerate(kept)}
    tree = tuple(order.get(parents[j], -1) for j in kept)
    return Skeleton(tuple(joints[j].name for j in kept), tree, offsets), root, rot, notes


def _to_world(at: Spot, motion: Motion, unit: str | float | None, up: str | None) -> Motion:
    """Metres and z up; says in the notes what was guessed, and on what grounds."""
    notes = list(motion.notes)
    size = _longest_chain(motion.skeleton) / CHAIN
    if not size > 0:
        raise at.error("every joint is at one point: there is no figure")
    if up is None:
        points = motion.cut(step=max(motion.frames // 20, 1)).positions
        _, y, z = (points.amax(1) - points.amin(1)).mean(0).tolist()
        up = "z" if z > 1.2 * y else "y"
        sure = "" if max(y, z) > 1.2 * min(y, z) else ", too close to tell: pass up="
        notes.append(f"up axis {up} detected: the figure extends {y:.3g} units along y, {z:.3g} along z{sure}")
    if unit is None:
        fits = [name for name in ("m", "cm", "mm") if PLAUSIBLE[0] <= size * UNITS[name] <= PLAUSIBLE[1]]
        unit = UNITS[fits[0]] if fits else ASSUMED / size
        guess = f"no unit fits: scaled to {ASSUMED:.2f} m, lengths are relative; pass unit="
        meaning = f"taken as {fits[0]}" if fits else guess
        notes.append(f"unit detected: the figure is about {size:.3g} units tall, {meaning}")
    scale = UNITS[unit] if isinstance(unit, str) else float(unit)
    world = WORLD[up].to(motion.root)
    rot = motion.rot.clone()
    rot[:, 0] = world @ rot[:, 0]
    skeleton = replace(motion.skeleton, offsets=motion.skeleton.offsets * scale)
    moved = replace(motion, skeleton=skeleton, root=scale * motion.root @ world.T, rot=rot, notes=tuple(notes))
    return moved.to(torch.float32)


def _longest_chain(skeleton: Skeleton) -> float:
    """Length of the longest chain of bones between any two joints."""
    down, longest = [0.0] * len(skeleton), 0.0
    for j in range(len(skeleton) - 1, 0, -1):
        parent, reach = skeleton.parents[j], down[j] + float(skeleton.offsets[j].norm())
        longest = max(longest, down[parent] + reach)
        down[parent] = max(down[parent], reach)
    return longest


def save(path: str | Path, motion: Motion, *, order: str = "ZXY", unit: str | float = "cm", up: str = "y") -> None:
    """Write one motion as BVH, six channels at the root and three at every other joint.

    Numbers have six decimals (1e-8 m in cm, 1e-6 degrees), the frame time ten. Joints are written depth
    first, as BVH demands, and come back in that order: match them by name. Leaf joints named
    ``<parent>_end`` that never turn become End Sites. The file appears whole or not at all.

    Args:
        order: of the three rotation channels, applied left to right (intrinsic).
        unit, up: as in :func:`load`; a rest pose that faces +z in the rest frame faces +z in a y-up file.

    Raises:
        ShapeError: the motion has batch axes or no frames.
        DataError: it holds NaN or infinity, or the file cannot be written.
        ValueError: order, unit or up is none of the known ones.
    """
    check_writable(path, motion)
    _check_unit(unit)
    if sorted(order) != ["X", "Y", "Z"] or up not in WORLD:
        raise ValueError(f"expected an order of X, Y, Z and up 'y' or 'z', got {order!r} and {up!r}")
    scale = 1 / (UNITS[unit] if isinstance(unit, str) else float(unit))
    motion = motion.to(torch.float64)
    skeleton, names, world = motion.skeleton, motion.skeleton.names, WORLD[up].double()
    rest = (motion.rot - torch.eye(3).double()).abs().amax((0, 2, 3)) < 1e-6
    ends = {
        j
        for j in range(1, len(names))
        if j not in skeleton.parents and names[j] == f"{names[skeleton.parents[j]]}_end" and rest[j]
    }
    rot = motion.rot.clone()
    rot[:, 0] = world.T @ rot[:, 0]
    text, turning = _hierarchy_text(skeleton, scale, order, ends)
    angles = torch.rad2deg(rotation.matrix_to_euler(rot[:, turning], order))
    table = torch.cat((scale * motion.root @ world, angles.flatten(1)), dim=1).numpy()
    row = " ".join(["%.6f"] * table.shape[1])
    head = ["HIERARCHY", *text, "MOTION", f"Frames: {len(table)}", f"Frame Time: {1 / motion.fps:.10f}"]
    write_whole(path, "\n".join([*head, *(row % tuple(values) for values in table.tolist()), ""]))


def _hierarchy_text(skeleton: Skeleton, scale: float, order: str, ends: set[int]) -> tuple[list[str], list[int]]:
    """The joints depth first, and their indices in the order of their channels."""
    offsets = (skeleton.offsets * scale).tolist()
    offsets[0] = [0.0, 0.0, 0.0]
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(skeleton.parents):
        children.setdefault(parent, []).append(joint)
    turns = " ".join(f"{axis}rotation" for axis in order)
    text: list[str] = []
    turning: list[int] = []
    stack = [(0, "")]
    while stack:
        joint, pad = stack.pop()
        if joint < 0:
            text.append(f"{pad}}}")
            continue
        kind = "End Site" if joint in ends else f"{'JOINT' if joint else 'ROOT'} {skeleton.names[joint]}"
        text += [f"{pad}{kind}", f"{pad}{{", f"{pad}\tOFFSET " + " ".join(f"{x:.6f}" for x in offsets[joint])]
        stack.append((-1, pad))
        if joint in ends:
            continue
        turning.append(joint)
        text.append(f"{pad}\tCHANNELS {'3' if joint else '6 Xposition Yposition Zposition'} {turns}")
        stack += [(child, pad + "\t") for child in reversed(children.get(joint, []))]
        if joint not in children:
            text += [f"{pad}\t{line}" for line in ("End Site", "{", "\tOFFSET 0.000000 0.000000 0.000000", "}")]
    return text, turning
