"""Finds what is wrong with a recording on the 22 joints, frame by frame, and cuts it out.

Faults are found by measurement, never by a file's name:

    teleport   a joint moves faster than anybody can, or a bone turns faster
    t-pose     both arms stretched out level, in front of nothing: a calibration pose at the start or the end
    afloat     the body rests on what is not there (steps, chairs, partners), or hangs in the air longer than a leap
    sunk       a part of the body lies deep below the floor
    frozen     nothing moves at all
    flipped    a knee bends the wrong way

Source: none; thresholds were chosen by looking at what they cut from the CMU library (notebook 01).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.motion import Motion, runs, velocity
from motionlab.skeleton import FEET, STANDARD

# Bounds of :func:`faults`. Metres, seconds, radians.
_FASTEST, _FASTEST_TURN = 15.0, 40.0  # m/s of a joint against the pelvis or of the pelvis; rad/s of a bone
_LEAP = 0.7  # s: nobody is in the air longer
_AIR, _STEP = 0.12, 0.10  # m: a foot this far above where it rests is in the air; rests on a step
_SUNK = 0.15  # m below the floor
_STILL, _STILL_FOR = 0.002, 1.0  # m/s: the fastest joint of a frozen take; s
_BACKWARDS = 0.35  # rad that a knee may bend the wrong way
SHORTEST = 1.1  # s: a shorter stretch is left out


@dataclass(frozen=True)
class Cleaned:
    """What is left of a recording, and what was cut.

    stretches: clean motions in their order, each of at least ``SHORTEST`` seconds; their names say from which second.
    seconds: cut, by fault; a frame with two faults counts for the first. "short": clean, but in too short a stretch.
    """

    stretches: tuple[Motion, ...]
    seconds: Mapping[str, float]


def faults(motion: Motion) -> dict[str, Tensor]:
    """Finds faults in a motion (T) on the 22 joints, z up, floor at z = 0: by name, bool (T,), True where it is."""
    places, fps = motion.positions.double(), motion.fps
    return {
        "teleport": _teleports(motion, places),
        "t-pose": _calibration(motion, places),
        "afloat": _afloat(motion, places),
        "sunk": _wide(places[..., 2].amin(-1) < -_SUNK, fps, 0.1),
        "frozen": _lasting(velocity(places, fps, dim=0).norm(dim=-1).amax(-1) < _STILL, _STILL_FOR * fps),
        "flipped": _wide(_backwards(motion) > _BACKWARDS, fps, 0.1),
    }


def clean(motion: Motion, shortest: float = SHORTEST) -> Cleaned:
    """Cuts the faults out of a motion (T) on the 22 joints; what is left is in stretches of ``shortest`` seconds or
    more."""
    bad, seconds = torch.zeros(motion.frames, dtype=torch.bool), {}
    for name, found in faults(motion).items():
        seconds[name] = float((found & ~bad).sum()) / motion.fps
        bad = bad | found
    stretches, left = [], 0
    for start, stop in runs(~bad):
        if stop - start >= shortest * motion.fps:
            name = f"{motion.name} from {start / motion.fps:.1f} s"
            stretches.append(replace(motion.cut(start, stop), name=name))
        else:
            left += stop - start
    return Cleaned(tuple(stretches), {n: s for n, s in (seconds | {"short": left / motion.fps}).items() if s})


def _lasting(on: Tensor, least: float) -> Tensor:
    """(T,): on, where it stays on for ``least`` frames or more."""
    out = torch.zeros_like(on)
    for start, stop in runs(on):
        if stop - start >= least:
            out[start:stop] = True
    return out


def _wide(on: Tensor, fps: float, seconds: float) -> Tensor:
    """(T,): on, and so many seconds before and after."""
    margin = max(1, round(seconds * fps))
    return F.max_pool1d(on.float()[None], 2 * margin + 1, 1, margin)[0] > 0


def _teleports(motion: Motion, places: Tensor) -> Tensor:
    """Frames on either side of a step that is too fast."""
    root = places[:, :1]
    speed = torch.cat((root, places[:, 1:] - root), 1).diff(dim=0).norm(dim=-1).amax(-1) * motion.fps
    turn = rotation.geodesic(motion.rot[1:], motion.rot[:-1]).amax(-1) * motion.fps
    return _wide(F.pad((speed > _FASTEST) | (turn > _FASTEST_TURN), (0, 1)), motion.fps, 0.1)


def _calibration(motion: Motion, places: Tensor) -> Tensor:
    """A T-pose within the first or last three seconds: arms level, straight and sideways, legs straight, hardly any
    motion."""
    shoulder, elbow, wrist, hip, ankle = _sides(places, "shoulder", "elbow", "wrist", "hip", "ankle")
    arm, leg = wrist - shoulder, ankle - hip
    across = shoulder - shoulder.flip(1)  # from the other one
    reach = (elbow - shoulder).norm(dim=-1) + (wrist - elbow).norm(dim=-1)
    along = (arm * across).sum(-1) / (reach * across.norm(dim=-1)).clamp(min=1e-9)
    found = ((along > 0.94) & (-leg[..., 2] > 0.97 * leg.norm(dim=-1))).all(-1)
    edge = min(motion.frames, round(3 * motion.fps))
    found[edge : motion.frames - edge] = False
    return _wide(found, motion.fps, 0.3)


def _afloat(motion: Motion, places: Tensor) -> Tensor:
    """Nothing touches the floor for longer than a leap lasts; or both feet are off it and one of them rests."""
    fps = motion.fps
    rest = motion.skeleton.rest_positions()[..., 1]
    resting = (rest - rest.amin(-1, keepdim=True) + motion.skeleton.sole)[..., motion.skeleton.indices(FEET)].double()
    feet = places[:, motion.skeleton.indices(FEET)]
    above = feet[..., 2] - resting
    lowest = torch.minimum(above.amin(-1), places[..., 2].amin(-1) - 0.05)
    hanging = _lasting(lowest > _AIR, _LEAP * fps)
    speed = velocity(feet, fps, dim=0).norm(dim=-1)
    held = ((above > _STEP) & (speed < 0.15)).any(-1) & (lowest > _STEP)
    return hanging | _wide(_lasting(held, 0.2 * fps), fps, 0.3)


def _backwards(motion: Motion) -> Tensor:
    """(T,): how far, in radians, the worse knee bends the wrong way: its shin ahead of the thigh, about the thigh's own
    left axis."""
    hip, knee, ankle = _sides(motion.positions.double(), "hip", "knee", "ankle")
    (left,) = _sides(motion.world[1][..., 0].double(), "hip")
    thigh, shin = F.normalize(knee - hip, dim=-1), F.normalize(ankle - knee, dim=-1)
    return -torch.asin((torch.linalg.cross(thigh, shin) * left).sum(-1).clamp(-1, 1)).amin(-1)


def _sides(values: Tensor, *parts: str) -> list[Tensor]:
    """Of each part the left and the right one (T, 2, ...), of values (T, 22, ...)."""
    return [values[:, STANDARD.indices([f"{side}_{part}" for side in ("left", "right")])] for part in parts]
