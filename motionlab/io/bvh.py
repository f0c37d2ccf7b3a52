"""BVH: a skeleton and its joint angles as text, in whatever unit, axes and channel order the exporter liked.

A file does not say its unit or its up axis. Both can be given; what is not given is worked out from the
recording and written into ``Motion.notes``, together with everything else that had to be decided.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.files import write_whole
from motionlab.io import judging
from motionlab.io.judging import AXES, Axes, Fps, Unit, rerooted
from motionlab.io.reading import RATES, Location, floats, frame_rate, read_text, reading, text_lines
from motionlab.motion import Motion, single
from motionlab.rigs import ancestors
from motionlab.skeleton import Skeleton

#: The End Site of a joint that has no child: so much of its bone's length, along the bone's longest axis. BVH has no
#: other way to say how long a hand is, and Blender makes bones of no length as long as it likes. The golden section,
#: six digits of it: no measured or designed End Site is just that, so that ours are known again.
TIP = 0.618034
_CHANNELS = [f"{axis}{kind}" for axis in "xyz" for kind in ("position", "rotation")]


def load(
    path: str | Path, *, unit: Unit = None, up: Axes = None, axes: Axes = None, fps: Fps = None,
    translations: str = "strict",
) -> Motion:  # fmt: skip
    """Reads a BVH file: metres, z up, the file's own skeleton and rest pose.

    Position channels replace a joint's OFFSET; where they are about zero in the joints below the root, they are
    relative to it, and noted. Which joint is the root: see :func:`motionlab.io.judging.rerooted` (Bandai-Namco: Hips
    under a resting joint_Root). End Sites with a length become leaf joints named ``<parent>_end``; those of no length,
    and those that :func:`save` made up (see ``TIP``), say nothing and are dropped.

    Args:
        unit, up, axes: see :func:`motionlab.io.judging.to_world`. Without a unit the one that makes a person of 1.2 to
            2.2 m, else the one of m, cm, mm that makes a figure of 0.5 to 2.5 m, else it is scaled to 1.70 m. Without
            up where the legs of the zero pose point from, and the head is above the feet. Noted.
        fps: frames per second; None: by the frame time. More than 2 s a frame is taken as milliseconds, and noted.
        translations: "strict" or "mean", of joints below the root that move: see ``rerooted``.

    Raises:
        DataError: the file is not a readable BVH, or what is given none of the above; names file, line and remedy.
    """
    with reading(path, "export the BVH again, or repair the line") as at:
        joints, values, rate = _parse(at, read_text(at), fps)
        place, rot, relative = _local(joints, values)
        if relative:
            at.notes.append("position channels below the root count from the OFFSETs, which are kept")
        kept = [i for i, joint in enumerate(joints) if not joint.is_end or _speaks(joint, joints[joint.parent])]
        row = {i: k for k, i in enumerate(kept)} | {-1: -1}
        offsets = torch.tensor([joints[i].offset for i in kept], dtype=torch.float64)
        skeleton = Skeleton(tuple(joints[i].name for i in kept), tuple(row[joints[i].parent] for i in kept), offsets)
        where = [joints[i].place for i in kept]
        _, skeleton, root, rot = rerooted(at, skeleton, place[:, kept], rot[:, kept], translations, where)
        motion = Motion(skeleton, root, rot, rate, name=at.path.stem, notes=tuple(at.notes))
        return judging.to_world(at, motion, unit=unit, up=up, axes=axes)


def save(path: str | Path, motion: Motion, *, order: str = "ZXY", unit: str | float = "cm", up: str = "y") -> None:
    """Writes one motion as BVH, six channels at the root and three at every other joint.

    Numbers have six decimals (1e-8 m in cm, 1e-6 degrees), the frame time ten. Joints are written depth
    first, as BVH demands, and come back in that order: match them by name. Leaf joints named
    ``<parent>_end`` that never turn become End Sites; other leaf joints get one of ``TIP`` of their bone.
    The file appears whole or not at all.

    order: of the three rotation channels, applied left to right (intrinsic). unit, up: as in :func:`load`; a rest pose
    that faces +z in the rest frame faces +z in a y-up file.

    Raises:
        ShapeError: the motion has batch axes or no frames.
        DataError: it holds NaN or infinity, or the file cannot be written.
        ValueError: order, unit or up is none of the known ones.
    """
    single(motion, path)
    if sorted(order) != ["X", "Y", "Z"]:
        raise ValueError(f"expected an order of X, Y, Z, got {order!r}")
    scale = 1 / judging.metres(unit)
    motion = motion.to(torch.float64)
    skeleton, names, world = motion.skeleton, motion.skeleton.names, judging.axes_to_matrix(AXES.get(up, up))
    rest = (motion.rot - torch.eye(3).double()).abs().amax((0, 2, 3)) < 1e-6
    leaves = {*range(1, len(names))} - {*skeleton.parents}
    ends = {j for j in leaves if rest[j] and names[j] == f"{names[skeleton.parents[j]]}_end"}
    rot = motion.rot.clone()
    rot[:, 0] = world.T @ rot[:, 0]
    text, turning = _hierarchy_text(skeleton, scale, order, ends)
    angles = torch.rad2deg(rotation.matrix_to_euler(rot[:, turning], order))
    table = torch.cat((scale * motion.root @ world, angles.flatten(1)), dim=1).numpy()
    row = " ".join(["%.6f"] * table.shape[1])
    head = ["HIERARCHY", *text, "MOTION", f"Frames: {len(table)}", f"Frame Time: {1 / motion.fps:.10f}"]
    write_whole(path, "\n".join([*head, *(row % tuple(values) for values in table.tolist()), ""]))


@dataclass
class _Joint:
    """One joint as the file gives it: file units and axes, channels in the file's order."""

    name: str
    parent: int
    place: str
    offset: list[float] | None = None
    channels: dict[str, int] = field(default_factory=dict)  # with their columns
    is_end: bool = False

    @property
    def moves(self) -> dict[int, int]:
        """Axis -> column of each position channel."""
        return {"xyz".index(channel[0]): k for channel, k in self.channels.items() if channel.endswith("position")}

    @property
    def turns(self) -> tuple[str, list[int]]:
        """Order and columns of the rotation channels."""
        turning = {channel[0].upper(): k for channel, k in self.channels.items() if channel.endswith("rotation")}
        return "".join(turning), [*turning.values()]


def _tip(offset: Sequence[float]) -> list[float]:
    """The End Site of a joint without children, from the joint's OFFSET as it stands in the file."""
    axis = max(range(3), key=lambda k: abs(offset[k]))
    length = math.copysign(TIP * math.hypot(*offset), offset[axis])
    return [length if k == axis else 0.0 for k in range(3)]


def _speaks(end: _Joint, joint: _Joint) -> bool:
    """Whether an End Site has a length, and not that which :func:`save` makes up."""
    return any(end.offset) and not np.allclose(end.offset, _tip(joint.offset), rtol=0, atol=1e-6)


def _local(joints: list[_Joint], values: np.ndarray) -> tuple[np.ndarray, Tensor, list[int]]:
    """Where each joint stands (T, J, 3) and how it is turned (T, J, 3, 3) against its parent; see ``_relative``."""
    offset = np.array([joint.offset for joint in joints])
    place = np.broadcast_to(offset, (len(values), *offset.shape)).copy()
    rot = torch.eye(3, dtype=torch.float64).expand(len(values), len(joints), 3, 3).clone()
    for i, joint in enumerate(joints):
        for axis, column in joint.moves.items():
            place[:, i, axis] = values[:, column]
        order, columns = joint.turns
        if order:
            rot[:, i] = rotation.euler_to_matrix(torch.from_numpy(np.deg2rad(values[:, columns])), order)
    relative = _relative(joints, place.mean(0))
    place[:, relative] += offset[relative]
    return place, rot, relative


def _relative(joints: list[_Joint], place: np.ndarray) -> list[int]:
    """The joints whose position channels, at their mean places (J, 3), count from the OFFSET and not instead of it.

    Either all below the root that have any, or none: those of bones that stand at zero, when the OFFSETs do not.
    """
    moving = [i for i, joint in enumerate(joints) if i and joint.moves]
    length = {i: float(np.linalg.norm(joints[i].offset)) for i in moving}
    bones = [i for i in moving if length[i] > 1e-3 * max(length.values())]
    near = sum(np.linalg.norm(place[i]) < 0.2 * length[i] for i in bones)
    return moving if len(bones) > 1 and near > 0.8 * len(bones) else []


def _parse(at: Location, text: str, fps: Fps = None) -> tuple[list[_Joint], np.ndarray, float]:
    """The joints in file order, one row of channel values a frame, and frames per second (or those given)."""
    lines = text_lines(at, text)
    joints = _hierarchy(at, lines)
    return joints, *_motion(at, lines, sum(len(joint.channels) for joint in joints), fps)


def _hierarchy(at: Location, lines: Iterator[str]) -> list[_Joint]:
    """The joints; of the lines, MOTION is the last that is read."""
    joints: list[_Joint] = []
    here = -1  # the joint whose braces are open
    if (line := next(lines, "")).upper().split()[:1] != ["HIERARCHY"]:
        raise at.error(f"expected HIERARCHY, got {line[:40]!r}")
    for line in lines:
        head, *words = [word for word in line.split() if word != "{"] or ["{"]
        head, joint = head.upper(), joints[here] if here >= 0 else None
        if joint is None:
            expected = ["MOTION"] if joints else ["ROOT"]
        else:
            expected = ["OFFSET", "}"] if joint.is_end else ["JOINT", "END", "OFFSET", "CHANNELS", "}"]
        if head not in ("{", *expected):
            said = f"expected {', '.join(expected)}{f' of {joint.name}' if joint else ''}, got {line[:40]!r}"
            raise at.error(said, remedy="one figure a file: split it, one ROOT each" if head == "ROOT" else None)
        if head in ("ROOT", "JOINT", "END"):
            name = f"{joint.name}_end" if head == "END" else " ".join(words)
            if not name or any(name == other.name for other in joints):
                what = f"a second joint named {name!r}" if name else f"{head} without a name"
                raise at.error(what, remedy="give every joint its own name")
            joints.append(_Joint(name, here, at.place, is_end=head == "END"))
            here = len(joints) - 1
        elif head == "MOTION":
            return joints
        elif head == "}":
            if joint.offset is None:
                raise at.error(f"{joint.name} ends without an OFFSET")
            here = joint.parent
        elif head == "OFFSET":
            joint.offset = floats(at, words, 3)
        elif head == "CHANNELS":
            names, first = [word.lower() for word in words[1:]], sum(len(other.channels) for other in joints)
            if joint.channels or words[:1] != [str(len(names))]:
                raise at.error(f"expected CHANNELS once, and as many as it promises, got {len(names)}")
            if not {*names} <= {*_CHANNELS} or len({*names}) != len(names):
                raise at.error(f"channels must be different ones of {', '.join(_CHANNELS)}, got {' '.join(words[1:])}")
            joint.channels = {name: column for column, name in enumerate(names, first)}
    raise at.error("the file ends before MOTION: it is truncated, or no BVH")


def _motion(at: Location, lines: Iterator[str], width: int, fps: Fps) -> tuple[np.ndarray, float]:
    header = []
    for key in ("Frames", "Frame Time"):
        line = next(lines, "")
        name, _, value = line.partition(":")
        if name.lower().split() != key.lower().split():
            raise at.error(f"expected '{key}:', got {line[:40]!r}, or it is truncated")
        header.append((float(value), at.place))
    (frames, promised), (frame_time, _) = header
    if fps is None and not 0 < frame_time < np.inf:
        raise at.error(f"the frame time must be above zero, got {frame_time}", remedy=judging.SAY_RATE)
    fps = frame_rate(at, _rate(at, frame_time, line) if fps is None else fps, remedy=judging.SAY_RATE)
    if frames < 1 or not width:
        raise at.error("no frames" if width else "no channels", place=promised, remedy="export at least one frame")
    rows = [(at.place, line) for line in lines]
    if rows and abs(frames - len(rows)) == 1:  # some count from 0, and some the rest pose
        at.notes.append(f"the file promises {frames:g} frames and has {len(rows)}: those that are there are read")
    elif frames != len(rows):
        remedy = "copy the file again if it is truncated, or correct the number"
        raise at.error(f"promises {frames:g} frames, the file has {len(rows)}", place=promised, remedy=remedy)
    values = np.empty((len(rows), width))
    for row, (at.place, line) in zip(values, rows, strict=True):
        row[:] = floats(at, line.split(), width)
    at.place = ""
    return values, fps


def _rate(at: Location, frame_time: float, line: str) -> float:
    """Frames per second: the whole number that the printed digits can mean (0.033333 is 30), else 1 / time."""
    digits = len(line.partition(".")[2])
    if frame_time > 2:
        near = (rate for rate in RATES if abs(1000 / rate - frame_time) < 10.0**-digits)  # 16.67 ms is 60 a second
        fps = frame_time if frame_time in RATES else next(near, 1000 / frame_time)
        taken = f"a frame time of {frame_time:g} s is taken as {fps:g} frames per second"
        at.notes.append(f"{taken}: give the right one with fps=, or --fps-in")
        return fps
    whole = max(round(1 / frame_time), 1)
    return float(whole) if digits >= 4 and abs(frame_time - 1 / whole) <= 10.0**-digits else 1 / frame_time


def _hierarchy_text(skeleton: Skeleton, scale: float, order: str, ends: set[int]) -> tuple[list[str], list[int]]:
    """The joints depth first, and their indices in the order of their channels."""
    offsets = [[round(x, 6) for x in offset] for offset in (skeleton.offsets * scale).tolist()]
    offsets[0] = [0.0, 0.0, 0.0]
    turns = " ".join(f"{axis}rotation" for axis in order)
    above, text = ancestors(skeleton.parents), []
    depth_first = sorted(range(len(above)), key=lambda joint: (*above[joint], joint))
    for joint, after in zip(depth_first, [*depth_first[1:], 0], strict=True):
        pad = "\t" * len(above[joint])
        kind = "End Site" if joint in ends else f"{'JOINT' if joint else 'ROOT'} {skeleton.names[joint]}"
        text += [f"{pad}{kind}", f"{pad}{{", f"{pad}\tOFFSET " + " ".join(f"{x:.6f}" for x in offsets[joint])]
        if joint not in ends:
            text.append(f"{pad}\tCHANNELS {'3' if joint else '6 Xposition Yposition Zposition'} {turns}")
            if joint not in skeleton.parents:
                tip = "\tOFFSET " + " ".join(f"{x:.6f}" for x in _tip(offsets[joint]))
                text += [f"{pad}\t{line}" for line in ("End Site", "{", tip, "}")]
        text += ["\t" * depth + "}" for depth in range(len(above[joint]), len(above[after]) - 1, -1)]
    return text, [joint for joint in depth_first if joint not in ends]
