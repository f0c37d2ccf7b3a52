"""Feet that stand stay in place; the end of a motion meets its beginning, and it may stay in place.

Source: Kovar et al. 2002 (``animate.foot_locking``); Holden 2023, "Creating looping animations from motion capture";
thesis 4.1.2 for motion in place.
"""

from dataclasses import replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.animate.corrections import LEGS, KeyMask, Rig
from motionlab.animate.filling import Animated
from motionlab.animate.foot_locking import standing_feet
from motionlab.errors import DataError
from motionlab.metrics import slide_in_contact_mm
from motionlab.motion import Motion, fix_root_horizontally
from motionlab.retarget import retarget
from motionlab.skeleton import ANKLES, BALLS

_STAYS = 1e-4  # metres: feet that locking moves by less stay to the bit, and their legs
BLEND = 0.25  # seconds at either end over which a loop is closed
_LEAST = 4  # frames of a loop
_TURNS = 30.0  # degrees between the ends from which a loop says what it costs


def planted(motion: Motion) -> Animated:
    """Computes a motion (T) whose feet stay in place where they stand; only hips, knees and ankles turn otherwise.

    What stands: low and slow (``animate.foot_locking``), on the floor where the feet are lowest.

    Raises:
        DataError: fewer than two frames, or a skeleton whose joints are not known.
    """
    if motion.frames < 2:
        raise DataError("one frame has no speed", path=motion.name, place="frames", remedy="give a motion")
    body = _legs_open(motion)
    made = body.to_own_rig(body.joints, plant=True)
    feet = body.joints.skeleton.indices([*ANKLES, *BALLS])
    tips = sorted(body.mapped[j] for j in feet if j in body.mapped)
    still = (made.positions - motion.positions)[:, tips].norm(dim=-1).amax(-1) < _STAYS
    made = replace(made, rot=torch.where(still[:, None, None, None], motion.rot, made.rot))
    before, after = body.joints, _legs_open(made, body.lift).joints
    stands = standing_feet(before)
    slides = [float(slide_in_contact_mm(m.positions[:, feet], stands)) for m in (before, after)]
    note = f"feet that stand slide {slides[0]:.1f} mm a frame before, {slides[1]:.1f} after"
    note = note if stands.any() else "no foot stands: the motion stays as it is"
    where = f"the floor is taken to be at {round(0 - body.lift, 2) + 0.0:.2f} m, where the feet are lowest"
    return Animated(made, (*body.notes(True), note, where))


def _legs_open(motion: Motion, lift: float | None = None) -> Rig:
    """The motion on 22 joints, of which all but the legs are kept."""
    found = retarget(motion)
    keep = KeyMask.of(motion, hidden=[motion.skeleton.index(found.names[name]) for name in LEGS])
    return Rig.of(motion, motion, keep, lift=found.floor if lift is None else lift)


def cycled(
    motion: Motion, *, loop: bool = True, in_place: bool = False, blend: float = BLEND, plant: bool = True
) -> Animated:
    """Computes a motion (T) whose last frame is its first again, where it has got to; or that goes nowhere; or both.

    loop: what the ends differ by in pose, height and velocity is taken out over ``blend`` seconds at either, half of it
    at each, by cubics. Played on, the last frame is the first of the next round. in_place: the root stays above one
    point, as it was in height and turn.

    Raises:
        DataError: too short for a loop, a blend that is no time, or (plant) a skeleton whose joints are not known.
    """
    notes: list[str] = []
    if loop:
        if motion.frames < _LEAST:
            raise DataError(f"{motion.frames} frames make no loop", path=motion.name, remedy=f"give {_LEAST} or more")
        if not 0 < blend < 1e6:  # not a number is neither
            raise DataError(f"a blend of {blend:g} s", place="--blend", remedy=f"give seconds above 0, as {BLEND:g}")
        motion, off = _closed(motion, blend)
        notes.append(f"the ends differed by {100 * off[0]:.0f} cm in height and up to {off[1]:.0f} degrees in a joint")
        if off[2] > _TURNS:
            said = f"it turns by {off[2]:.0f} degrees from end to end, which is taken out"
            notes.append(f"{said}: cut where it faces alike")
        if plant:
            motion = _planted_around(motion)
            notes.append("feet that stand are held in place, over the seam, too")
        far = float((motion.root[-1] - motion.root[0]).norm())
        notes.append("the last frame is the first again" + f", {far:.2f} m on" * (not in_place))
    if in_place:
        motion = fix_root_horizontally(motion)
        notes.append("the root stays above one point; its height and turns are as they were")
    return Animated(motion, tuple(notes))


def _closed(motion: Motion, blend: float) -> tuple[Motion, tuple[float, float, float]]:
    """The loop; and by how much the ends differed: metres in height, degrees in the joint that did most, and of the
    root about the vertical."""
    root, rot = motion.root.double(), motion.rot.double()
    frames = min(max(round(blend * motion.fps), 1), (motion.frames - 1) // 2)
    rise = (root[0] - root[-1]) * torch.tensor([0.0, 0.0, 1.0])
    faster = (root[1] - root[0]) - (root[-1] - root[-2])
    turn = rotation.log(rot[-1].mT @ rot[0])
    spin = rotation.log(rot[0].mT @ rot[1]) - rotation.log(rot[-2].mT @ rot[-1])
    # half of what the ends differ by, and of their velocities, fades from each end on
    time = torch.arange(motion.frames, dtype=torch.float64)
    (p0, v0), (p1, v1) = (_fading(away, frames) for away in (time, time.flip(0)))
    size, speed = (p1 - p0) / 2, -(v0 + v1) / 2
    root = root + size[:, None] * rise + speed[:, None] * faster
    rot = rot @ rotation.exp(size[:, None, None] * turn + speed[:, None, None] * spin)
    root[-1], rot[-1] = torch.cat((root[-1, :2], root[0, 2:])), rot[0]
    heading = rotation.log(motion.rot[0, 0].double() @ motion.rot[-1, 0].double().mT)[2]
    off = float(rise.norm()), float(torch.rad2deg(turn.norm(dim=-1).max())), float(torch.rad2deg(heading.abs()))
    return replace(motion, root=root.to(motion.root), rot=rot.to(motion.rot), contacts=None), off


def _fading(away: Tensor, frames: int) -> tuple[Tensor, Tensor]:
    """What is left (T,) of an offset of 1, and what a velocity of 1 a frame adds, so many frames from an end."""
    u = (away / frames).clamp(max=1)
    return 1 - 3 * u**2 + 2 * u**3, frames * (u - 2 * u**2 + u**3)


def _planted_around(motion: Motion) -> Motion:
    """A loop with feet that stay in place, on from one round to the next: the middle one of three."""
    period, travel = motion.frames - 1, motion.root[-1] - motion.root[0]
    at = torch.arange(3 * period + 1)
    root = motion.root[at % period] + (at // period)[:, None] * travel
    made = planted(replace(motion, root=root, rot=motion.rot[at % period])).motion.rot[period : 2 * period]
    return replace(motion, rot=torch.cat((made, made[:1])))
