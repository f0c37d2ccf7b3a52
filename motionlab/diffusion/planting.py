"""A finish for feet: where a motion says that the ball of a foot stands, it stands, and the leg follows.

Every run of frames of contact gets one place, the mean of where the ball was in it. In between, the shift that this
takes goes in a line from one run to the next; the ankle is shifted alike, and hip and knee bend by two-bone inverse
kinematics, the foot turned as before.
Source: Kovar et al. 2002, "Footskate cleanup for motion capture editing". Differs: runs get their mean place, the root
never moves, and a target out of reach is approached, not reached.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from motionlab.diffusion.between import between
from motionlab.errors import DataError, ShapeError
from motionlab.motion import Motion
from motionlab.retarget.legs import reach
from motionlab.skeleton import ANKLES, BALLS

STANDS = 0.5  # of a contact: more is one


def planted(motion: Motion) -> Motion:
    """Motions (B, T) on one body whose balls of the feet stay in place wherever their contacts say so.

    Raises:
        DataError: no contacts. ShapeError: a single clip, or a body for each.
    """
    if motion.root.ndim != 3 or motion.skeleton.offsets.ndim != 2:
        raise ShapeError(f"expected motions (B, T) on one body, got root {tuple(motion.root.shape)}")
    if motion.contacts is None:
        raise DataError("no contacts", place=motion.name, remedy="contact.with_contacts labels a motion")
    skeleton = motion.skeleton
    ankle, ball = (motion.positions[..., skeleton.indices(names), :] for names in (ANKLES, BALLS))
    stands = motion.contacts[..., [skeleton.contact_names.index(name) for name in BALLS]] > STANDS
    begins = stands & ~torch.nn.functional.pad(stands, (0, 0, 1, 0))[..., :-1, :]
    run = torch.nn.functional.one_hot(torch.where(stands, begins.cumsum(-2), 0), stands.shape[-2] + 1).to(ball)
    place = torch.einsum("btfr,btfc->bfrc", run, ball) / run.sum(-3)[..., None].clamp(min=1)
    shift = torch.einsum("btfr,bfrc->btfc", run, place) - ball
    known = stands[..., None].expand_as(shift)
    shift = between(shift.flatten(-2), known.flatten(-2)).unflatten(-1, shift.shape[-2:])
    every = Motion(skeleton, motion.root.flatten(0, 1), motion.rot.flatten(0, 1), motion.fps)  # frames are alone
    return replace(motion, rot=reach(every, (ankle + shift).flatten(0, 1)).rot.unflatten(0, motion.root.shape[:2]))
