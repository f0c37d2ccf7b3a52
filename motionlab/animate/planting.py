"""Foot lock: the feet of a motion that stand stay in place.

Source: Kovar et al. 2002 (``animate.foot_locking``).
"""

from __future__ import annotations

from dataclasses import replace

import torch

from motionlab.animate.corrections import LEGS, KeyMask, Rig
from motionlab.animate.filling import Animated
from motionlab.animate.foot_locking import standing_feet
from motionlab.errors import DataError
from motionlab.metrics.gait import slide_in_contact_mm
from motionlab.motion import Motion
from motionlab.retarget import retarget
from motionlab.skeleton import ANKLES, BALLS

_STAYS = 1e-4  # metres: feet that locking moves by less stay to the bit, and their legs


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
    where = f"the floor is taken to be at {0 - body.lift:.2f} m, where the feet are lowest"
    return Animated(made, (*body.notes(True), note, where))


def _legs_open(motion: Motion, lift: float | None = None) -> Rig:
    """The motion on 22 joints, of which all but the legs are kept."""
    found = retarget(motion)
    keep = KeyMask.of(motion, hidden=[motion.skeleton.index(found.names[name]) for name in LEGS])
    return Rig.of(motion, motion, keep, lift=found.floor if lift is None else lift)
