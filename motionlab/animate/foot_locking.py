"""Locks feet to the floor where they stand (footskate cleanup), by inverse kinematics of the legs, and turns feet that
glide through a gap into steps: they stand, swing and rise.

Where the ball of a foot or an ankle is said to stand, or is low and slow, it stands. Every run of such frames gets one
place, the mean of where the ball was in it. In between, the shift of the ball goes in a line from one run to the next.
The ankle stays at its own mean as far as the foot's length lets it; what it needs besides the shift fades at its run's
ends. Where the leg is too short the heel lifts, the ball stays. Hip and knee bend by two-bone inverse kinematics.

What a model or a curve fills in is a mean of what may happen: where people take a step at some moment, it glides. Who
stands before a gap and stands elsewhere behind it has stepped; so a foot that is said to stand but travels is timed
anew along its own way (:func:`retime`), and one that goes from place to place goes off the floor (:func:`lift`).

Source: Kovar et al. 2002, "Footskate cleanup for motion capture editing".
Differs: runs get their mean place, the root never moves, and a ball out of reach of leg and foot is approached, not
reached. Numbers of steps: of recordings of validation people, at 30 frames per second; lengths in legs where nothing
else is said.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, normalize, one_hot, pad

from motionlab import rotation
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
_STRIDE = 1.2  # legs that a foot goes in one step
_TRAVELS = 0.1  # legs: a foot that stands before and behind a gap, farther apart than this, stepped between
_SECONDS = (0.25, 0.3)  # that a step takes, and so much more per leg
_TURNS = 0.2  # of a step's way, by which feet that step together are moved apart in time
_HIGH, _HIGHEST = 0.12, 0.08  # a step rises to so much of its length, at most to so much of a leg
_LEAST, _SHORT = 0.05, 0.5  # and to so many metres at least, or where it is short to so much of its length
_RISES = (0.15, 0.25, 0.4)  # of its time, in which it rises, and sinks
_SOFT = 0.04  # metres: what lies so much higher already is hardly lifted
_PEEL = 0.07  # seconds before a step in which the heel rises already
_DRAGS = 0.035  # metres above where it rests: lower, an ankle that moves drags
_HASTE = 2 / 30**2  # metres of dragging that one m/s^2 of acceleration weighs
_STRAIGHT = 0.985  # of a leg: farther a step does not reach, as a knee that straightens at once pops
_HIPS, _KNEES = ("left_hip", "right_hip"), ("left_knee", "right_knee")


def lock_feet(
    motion: Motion, *, slow: bool = True, known: Tensor | None = None, ease: float = 0.0, step: bool = False
) -> Motion:
    """Computes motions (B, T) on one body whose feet stay in place wherever their contacts say so.

    slow: and where they are low and slow: motion that was filled in knows its contacts no better than its legs, and
    what stands on a step has none. A sample, whose contacts were made with its legs, only grows calmer by that.
    known: bool (B, T), frames whose feet are right already: they stay, and a run stands where its known frames do.
    step: for motion that was filled in between known frames: what glides there steps, off the floor.
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
        when, anew, moving = retime(ball, heel_down | ball_down, right, leg, motion.fps)
        shift = torch.where(anew[..., None], at_times(ball, when) - ball, shift)
        at_heel = torch.where(anew[..., None], at_times(ankle, when) - ankle, at_heel)
    shift = _lines(shift, ball_down | right | anew)
    flat = torch.where(((heel_down | anew) & ~right)[..., None], at_heel - shift, 0.0)
    flat = _lines(flat, (heel_down & ~_near(right)) | ~_near(heel_down | anew) | right | anew)
    there, heel = ball + shift, ankle + shift + flat
    if step:  # off the floor, which is where known ankles that stand are lowest
        rest, sure = resting_heights(skeleton)[[skeleton.contact_names.index(n) for n in ANKLES]], right & heel_down
        lowest = torch.where(sure, ankle[..., 2], torch.inf).amin(1).clamp(max=rest + _RAISED)
        rest = torch.where(sure.any(1), lowest, rest)
        still, legs = (heel_down | ball_down) & ~moving, torch.stack((hip, heel, there))
        _, heel, there = lift(legs, still, right.expand_as(still), rest, leg, motion.fps)
        heel, there = (x + _eased_in(y - x, right[..., 0], ease) for x, y in ((ankle, heel), (ball, there)))
    heel = there + foot[:, None] * normalize(heel - there, dim=-1)
    longest = torch.maximum((_STRAIGHT if step else _STRETCHED) * (thigh + shin), (ankle - hip).norm(dim=-1))
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


_Ends = tuple[int, int]  # the frames between which a foot goes


@dataclass(frozen=True)
class _Glide:
    """Frames first to last of a clip's foot that is said to stand and travels. q: share of its way at each. rests:
    shares of the way where it comes to rest, n + 1 of them. length: metres."""

    clip: int
    foot: int
    first: int
    last: int
    q: Tensor
    rests: Tensor
    length: float


def retime(points: Tensor, stands: Tensor, known: Tensor, leg: float, fps: float) -> tuple[Tensor, Tensor, Tensor]:
    """Computes when feet are where: (B, T, F) times along their own ways, the frames that are timed anew, and of these
    those of a step, bool (B, T, F).

    points: of the feet (B, T, F, 3), whose ways count on the floor. stands: bool (B, T, F), said. known: bool
    (B, T, 1), frames that are right already. leg: metres.
    """
    when = torch.arange(stands.shape[1], dtype=torch.float64)[:, None].repeat(len(stands), 1, stands.shape[2])
    anew, moving = torch.zeros_like(stands), torch.zeros_like(stands)
    glides = _glides(points, stands, known.expand_as(stands), leg)
    for glide in glides:
        inside = torch.arange(glide.first, glide.last + 1, dtype=torch.float64)
        share, steps = torch.full_like(inside, float(glide.rests[0])), torch.zeros_like(inside, dtype=torch.bool)
        middle = 0.5 + _TURNS * _turn(glide, glides, points)
        for a, b in zip(glide.rests[:-1].tolist(), glide.rests[1:].tolist(), strict=True):
            long = min((_SECONDS[0] + _SECONDS[1] * (b - a) * glide.length / leg) * fps, glide.last - glide.first)
            at = float(inside[(glide.q >= a + middle * (b - a)).long().argmax()])
            at = min(max(at, glide.first + long / 2), glide.last - long / 2)
            u = ((inside - at) / long + 0.5).clamp(0, 1)
            share += (3 * u**2 - 2 * u**3) * (b - a)
            steps |= (u > 0) & (u < 1)
        high = torch.searchsorted(glide.q, share).clamp(1, len(inside) - 1)
        part = (share - glide.q[high - 1]) / (glide.q[high] - glide.q[high - 1]).clamp(min=1e-9)
        mine = (glide.clip, slice(glide.first, glide.last + 1), glide.foot)
        open_ = ~known[glide.clip, mine[1], 0]
        when[mine] = torch.where(open_, glide.first + high - 1 + part.clamp(0, 1), when[mine])
        anew[mine], moving[mine] = anew[mine] | open_, moving[mine] | (open_ & steps)
    return when, anew, moving


def _glides(points: Tensor, stands: Tensor, known: Tensor, leg: float) -> list[_Glide]:
    """The runs of ``stands`` between known frames that travel too far for one place."""
    found = []
    edges = pad((stands & ~known).mT.long(), (1, 1)).diff()
    ends = [(edges == way).nonzero().tolist() for way in (1, -1)]
    for (clip, foot, begin), (_, _, end) in zip(*ends, strict=True):
        sure = pad((stands & known)[clip, :, foot], (1, 1))
        held = [bool(sure[begin]), bool(sure[end + 1])]
        first, last = begin - held[0], end - 1 + held[1]
        way = points[clip, first : last + 1, foot, :2].double()
        far = float((way[-1] - way[0]).norm()) / leg
        count = round(far / _STRIDE)
        if all(held) and far > _TRAVELS:
            count = max(count, 1)
        if count < 1 or last - first < 3:
            continue
        path = pad(way.diff(dim=0).norm(dim=-1).cumsum(0), (1, 0))
        spare = [0.0 if h else 0.5 for h in held]  # of a stride: there it comes, or goes, on the move
        rests = (torch.arange(count + 1).double() + spare[0]) / (count + sum(spare))
        found.append(_Glide(clip, foot, first, last, path / path[-1], rests, float(path[-1])))
    return found


def _turn(glide: _Glide, glides: list[_Glide], points: Tensor) -> int:
    """-1 for the foot that steps first of two that glide together: the one behind; 1 for the other, 0 alone."""
    for other in glides:
        both = min(glide.last, other.last) - max(glide.first, other.first)
        if other.clip == glide.clip and other.foot != glide.foot and both > 0.5 * (glide.last - glide.first):
            mine = points[glide.clip, :, glide.foot, :2]
            ahead = (mine - points[glide.clip, :, other.foot, :2])[glide.first]
            side = float((ahead * (mine[glide.last] - mine[glide.first])).sum())
            return 1 if side > 0 or (side == 0 and glide.foot > other.foot) else -1
    return 0


def at_times(x: Tensor, when: Tensor) -> Tensor:
    """Computes x (B, T, F, 3) at times (B, T, F), linear between frames."""
    low = when.floor().long().clamp(0, x.shape[1] - 1)
    a, b = (x.gather(1, at[..., None].expand_as(x)) for at in (low, (low + 1).clamp(max=x.shape[1] - 1)))
    return torch.lerp(a, b, (when - low).to(x)[..., None])


def lift(legs: Tensor, stands: Tensor, known: Tensor, rest: Tensor, leg: float, fps: float) -> Tensor:
    """Computes hips, ankles and balls (3, B, T, F, 3), metres, z up, of feet that leave the floor as they go from place
    to place, from ones that may drag.

    Where a foot neither ``stands`` nor is known, bool (B, T, F), it goes its own way: as it is, or eased and lifted,
    whichever drags and hurries least (:func:`_badness`). If that is less time than a step takes, the foot leaves
    earlier and arrives later. rest: (B, F) heights of ankles on the floor, metres. leg: metres.
    """
    legs, peel = legs.clone(), round(_PEEL * fps)
    for clip, foot in product(range(stands.shape[0]), range(stands.shape[2])):
        on, sure = stands[clip, :, foot], known[clip, :, foot]
        for ends in _moves(on, sure):
            far = float((legs[1, clip, ends[1], foot] - legs[1, clip, ends[0], foot])[:2].norm())
            first, last = _longer(ends, round((_SECONDS[0] + _SECONDS[1] * far / leg) * fps), on & ~sure)
            start = max(first - peel - 2, 0)
            cut = (clip, slice(start, last + 3), foot)
            old, new = ((a - start, b - start) for a, b in (ends, (first, last)))
            high = min(max(_HIGH * far, min(_LEAST, _SHORT * far)), _HIGHEST * leg)
            begin = max(new[0] - peel, 0) if not sure[max(first - peel, 0) : first + 1].any() else new[0]
            ways = _ways(legs[:, *cut], sure[cut[1]], old, new, begin, high, rest[clip, foot])
            legs[:, *cut] = min(ways, key=lambda way: _badness(way, rest[clip, foot], leg, fps))
    return legs


def _moves(stands: Tensor, known: Tensor) -> list[_Ends]:
    """The frames between which a foot goes: it stands or is known there, bool (T,), and not in between."""
    at = (stands | known).nonzero()[:, 0].tolist() if len(stands) > 2 else []
    together = (stands[:-1] & stands[1:]) | (known[:-1] & known[1:])
    return [(a, b) for a, b in pairwise(at) if b - a > 1 or not together[a]]


def _longer(ends: _Ends, frames: int, spare: Tensor) -> _Ends:
    """``ends`` moved apart, towards so many frames, by what is to spare on either side, bool (T,); half of it stays."""
    free = [(int(side.long().cumprod(0).sum()) - 1) // 2 for side in (spare[: ends[0] + 1].flip(0), spare[ends[1] :])]
    lacks = max(frames - (ends[1] - ends[0]), 0)
    each = math.ceil(lacks / max(sum(n > 0 for n in free), 1))
    return ends[0] - max(min(each, free[0]), 0), ends[1] + max(min(each, free[1]), 0)


def _ways(
    way: Tensor, known: Tensor, old: _Ends, new: _Ends, begin: int, high: float, rest: Tensor
) -> Iterator[Tensor]:
    """Ways (3, N, 3) of hip, ankle and ball: the given one, and with what lies between the frames ``old`` eased over
    those between ``new`` and lifted so high above where the ankle rests, the heel from ``begin`` on."""
    time, (first, last) = torch.arange(way.shape[1], dtype=torch.float64), new
    u = ((time - first) / (last - first)).clamp(0, 1)
    stretch = min((last - first) / (old[1] - old[0]), 3.0)  # more would go there and back
    slope = [stretch * known[end] for end in new]  # what is known goes on as fast as it came
    share = 3 * u**2 - 2 * u**3 + slope[0] * (u**3 - 2 * u**2 + u) + slope[1] * (u**3 - u**2)
    when = torch.where((u > 0) & (u < 1), old[0] + (old[1] - old[0]) * share, time)
    moved = at_times(way[None, 2, :, None], when[None, :, None])[0, :, 0] - way[2]
    moved[:, 2] = 0
    eased = way[1:] + moved  # on the floor, as its ball: a heel rolls up, and comes down, when it did
    yield way
    for rise in _RISES:
        heel, ball = (_bump(time, start, last, rise) for start in (begin, first))
        lacks = high * ball - (eased[0, :, 2] - rest)
        lift = (lacks + (lacks**2 + _SOFT**2).sqrt()) / 2 * torch.stack((heel, ball))
        yield torch.cat((way[:1], eased + pad(lift[..., None], (2, 0)).to(eased)))


def _bump(time: Tensor, first: int, last: int, rise: float) -> Tensor:
    """0 up to ``first`` and from ``last`` on, 1 between, which it reaches and leaves in ``rise`` of the time."""
    u = (torch.minimum(time - first, last - time) / ((last - first) * rise)).clamp(0, 1)
    return 3 * u**2 - 2 * u**3


def _badness(way: Tensor, rest: Tensor, leg: float, fps: float) -> float:
    """Metres that an ankle (of 3, N, 3) goes while it is low; and how hasty it is, and the knee."""
    low = way[1, :, 2] < rest + _DRAGS
    slid = (way[1].diff(dim=0)[:, :2].norm(dim=-1) * (low[1:] & low[:-1])).sum()
    reach = (way[1] - way[0]).norm(dim=-1).clamp(max=_STRAIGHT * leg)
    knee = (leg**2 - reach**2).sqrt() / 2  # from the line between hip and ankle
    haste = way[1].diff(n=2, dim=0).norm(dim=-1).amax() + knee.diff(n=2).abs().amax()
    return float(slid + _HASTE * fps**2 * haste)
