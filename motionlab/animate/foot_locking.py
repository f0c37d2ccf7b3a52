"""Locks feet to the floor where they stand (footskate cleanup), by inverse kinematics of the legs, and turns feet that
glide through a gap into steps.

Where the ball of a foot or an ankle is said to stand, or is low and slow, it stands. Every run of such frames gets one
place, the mean of where the ball was in it. In between, the shift of the ball goes in a line from one run to the next.
The ankle stays at its own mean as far as the foot's length lets it; what it needs besides the shift fades at its run's
ends. Where the leg is too short the heel lifts, the ball stays. Hip and knee bend by two-bone inverse kinematics.

What a model or a curve fills in is a mean of what may happen: where people take a step at some moment, it glides. Who
stands before a gap and stands elsewhere behind it has stepped; so a foot that is said to stand but travels does not
stand in the middle of its way (:func:`steps`), and one that goes from place to place goes off the floor
(:func:`lift`).

Source: Kovar et al. 2002, "Footskate cleanup for motion capture editing".
Differs: runs get their mean place, the root never moves, and a ball out of reach of leg and foot is approached, not
reached. Numbers of steps: of recordings of validation people, at 30 frames per second; lengths in legs where nothing
else is said.
"""

import math
from dataclasses import replace
from itertools import pairwise, product

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, normalize, pad

from motionlab import rotation
from motionlab.baselines import lines_between, nearest_known
from motionlab.contact import contacts_from_positions, resting_heights, with_contacts
from motionlab.errors import DataError, ShapeError
from motionlab.ik import two_bone_ik
from motionlab.motion import Motion, runs
from motionlab.skeleton import ANKLES, BALLS

_STANDS = 0.5  # of a contact: more is one
_LOW = 0.2  # metres above where a joint rests: lower and slow, it stands, too
_SLOW = {ANKLES: (0.25, 0.5), BALLS: (0.35, 0.7)}  # m/s, strict and loose (``contact.contacts_from_positions``)
_RAISED = 0.1  # metres above where an ankle should rest: so high, at most, it may rest in known frames
_FADE = 4  # frames beside a run in which a foot turns to lie flat
_STRETCHED = 0.998  # of a straight leg: longer is out of reach, unless it was
_STRIDE = 1.2  # legs that a foot goes in one step
_TRAVELS = 0.1  # legs: a foot that stands before and behind a gap, farther apart than this, stepped between
_SECONDS = (0.25, 0.3)  # that a step takes, and so much more per leg
_TURNS = 0.2  # of a step's way, by which the foot ahead steps later, the other earlier
_HIGH, _HIGHEST = 0.12, 0.08  # a step rises to so much of its length, at most to so much of a leg
_LEAST, _SHORT = 0.05, 0.5  # and to so many metres at least, or where it is short to so much of its length
_RISES = 0.22  # of its time, in which it rises, and sinks
_SOFT = 0.03  # metres: what lies so much higher already is hardly lifted
_EASE = 0.2  # seconds beside known frames over which feet that step set in
_HIPS, _KNEES = ("left_hip", "right_hip"), ("left_knee", "right_knee")


def lock_feet(motion: Motion, *, slow: bool = True, known: Tensor | None = None, step: bool = False) -> Motion:
    """Computes motions (B, T) on one body whose feet stay in place wherever their contacts say so.

    slow: and where they are low and slow: motion that was filled in knows its contacts no better than its legs, and
    what stands on a step has none. A sample, whose contacts were made with its legs, only grows calmer by that.
    known: bool (B, T), frames whose feet are right already: they stay, and a run stands where its known frames do.
    step: for motion that was filled in between known frames, of which each has some: what glides there steps, off the
    floor.

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
    right = torch.zeros_like(heel_down) if known is None else known[..., None].expand_as(heel_down)
    leg = float((thigh + shin).mean())
    if step:
        swings = steps(ball, heel_down | ball_down, right, leg, motion.fps)
        heel_down, ball_down = heel_down & ~swings, ball_down & ~swings
    at_heel, shift = _place(ankle, heel_down, right) - ankle, _place(ball, ball_down, right) - ball
    shift = _lines(torch.where(right[..., None], 0.0, shift), ball_down | right)
    flat = torch.where((heel_down & ~right)[..., None], at_heel - shift, 0.0)
    flat = _lines(flat, (heel_down & ~_near(right)) | ~_near(heel_down) | right)
    heel, there = ankle + shift + flat, ball + shift
    if step:  # off the floor, which is where known ankles that stand are lowest
        rest, sure = resting_heights(skeleton)[[skeleton.contact_names.index(n) for n in ANKLES]], right & heel_down
        lowest = torch.where(sure, ankle[..., 2], torch.inf).amin(1).clamp(max=rest + _RAISED)
        rest = torch.where(sure.any(1), lowest, rest)
        heel, there = lift(torch.stack((heel, there)), heel_down | ball_down, right, rest, leg, motion.fps)
        heel, there = (x + _eased_in(y - x, known, _EASE * motion.fps) for x, y in ((ankle, heel), (ball, there)))
    heel = there + foot[:, None] * normalize(heel - there, dim=-1)
    longest = torch.maximum(_STRETCHED * (thigh + shin), (ankle - hip).norm(dim=-1))
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
    """The mean of points (B, T, F, 3) over the run of ``stands`` (B, T, F) that a frame is of; in a run with known
    frames (B, T, F) where these are, and in a line between them."""
    made = torch.zeros_like(points)
    for clip, foot in product(range(stands.shape[0]), range(stands.shape[2])):
        for first, end in runs(stands[clip, :, foot]):
            run = (clip, slice(first, end), foot)
            here, sure = points[run], known[run][:, None]
            made[run] = lines_between(here, sure.expand_as(here)) if sure.any() else here.mean(0)
    return made


def _eased_in(shift: Tensor, known: Tensor, frames: float) -> Tensor:
    """shift (B, T, F, 3), 0 where known (B, T), without the velocity that it has there, which fades over so many
    frames: less v n (u^3 - 2 u^2 + u), from both sides of a gap."""
    time, (before, after) = torch.arange(known.shape[-1]), nearest_known(known)
    wide = torch.where((before < time) & (after > time), after - before, frames).clamp(max=frames)
    less = torch.zeros_like(shift)
    for beside, away in ((before + 1, time - before), (after - 1, after - time)):
        speed = shift.gather(1, beside.clamp(0, len(time) - 1)[..., None, None].expand_as(shift))
        u = (away / wide).clamp(0, 1)
        less += (wide * (u**3 - 2 * u**2 + u))[..., None, None] * speed
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


def steps(points: Tensor, stands: Tensor, known: Tensor, leg: float, fps: float) -> Tensor:
    """Says in which frames feet step that are said to stand and travel too far for one place: bool (B, T, 2).

    points: of both feet (B, T, 2, 3), whose ways count on the floor. stands: bool (B, T, 2), said. known: bool
    (B, T, 2), frames that are right already. leg: metres.
    """
    found = torch.zeros_like(stands)
    for clip, foot in product(range(len(stands)), range(2)):
        sure = pad((stands & known)[clip, :, foot], (1, 1))
        for begin, end in runs((stands & ~known)[clip, :, foot]):
            held = [bool(sure[begin]), bool(sure[end + 1])]
            first = begin - held[0]
            way = points[clip, first : end + held[1], foot, :2].double()
            far = float((way[-1] - way[0]).norm()) / leg
            count = max(round(far / _STRIDE), int(all(held) and far > _TRAVELS))
            path = way.diff(dim=0).norm(dim=-1).cumsum(0)
            before, after = (0.0 if h else 0.5 for h in held)  # of a stride: there it comes, or goes, on the move
            ahead = float((points[clip, first, foot] - points[clip, first, 1 - foot])[:2].double() @ (way[-1] - way[0]))
            turn = _TURNS if ahead > 0 or (ahead == 0 and foot) else -_TURNS
            for k in range(count):
                stride = float(path[-1]) / (count + before + after)
                middle = first + 1 + int((path < stride * (before + k + 0.5 + turn)).sum())
                half = (_SECONDS[0] + _SECONDS[1] * stride / leg) * fps / 2
                found[clip, max(round(middle - half), begin) : min(round(middle + half) + 1, end), foot] = True
    return found


def lift(feet: Tensor, stands: Tensor, known: Tensor, rest: Tensor, leg: float, fps: float) -> Tensor:
    """Computes ankles and balls (2, B, T, 2, 3), metres, z up, of feet that leave the floor as they go from place to
    place, from ones that may drag.

    Where a foot neither ``stands`` nor is known, bool (B, T, 2), its way over the floor is eased, its height at least a
    step's. If that is less time than a step takes, the foot leaves earlier and arrives later. rest: (B, 2) heights of
    ankles on the floor, metres. leg: metres.
    """
    feet = feet.clone()
    for clip, foot in product(range(len(stands)), range(2)):
        on, sure, way = stands[clip, :, foot], known[clip, :, foot], feet[:, clip, :, foot]
        for a, b in _moves(on, sure):
            far = float((way[0, b] - way[0, a])[:2].norm())
            first, last = _longer((a, b), round((_SECONDS[0] + _SECONDS[1] * far / leg) * fps), on & ~sure)
            high = min(max(_HIGH * far, min(_LEAST, _SHORT * far)), _HIGHEST * leg)
            u, inside = torch.arange(1, last - first) / (last - first), slice(first + 1, last)
            faster = min((last - first) / (b - a), 3.0)  # more would go there and back
            begins, ends = faster * sure[first], faster * sure[last]  # what is known goes on as fast as it came
            share = 3 * u**2 - 2 * u**3 + begins * (u**3 - 2 * u**2 + u) + ends * (u**3 - u**2)
            when = a + (b - a) * share
            low = when.floor().long().clamp(0, way.shape[1] - 2)
            ball = torch.lerp(way[1, low], way[1, low + 1], (when - low)[:, None])
            way[:, inside, :2] += (ball - way[1, inside])[:, :2]  # a heel rolls up, and comes down, when it did
            rise = (torch.minimum(u, 1 - u) / _RISES).clamp(max=1)
            bump = 3 * rise**2 - 2 * rise**3
            lacks = rest[clip, foot] + high * bump - way[0, inside, 2]
            way[:, inside, 2] += bump * (lacks + (lacks**2 + _SOFT**2).sqrt()) / 2
    return feet


def _moves(stands: Tensor, known: Tensor) -> list[tuple[int, int]]:
    """The frames between which a foot goes: it stands or is known there, bool (T,), and not in between."""
    at = (stands | known).nonzero()[:, 0].tolist()
    together = (stands[:-1] & stands[1:]) | (known[:-1] & known[1:])
    return [(a, b) for a, b in pairwise(at) if b - a > 1 or not together[a]]


def _longer(ends: tuple[int, int], frames: int, spare: Tensor) -> tuple[int, int]:
    """``ends`` moved apart, towards so many frames, by what is to spare on either side, bool (T,); half of it stays."""
    free = [(int(side.long().cumprod(0).sum()) - 1) // 2 for side in (spare[: ends[0] + 1].flip(0), spare[ends[1] :])]
    lacks = max(frames - (ends[1] - ends[0]), 0)
    each = math.ceil(lacks / max(sum(n > 0 for n in free), 1))
    return ends[0] - max(min(each, free[0]), 0), ends[1] + max(min(each, free[1]), 0)
