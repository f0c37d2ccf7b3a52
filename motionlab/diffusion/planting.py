"""A finish for feet: where the ball of a foot or an ankle is said to stand, or is low and slow, it stands.

Every run of such frames gets one place, the mean of where the ball was in it. In between, the shift of the ball goes in
a line from one run to the next. The ankle stays at its own mean as far as the foot's length lets it; what it needs
besides the shift fades at its run's ends. Where the leg is too short the heel lifts, the ball stays. Hip and knee bend
by two-bone inverse kinematics.
Source: Kovar et al. 2002, "Footskate cleanup for motion capture editing". Differs: runs get their mean place, the root
never moves, and a ball out of reach of leg and foot is approached, not reached.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, normalize, one_hot, pad

from motionlab import rotation
from motionlab.contact import contacts_from_positions, resting_heights
from motionlab.diffusion.between import between
from motionlab.errors import DataError, ShapeError
from motionlab.motion import Motion
from motionlab.retarget.legs import reach
from motionlab.skeleton import ANKLES, BALLS

STANDS = 0.5  # of a contact: more is one
LOW = 0.2  # metres above where a joint rests: lower and slow, it stands, too
SLOW = {ANKLES: (0.25, 0.5), BALLS: (0.35, 0.7)}  # m/s, strict and loose (``contact.hysteresis``)
FADE = 4  # frames beside a run in which a foot turns to lie flat
STRETCHED = 0.998  # of a straight leg: longer is out of reach, unless it was
HIPS, KNEES = ("left_hip", "right_hip"), ("left_knee", "right_knee")


def planted(motion: Motion, *, slow: bool = True) -> Motion:
    """Motions (B, T) on one body whose feet stay in place wherever their contacts say so.

    slow: and where they are low and slow: motion that was filled in knows its contacts no better than its legs, and
    what stands on a step has none. A sample, whose contacts were made with its legs, only grows calmer by that.

    Raises:
        DataError: no contacts. ShapeError: a single clip, a body for each, or one frame, which has no speed.
    """
    if motion.root.ndim != 3 or motion.skeleton.offsets.ndim != 2:
        raise ShapeError(f"expected motions (B, T) on one body, got root {tuple(motion.root.shape)}")
    if motion.contacts is None:
        raise DataError("no contacts", place=motion.name, remedy="contact.with_contacts labels a motion")
    skeleton = motion.skeleton
    hip, ankle, ball = (motion.positions[..., skeleton.indices(names), :] for names in (HIPS, ANKLES, BALLS))
    heel_down, ball_down = (_stands(motion, names, slow) for names in (ANKLES, BALLS))
    shift = _lines(_place(ball, ball_down) - ball, ball_down)
    flat = torch.where(heel_down[..., None], _place(ankle, heel_down) - ankle - shift, 0.0)
    flat = _lines(flat, heel_down | ~_near(heel_down))
    thigh, shin, foot = (skeleton.offsets[skeleton.indices(names)].norm(dim=-1) for names in (KNEES, ANKLES, BALLS))
    there = ball + shift
    heel = there + foot[:, None] * normalize(ankle + shift + flat - there, dim=-1)
    longest = torch.maximum(STRETCHED * (thigh + shin), (ankle - hip).norm(dim=-1))
    heel = _within(heel, there, foot[:, None], hip, longest[..., None])
    return _turned(motion, heel, there)


def _stands(motion: Motion, names: tuple[str, ...], slow: bool = True) -> Tensor:
    skeleton, points = motion.skeleton, motion.positions[..., motion.skeleton.indices(names), :]
    columns = [skeleton.contact_names.index(name) for name in names]
    says = motion.contacts[..., columns] > STANDS
    if not slow:
        return says
    rest = resting_heights(skeleton)[columns]
    return says | (contacts_from_positions(points, motion.fps, rest, height=(LOW, LOW), speed=SLOW[names]) > 0)


def _place(points: Tensor, stands: Tensor) -> Tensor:
    """The mean (B, T, F, 3) of points over the run of ``stands`` (B, T, F) that a frame is of."""
    begins = stands & ~pad(stands, (0, 0, 1, 0))[..., :-1, :]
    run = one_hot(torch.where(stands, begins.cumsum(-2), 0), stands.shape[-2] + 1).to(points)
    mean = torch.einsum("btfr,btfc->bfrc", run, points) / run.sum(-3)[..., None].clamp(min=1)
    return torch.einsum("btfr,bfrc->btfc", run, mean)


def _lines(shift: Tensor, known: Tensor) -> Tensor:
    """``between`` of (B, T, F, 3), known (B, T, F)."""
    known = known[..., None].expand_as(shift)
    return between(shift.flatten(-2), known.flatten(-2)).unflatten(-1, shift.shape[-2:])


def _near(stands: Tensor) -> Tensor:
    """(B, T, F): up to ``FADE`` frames from where it stands."""
    return max_pool1d(stands.mT.float(), 2 * FADE + 1, 1, FADE).mT > 0


def _within(heel: Tensor, ball: Tensor, foot: Tensor, hip: Tensor, leg: Tensor) -> Tensor:
    """The nearest points to ``heel`` at distance ``foot`` of the ball and at most ``leg`` from the hip; where there is
    none, on the line from ball to hip."""
    line = hip - ball
    far = line.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    along = ((far**2 + foot**2 - leg**2) / (2 * far)).clamp(max=foot)
    up = line / far
    side = heel - ball
    side = normalize(side - (side * up).sum(-1, keepdim=True) * up, dim=-1)
    lifted = ball + along * up + (foot**2 - along**2).clamp(min=0).sqrt() * side
    return torch.where((heel - hip).norm(dim=-1, keepdim=True) > leg, lifted, heel)


def _turned(motion: Motion, heel: Tensor, ball: Tensor) -> Motion:
    """The motion with ankles at ``heel`` and feet that point to ``ball`` (B, T, 2, 3), as far as legs reach."""
    skeleton, size = motion.skeleton, motion.root.shape[:2]
    every = Motion(skeleton, motion.root.flatten(0, 1), motion.rot.flatten(0, 1), motion.fps)  # frames are alone
    made = reach(every, heel.flatten(0, 1))
    knees, ankles, balls = (skeleton.indices(names) for names in (KNEES, ANKLES, BALLS))
    before = every.positions[:, balls] - every.positions[:, ankles]
    turn = rotation.between(before, ball.flatten(0, 1) - made.positions[:, ankles])
    rot = made.rot.clone()
    rot[:, ankles] = made.world[1][:, knees].mT @ turn @ every.world[1][:, ankles]
    return replace(motion, rot=rot.unflatten(0, size))
