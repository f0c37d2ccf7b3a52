"""Locks feet to the floor where they stand (footskate cleanup), by inverse kinematics of the legs.

Where the ball of a foot or an ankle is said to stand, or is low and slow, it stands. Every run of such frames gets one
place, the mean of where the ball was in it. In between, the shift of the ball goes in a line from one run to the next.
The ankle stays at its own mean as far as the foot's length lets it; what it needs besides the shift fades at its run's
ends. Where the leg is too short the heel lifts, the ball stays. Hip and knee bend by two-bone inverse kinematics.

Source: Kovar et al. 2002, "Footskate cleanup for motion capture editing".
Differs: runs get their mean place, the root never moves, and a ball out of reach of leg and foot is approached, not
reached.
"""

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, normalize, one_hot, pad

from motionlab import rotation
from motionlab.animate import footsteps
from motionlab.baselines import between_known, lines_between, nearest_known
from motionlab.contact import contacts_from_positions, resting_heights, with_contacts
from motionlab.errors import DataError, ShapeError
from motionlab.ik import two_bone_ik
from motionlab.motion import Motion
from motionlab.skeleton import ANKLES, BALLS

_STANDS = 0.5  # of a contact: more is one
_LOW = 0.2  # metres above where a joint rests: lower and slow, it stands, too
_SLOW = {ANKLES: (0.25, 0.5), BALLS: (0.35, 0.7)}  # m/s, strict and loose (``contact.contacts_from_positions``)
_RAISED = 0.1  # metres above where an ankle should rest: so high, at most, it may rest in known frames
_FADE = 4  # frames beside a run in which a foot turns to lie flat
_STRETCHED = 0.998  # of a straight leg: longer is out of reach, unless it was
_HIPS, _KNEES = ("left_hip", "right_hip"), ("left_knee", "right_knee")


def lock_feet(
    motion: Motion, *, slow: bool = True, known: Tensor | None = None, ease: float = 0.0, step: bool = False
) -> Motion:
    """Computes motions (B, T) on one body whose feet stay in place wherever their contacts say so.

    slow: and where they are low and slow: motion that was filled in knows its contacts no better than its legs, and
    what stands on a step has none. A sample, whose contacts were made with its legs, only grows calmer by that.
    known: bool (B, T), frames whose feet are right already: they stay, and a run stands where its known frames do.
    step: for motion that was filled in between known frames: what glides there steps, off the floor (``footsteps``).
    ease: frames beside known ones over which feet that step set in.

    Raises:
        DataError: no contacts. ShapeError: a single clip, a body for each, or one frame, which has no speed.
    """
    if motion.root.ndim != 3 or motion.skeleton.offsets.ndim != 2:
        raise ShapeError(f"expected motions (B, T) on one body, got root {tuple(motion.root.shape)}")
    if motion.contacts is None:
        raise DataError("no contacts", place=motion.name, remedy="contact.with_contacts labels a motion")
    skeleton = motion.skeleton
    hip, ankle, ball = (motion.positions[..., skeleton.indices(names), :] for names in (_HIPS, ANKLES, BALLS))
    thigh, shin, foot = (skeleton.offsets[skeleton.indices(names)].norm(dim=-1) for names in (_KNEES, ANKLES, BALLS))
    heel_down, ball_down = (_stands(motion, names, slow) for names in (ANKLES, BALLS))
    right = torch.zeros_like(motion.root[..., :1], dtype=torch.bool) if known is None else known[..., None]
    at_heel, at_ball = _place(ankle, heel_down, right) - ankle, _place(ball, ball_down, right) - ball
    shift = torch.where(right[..., None], 0.0, at_ball)
    anew = moving = torch.zeros_like(ball_down)
    if step:
        alone = heel_down & ~ball_down & ~right  # a heel that stands takes its ball along
        shift, ball_down = torch.where(alone[..., None], at_heel, shift), ball_down | alone
        leg = float((thigh + shin).mean())
        when, anew, moving = footsteps.retime(ball, heel_down | ball_down, right, leg, motion.fps)
        shift = torch.where(anew[..., None], footsteps.at_times(ball, when) - ball, shift)
        at_heel = torch.where(anew[..., None], footsteps.at_times(ankle, when) - ankle, at_heel)
    shift = _lines(shift, ball_down | right | anew)
    flat = torch.where(((heel_down | anew) & ~right)[..., None], at_heel - shift, 0.0)
    flat = _lines(flat, (heel_down & ~_near(right)) | ~_near(heel_down | anew) | right | anew)
    there, heel = ball + shift, ankle + shift + flat
    if step:  # off the floor, which is where known ankles that stand are lowest
        rest, sure = resting_heights(skeleton)[[skeleton.contact_names.index(n) for n in ANKLES]], right & heel_down
        lowest = torch.where(sure, ankle[..., 2], torch.inf).amin(1).clamp(max=rest + _RAISED)
        rest = torch.where(sure.any(1), lowest, rest)
        still, legs = (heel_down | ball_down) & ~moving, torch.stack((hip, heel, there))
        _, heel, there = footsteps.lift(legs, still, right.expand_as(still), rest, leg, motion.fps)
        heel, there = (x + _eased_in(y - x, right[..., 0], ease) for x, y in ((ankle, heel), (ball, there)))
    heel = there + foot[:, None] * normalize(heel - there, dim=-1)
    longest = torch.maximum((footsteps.STRAIGHT if step else _STRETCHED) * (thigh + shin), (ankle - hip).norm(dim=-1))
    heel = _within(heel, there, foot[:, None], hip, longest[..., None])
    return _with_feet_at(motion, heel, there)


def standing_feet(motion: Motion) -> Tensor:
    """Says where left and right ankles and then balls stand: bool (..., T, 4), of a motion's contacts or, as it has
    none, of its own."""
    labelled = motion if motion.contacts is not None else with_contacts(motion)
    return torch.cat([_stands(labelled, names) for names in (ANKLES, BALLS)], dim=-1)


def _stands(motion: Motion, names: tuple[str, ...], slow: bool = True) -> Tensor:
    skeleton, points = motion.skeleton, motion.positions[..., motion.skeleton.indices(names), :]
    columns = [skeleton.contact_names.index(name) for name in names]
    says = motion.contacts[..., columns] > _STANDS
    if not slow:
        return says
    rest = resting_heights(skeleton)[columns]
    return says | (contacts_from_positions(points, motion.fps, rest, height=(_LOW, _LOW), speed=_SLOW[names]) > 0)


def _place(points: Tensor, stands: Tensor, known: Tensor) -> Tensor:
    """The mean (B, T, F, 3) of points over the run of ``stands`` (B, T, F) that a frame is of; in a run with known
    frames (B, T, 1) where these are, and in a line between them."""
    begins = stands & ~pad(stands, (0, 0, 1, 0))[..., :-1, :]
    number = torch.where(stands, begins.cumsum(-2), 0)
    run = one_hot(number, stands.shape[-2] + 1).to(points)
    mean = torch.einsum("btfr,btfc->bfrc", run, points) / run.sum(-3)[..., None].clamp(min=1)
    mean = torch.einsum("btfr,bfrc->btfc", run, mean)
    fixed = stands & known
    if not fixed.any():
        return mean
    *sides, share = between_known(fixed)
    mine = [(number.gather(-2, at) == number) & fixed.gather(-2, at) & stands for at in sides]
    share = torch.where(mine[0] & mine[1], share.to(points), mine[1].to(points))[..., None]
    before, after = (points.gather(-3, at[..., None].expand_as(points)) for at in sides)
    return torch.where((mine[0] | mine[1])[..., None], torch.lerp(before, after, share), mean)


def _eased_in(shift: Tensor, known: Tensor, frames: float) -> Tensor:
    """shift (B, T, F, 3), 0 where known (B, T), without the velocity that it has there, which fades over so many
    frames: less v n (u^3 - 2 u^2 + u), from both sides of a gap."""
    time, (before, after) = torch.arange(known.shape[-1]), nearest_known(known)
    some = known.any(-1, keepdim=True)
    wide = torch.where((before < time) & (after > time), after - before, frames).clamp(min=1.0, max=max(frames, 1.0))
    less = torch.zeros_like(shift)
    for beside, away in ((before + 1, time - before), (after - 1, after - time)):
        speed = shift.gather(-3, beside.clamp(0, len(time) - 1)[..., None, None].expand_as(shift))
        u = (away / wide).clamp(0, 1)
        size = torch.where(some & (away > 0), wide * (u**3 - 2 * u**2 + u), 0.0)
        less = less + size[..., None, None] * speed
    return shift - less


def _lines(shift: Tensor, known: Tensor) -> Tensor:
    """``lines_between`` of (B, T, F, 3), known (B, T, F)."""
    known = known[..., None].expand_as(shift)
    return lines_between(shift.flatten(-2), known.flatten(-2)).unflatten(-1, shift.shape[-2:])


def _near(stands: Tensor) -> Tensor:
    """(B, T, F): up to ``_FADE`` frames from where it stands."""
    return max_pool1d(stands.mT.float(), 2 * _FADE + 1, 1, _FADE).mT > 0


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


def _with_feet_at(motion: Motion, heel: Tensor, ball: Tensor) -> Motion:
    """The motion with ankles at ``heel`` and feet that point to ``ball`` (B, T, 2, 3), as far as legs reach."""
    skeleton, size = motion.skeleton, motion.root.shape[:2]
    every = Motion(skeleton, motion.root.flatten(0, 1), motion.rot.flatten(0, 1), motion.fps)  # frames are alone
    made = two_bone_ik(every, heel.flatten(0, 1))
    knees, ankles, balls = (skeleton.indices(names) for names in (_KNEES, ANKLES, BALLS))
    before = every.positions[:, balls] - every.positions[:, ankles]
    turn = rotation.rotation_between(before, ball.flatten(0, 1) - made.positions[:, ankles])
    rot = made.rot.clone()
    rot[:, ankles] = made.world[1][:, knees].mT @ turn @ every.world[1][:, ankles]
    return replace(motion, rot=rot.unflatten(0, size))
