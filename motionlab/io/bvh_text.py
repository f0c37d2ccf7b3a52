"""The grammar of BVH text: joints with offsets and channels, and one row of numbers a frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from motionlab.io.reading import Spot, frame_rate, numbers


@dataclass
class Joint:
    """One joint as the file gives it: file units and axes, channels in the file's order."""

    name: str
    parent: int
    line: int
    offset: list[float] | None = None
    channels: list[str] = field(default_factory=list)
    is_end: bool = False


def parse(at: Spot, text: str) -> tuple[list[Joint], np.ndarray, float]:
    """The joints in file order, one row of channel values a frame, and frames per second.

    Raises:
        DataError: naming the line.
    """
    lines = text.splitlines()
    joints, motion_line = _hierarchy(at, lines)
    values, fps = _motion(at, lines, motion_line, sum(len(joint.channels) for joint in joints))
    at.place = ""
    return joints, values, fps


def _hierarchy(at: Spot, lines: list[str]) -> tuple[list[Joint], int]:
    joints: list[Joint] = []
    open_joints: list[int] = []
    names: set[str] = set()
    started = expect_brace = False
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        at.place = f"line {number}"
        head = words[0].upper()
        expected = "ROOT" if started else "HIERARCHY"
        if not joints and head != expected:
            raise at.error(f"expected {expected}, got {line.strip()[:40]!r}")
        if not started:
            started = True
            continue
        if expect_brace != (head == "{"):
            raise at.error("a joint's name must be followed by {" if expect_brace else "a { without a joint")
        if head == "{":
            expect_brace = False
        elif head in ("ROOT", "JOINT", "END"):
            if (head == "ROOT") != (not joints):
                raise at.error("a second ROOT: one figure a file", remedy="split the file, one ROOT each")
            if joints and not open_joints:
                raise at.error(f"{words[0]} outside the root's braces")
            parent = open_joints[-1] if open_joints else -1
            if joints and joints[parent].is_end:
                raise at.error("an End Site has no children")
            name = " ".join(words[1:]) if head != "END" else f"{joints[parent].name}_end"
            if not name:
                raise at.error(f"{words[0]} without a name")
            if name in names:
                raise at.error(f"a second joint named {name!r}", remedy="give every joint its own name")
            names.add(name)
            open_joints.append(len(joints))
            joints.append(Joint(name, parent, number, is_end=head == "END"))
            expect_brace = True
        elif head == "}":
            if not open_joints:
                raise at.error("a } too many")
            if joints[open_joints[-1]].offset is None:
                raise at.error(f"{joints[open_joints[-1]].name} ends without an OFFSET")
            open_joints.pop()
        elif head == "OFFSET" and open_joints:
            joints[open_joints[-1]].offset = numbers(at, [float(w) for w in words[1:]], "3").tolist()
        elif head == "CHANNELS" and open_joints:
            joints[open_joints[-1]].channels = _channels(at, words, joints[open_joints[-1]])
        elif head == "MOTION":
            if open_joints:
                raise at.error(f"the braces of {joints[open_joints[-1]].name} are still open")
            return joints, number
        else:
            raise at.error(f"expected JOINT, End Site, OFFSET, CHANNELS or a brace, got {line.strip()[:40]!r}")
    at.place = f"line {len(lines)}"
    raise at.error("the file ends before MOTION: it is truncated, or no BVH")


def _channels(at: Spot, words: list[str], joint: Joint) -> list[str]:
    channels = [word.lower() for word in words[2:]]
    known = {f"{axis}{kind}" for axis in "xyz" for kind in ("position", "rotation")}
    if len(words) < 2 or words[1] != str(len(channels)):
        raise at.error(f"CHANNELS promises {' '.join(words[1:2])} and lists {len(channels)}")
    if not set(channels) <= known or len(set(channels)) != len(channels):
        raise at.error(f"channels must be different ones of {', '.join(sorted(known))}, got {' '.join(words[2:])}")
    if joint.is_end or joint.channels:
        raise at.error("an End Site has no channels" if joint.is_end else f"{joint.name} has CHANNELS twice")
    return channels


def _motion(at: Spot, lines: list[str], motion_line: int, width: int) -> tuple[np.ndarray, float]:
    rows = [(n, line) for n, line in enumerate(lines[motion_line:], start=motion_line + 1) if line.strip()]
    header = []
    for (number, line), key in zip(rows[:2], ("frames", "frame time"), strict=False):
        at.place = f"line {number}"
        name, _, value = line.partition(":")
        if " ".join(name.lower().split()) != key:
            raise at.error(f"expected '{key}:', got {line.strip()[:40]!r}")
        header.append(float(value))
    if len(header) < 2:
        raise at.error("the file ends before 'Frame Time:': it is truncated")
    frames, frame_time = header
    if not 0 < frame_time < np.inf:
        raise at.error(f"the frame time must be above zero, got {frame_time}", remedy="write seconds per frame")
    fps = frame_rate(at, _rate(frame_time, rows[1][1]))
    at.place = f"line {rows[0][0]}"
    if frames < 1 or not width:
        raise at.error("no frames" if width else "no channels", remedy="export at least one frame")
    rows = rows[2:]
    if frames != len(rows):
        raise at.error(
            f"promises {frames:g} frames, the file has {len(rows)}",
            remedy="copy the file again if it is truncated, or correct the number",
        )
    try:
        values = np.array(" ".join([line for _, line in rows]).split(), dtype=np.float64)
        fits = values.size == len(rows) * width and np.isfinite(values).all()
    except ValueError:
        fits = False
    if not fits:
        raise _bad_row(at, rows, width)
    return numbers(at, values.reshape(len(rows), width), "T C", place="motion block"), fps


def _rate(frame_time: float, line: str) -> float:
    """Frames per second: the whole number that the printed digits can mean (0.033333 is 30), else 1 / time."""
    digits = len(line.strip().partition(".")[2])
    whole = max(round(1 / frame_time), 1)
    return float(whole) if digits >= 4 and abs(frame_time - 1 / whole) <= 10.0**-digits else 1 / frame_time


def _bad_row(at: Spot, rows: list[tuple[int, str]], width: int) -> Exception:
    for number, line in rows:
        words = line.split()
        at.place = f"line {number}"
        if len(words) != width:
            return at.error(f"expected {width} values, got {len(words)}")
        for column, word in enumerate(words, start=1):
            try:
                if np.isfinite(float(word)):
                    continue
            except ValueError:
                pass
            return at.error(f"value {column} is {word[:40]!r}, not a finite number")
    return at.error("the frames do not have the promised width")
