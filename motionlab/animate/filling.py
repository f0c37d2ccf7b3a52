"""Fills in motions of any skeleton: what lies between keys, and joints that are not there.

    keep = key_mask(motion, frames={0, 45, 90})
    made = inbetween(motion, keep)            # made.motion, made.notes

What is not kept is first drawn by curves on the motion's own joints; a network then corrects them (``corrections``),
and feet that stand are planted.

Source: thesis 4.2.1 (in-betweening, occluded legs), 4.4.1 (seams); inertialisation (Bollo 2018) for the curves.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.animate.corrections import LEGS, Fill, KeyMask, Rig, by_windows, restore_keys
from motionlab.diffusion import completer
from motionlab.errors import DataError
from motionlab.motion import FPS, Motion, runs
from motionlab.rigs import find_joints
from motionlab.skeleton import BALLS, STANDARD

METHODS = ("network", "curves")
NETWORK, DRAWS = "completer", "completer_draws"  # of one answer, and of draws
GROUPS = {"legs": ("left_hip", "right_hip"), "arms": ("left_shoulder", "right_shoulder")}
GROUPS |= {f"{side}_{limb}": (f"{side}_{top}",) for side in ("left", "right")
           for limb, top in (("leg", "hip"), ("arm", "shoulder"))}  # fmt: skip
_FADE = (2.0, 0.8)  # seconds over which the velocity at a key carries on, of the root and of joints
_MOST = 40  # frames of a window that a gap should take: a longer one is shown to the network faster than it is
_MEASURED = 2.5  # seconds of the longest gaps that were measured, and a little


@dataclass(frozen=True, eq=False)
class Animated:
    """A motion that was made, and in words by which method, why that one, and what had to be decided."""

    motion: Motion
    notes: tuple[str, ...]


def key_mask(motion: Motion, frames: Collection[int] | None = None, joints: Sequence[str] = ()) -> KeyMask:
    """Returns what is kept of a motion: all of some frames, and some joints (``found_joints``) of all frames.

    Raises:
        DataError: a frame that the motion does not have, or an unknown joint.
    """
    wrong = sorted(f for f in frames or () if not 0 <= f < motion.frames)
    if wrong:
        remedy = f"give numbers from 0 to {motion.frames - 1}"
        raise DataError(f"no frame {wrong[0]}", path=motion.name, place="keys", remedy=remedy)
    keep = KeyMask.of(motion)
    keep.frames[sorted(frames or ())] = True
    keep.joints[sorted(found_joints(motion, joints))] = True
    return keep


def frames_named(text: str, frames: int, place: str = "--keys") -> set[int]:
    """Reads frame numbers such as ``0,45,60-last`` of a motion of so many frames, from what ``place`` names.

    Raises:
        DataError: what is no number or range; names it.
    """
    found: set[int] = set()
    for word in filter(None, text.replace(" ", "").split(",")):
        ends = [
            frames - 1 if end == "last" else int(end) if end.isdecimal() and len(end) < 10 else None
            for end in word.split("-")
        ]
        if None in ends or len(ends) > 2 or ends[0] > ends[-1]:
            remedy = "write frames from 0 and ranges, as 0,45,60-last"
            raise DataError(f"{word!r} is no frame", place=place, remedy=remedy)
        if ends[-1] >= frames:
            raise DataError(f"no frame {ends[-1]}", place=place, remedy=f"give numbers from 0 to {frames - 1}")
        found |= set(range(ends[0], ends[-1] + 1))
    if not found:
        raise DataError("no frame is kept", place=place, remedy="write frames from 0, as 0,45,last")
    return found


def found_joints(motion: Motion, words: Sequence[str]) -> set[int]:
    """Returns the joints meant by words: own names, standard ones, or ``GROUPS`` with everything below.

    Raises:
        DataError: a word that names no joint of this skeleton; lists those there are.
    """
    own = {name.lower(): j for j, name in enumerate(motion.skeleton.names)}
    found: set[int] = set()
    for word in words:
        key = word.strip().lower()
        if key in own:
            found.add(own[key])
            continue
        standard = find_joints(motion.skeleton, motion.name) if key in GROUPS or key in STANDARD.names else {}
        tops = {standard.get(name) for name in GROUPS.get(key, (key,))}
        if None in tops:
            near = get_close_matches(key, [*GROUPS, *STANDARD.names, *own], 1)
            remedy = f"did you mean {near[0]}? Or " if near else ""
            remedy += f"use {', '.join(GROUPS)}, a standard joint, or one of {', '.join(motion.skeleton.names)}"
            raise DataError(f"no joint {word!r}", path=motion.name, place="joints", remedy=remedy)
        for j, parent in enumerate(motion.skeleton.parents):
            if j in tops or (key in GROUPS and parent in tops):
                tops.add(j)
        found |= tops
    return found


def inbetween(
    motion: Motion, keep: KeyMask, *, method: str | None = None, seed: int | None = None, plant: bool = True
) -> Animated:
    """Computes a motion (T) between its kept frames, with kept joints as they are.

    Before the first kept frame and behind the last one curves hold the pose; the network goes on from motion that is
    kept there.

    method: one of ``METHODS``; None: the one that is measured best for the longest gap (``_usual_method``). seed: the
    network draws one of the motions that are possible; None: it gives the one answer that is closest on average.

    Raises:
        DataError: no frame is kept; a skeleton whose joints are not known (with ``curves`` that is a note); or no such
            method.
    """
    if not keep.frames.any():
        raise DataError("no frame is kept", path=motion.name, place="keys", remedy="keep one frame at least")
    if method not in (None, *METHODS):
        raise DataError(f"no method {method!r}", place="--method", remedy=f"use {', '.join(METHODS)}")
    gap, beyond = (frames / motion.fps for frames in _unkept(keep.frames))  # seconds
    usual, why = _usual_method(gap, beyond)
    chosen = method or (usual if seed is None else "network")
    if keep.frames.all():
        return Animated(motion, ("every frame is kept: nothing is made",))
    asked = "" if chosen == usual else f", as asked; the default here is {usual}"
    seed = seed if chosen == "network" else None
    notes = [f"method: {chosen}{asked}{why and f', because {why}'}", *_of_draw(seed)]
    notes += ["one frame is kept: all others hold its pose"] * (int(keep.frames.sum()) == 1)
    drawn = curves(motion, keep)
    try:
        body = Rig.of(motion, drawn, keep)
    except DataError as error:
        if method == "network":
            raise
        return Animated(drawn, ("method: curves, without planted feet, as its joints are not known", str(error)))
    made = body.joints
    if chosen != "curves":
        rate = min(FPS, _MOST / gap) if gap else FPS
        made = body.corrected(network(seed, body.missing_joints), rate=rate)
    return Animated(body.to_own_rig(made, plant=plant), (*notes, *body.notes(plant)))


def completed(motion: Motion, hidden: Sequence[str], *, seed: int | None = None, plant: bool = True) -> Animated:
    """Computes the joints that ``hidden`` names (see :func:`found_joints`), in all frames; what they hold is not read.

    The floor is taken to be at z = 0, and the root as known. seed: as of :func:`inbetween`.

    Raises:
        DataError: an unknown joint, the root, or a skeleton whose joints are not known.
    """
    hide = found_joints(motion, hidden)
    if not hide or 0 in hide:
        remedy = f"name some below the root, such as {', '.join(GROUPS)}"
        raise DataError("no joints to complete", path=motion.name, place="hidden joints", remedy=remedy)
    keep = KeyMask.of(motion, hidden=hide)
    body = Rig.of(motion, curves(motion, keep), keep)
    why = "how close these joints come to the true ones was not measured"
    if hide >= {own for j, own in body.mapped.items() if STANDARD.names[j] in (*LEGS, *BALLS)}:
        why = "hidden legs came out 13 cm off on 17 people whom it had never seen"
    made = body.corrected(network(seed, body.missing_joints))
    notes = (f"method: network; {why}", *_of_draw(seed), "the floor is taken to be at height 0", *body.notes(plant))
    return Animated(body.to_own_rig(made, plant=plant), notes)


def _of_draw(seed: int | None) -> tuple[str, ...]:
    return () if seed is None else (f"drawn with seed {seed}: livelier than people are, most so in long gaps",)


def network(seed: int | torch.Generator | None, missing: Tensor) -> Fill:
    """Returns what fills a motion (T) on the models' body by one answer (seed None), or by a draw.

    missing (22,): joints that the figure does not have.
    """
    if seed is None:
        return by_windows(completer.load(NETWORK).complete, missing)
    model = completer.load(DRAWS)
    draws = torch.Generator().manual_seed(seed) if isinstance(seed, int) else seed
    return by_windows(lambda motion, known: model.complete(motion, known, draws), missing, onward=True)


def _usual_method(gap: float, beyond: float) -> tuple[str, str]:
    """Returns the default in gaps of so many seconds, and so many beyond motion that is kept, and why: as
    ``bench_inbetween`` measured on 15 people; nothing where there is neither."""
    if not gap and not beyond:
        return "curves", ""
    if max(gap, beyond) > _MEASURED:
        why = f"more than {_MEASURED:g} s in one gap or beyond the keys was not measured: expect feet to glide"
        return "curves", why
    if beyond > gap:
        return "network", "it moves on beyond the keys: half a second later it is 14 cm off, standing still 18 cm"
    why = "in gaps of 0.5 s its joints are as close as those of curves, in gaps of 1 and 2 s closer on average: 7.9 and"
    return "network", f"{why} 20 cm off, not 9.9 and 21 (straight from key to key: 15 and 27)"


def _unkept(frames: Tensor) -> tuple[int, int]:
    """The most frames in a row that are not kept between two that are, and at either end, beside two or more."""
    kept_runs = runs(frames)
    gap = max((after - end for (_, end), (after, _) in pairwise(kept_runs)), default=0)
    (begin, end), (start, stop) = kept_runs[0], kept_runs[-1]
    return gap, max(begin * (end - begin > 1), (len(frames) - stop) * (stop - start > 1))


def curves(motion: Motion, keep: KeyMask, fade: tuple[float, float] = _FADE) -> Motion:
    """Computes a motion (T) whose frames between kept ones lie on smooth curves on its own joints; no other is read.

    Lines between the keys around, in places and 6-D rotations, plus from either side what the velocity there differs
    from the line's, fading out as a cubic over ``fade`` seconds. The velocity at a key is that to a kept neighbour, or
    of a lone one the mean of both lines'. Before the first key and behind the last the pose holds. A joint that is
    never kept rests.
    """
    if not keep.frames.any():
        rot = torch.where(keep.joints[:, None, None], motion.rot, torch.eye(3).to(motion.rot))
        return replace(motion, rot=rot, contacts=None)
    keys, time = keep.frames.nonzero()[:, 0], torch.arange(motion.frames)
    root, rot = motion.root[keys].double(), motion.rot[keys].double()
    width = keys.diff().double()[:, None]
    turn = rotation.log(rot[:-1].mT @ rot[1:])
    slope = torch.cat((root.diff(dim=0), turn.flatten(1)), -1) / width
    speed = _speeds(slope, width)
    left = (torch.searchsorted(keys, time, right=True) - 1).clamp(0, len(keys) - 1)
    right = (left + 1).clamp(max=len(keys) - 1)
    if len(keys) < 2:
        slope, width = torch.zeros_like(speed), torch.ones(1, 1).double()
    line, wide = left.clamp(max=len(slope) - 1), width[left.clamp(max=len(width) - 1)]
    since, until = (time - keys[left]).double()[:, None], (keys[right] - time).double()[:, None]
    inside = (since > 0) & (until > 0)
    extra = torch.zeros_like(slope[line])
    for part, seconds in zip((slice(0, 3), slice(3, None)), fade, strict=True):
        for key, away, sign in ((left, since, 1), (right, until, -1)):
            off = (speed[key] - slope[line])[:, part]
            extra[:, part] += sign * _fading(away, wide, seconds * motion.fps) * off
    extra = torch.where(inside, extra, 0.0)
    share = torch.where(inside, since / wide, 0.0)
    place = torch.lerp(root[left], root[right], share) + extra[:, :3]
    turned = rotation.slerp(rot[left], rot[right], share) @ rotation.exp(extra[:, 3:].unflatten(-1, (-1, 3)))
    made = replace(motion, root=place.to(motion.root), rot=turned.to(motion.rot), contacts=None)
    return restore_keys(made, motion, keep)


def _speeds(slope: Tensor, width: Tensor) -> Tensor:
    """Velocities per frame (K, D) at keys from those between them (K - 1, D), ``width`` (K - 1, 1) frames apart."""
    weight = torch.where(width == 1, 1.0, 1e-9)  # a neighbour next to a key decides alone
    zero = slope.new_zeros(1, slope.shape[1])
    total = torch.cat((slope * weight, zero)) + torch.cat((zero, slope * weight))
    return total / (torch.cat((weight, zero[:, :1])) + torch.cat((zero[:, :1], weight))).clamp(min=1e-12)


def _fading(since: Tensor, width: Tensor, fade: float) -> Tensor:
    """What a velocity of 1 at a key adds so many frames on (T, 1), in a gap of ``width``: n (u^3 - 2 u^2 + u)."""
    n = width.clamp(max=max(fade, 1.0))
    u = (since / n).clamp(0, 1)
    return n * (u**3 - 2 * u**2 + u)


def editor(path: str | Path, backend: str | None = None, **how):
    """Builds the widget of :func:`inbetween` for a file; see ``keyframes.editor``."""
    from motionlab.animate import keyframes  # it draws: imported by who opens it

    return keyframes.editor(path, backend, **how)
