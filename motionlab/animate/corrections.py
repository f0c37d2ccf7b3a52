"""Runs a model on a motion of any skeleton: retarget, fill in windows, transfer the change back.

The motion is retargeted in its own proportions; a model fills in what is not kept; and only the turn by which a
standard joint was corrected goes back to the joint that it stands for, so that no pose is retargeted there and back.
What is kept stays bit for bit.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.animate.foot_locking import lock_feet
from motionlab.contact import with_contacts
from motionlab.motion import FPS, Motion, resample, runs
from motionlab.retarget import Retargeted, match_joints, retarget
from motionlab.skeleton import STANDARD, fk

WINDOW = 60  # frames that models see
_STRIDE = 20  # frames between windows where a joint is never known
_EDGE = 2  # frames of a window that stay beside a gap
_PAST = 20  # frames that a window of a draw goes on from

Fill = Callable[[Motion, Tensor], Motion]  #: (motions, known (..., U)) -> motions, on the body that models know


@dataclass(frozen=True, eq=False)
class KeyMask:
    """Mask of what an edit must keep: frames (T,) with all joints, and joints (J,) in all frames, bool.

    Joint 0 counts with the root's place.
    """

    frames: Tensor
    joints: Tensor

    @classmethod
    def of(cls, motion: Motion, frames: Tensor | None = None, hidden: Collection[int] | None = None) -> Self:
        """Returns what is kept of a motion: these frames; and, where some joints are hidden, all others."""
        joints = torch.full((len(motion.skeleton),), hidden is not None)
        joints[sorted(hidden or ())] = False
        return cls(torch.zeros(motion.frames, dtype=torch.bool) if frames is None else frames, joints)

    @property
    def rot(self) -> Tensor:
        """(T, J), where rotations are kept; its first column is the root's place, too."""
        return self.frames[:, None] | self.joints


def restore_keys(made: Motion, motion: Motion, keep: KeyMask) -> Motion:
    """Puts what is kept of ``motion`` into ``made``, bit for bit."""
    rot = torch.where(keep.rot[..., None, None], motion.rot, made.rot)
    return replace(made, rot=rot, root=torch.where(keep.rot[:, :1], motion.root, made.root))


@dataclass(frozen=True, eq=False)
class Rig:
    """A motion of any skeleton, as drawn by curves, on the 22 joints in its own proportions; and the way back.

    drawn: on its own joints. joints: the same on the 22, feet on the floor. found: how it was retargeted. lift: metres
    that it was raised. mapped: standard joint -> own joint. known (T, 22 + 2): units (of ``features``) that are kept.
    """

    motion: Motion
    drawn: Motion
    keep: KeyMask
    joints: Motion
    found: Retargeted
    lift: float
    mapped: dict[int, int]
    known: Tensor

    @classmethod
    def of(cls, motion: Motion, drawn: Motion, keep: KeyMask, lift: float = 0.0) -> Self:
        """Makes it by retargeting what curves have drawn. lift: metres up to the floor, where no frame is kept to tell.

        Raises:
            DataError: a skeleton whose joints are not known.
        """
        body = match_joints(motion)
        if keep.frames.any():
            lift = retarget(replace(motion.clip(keep.frames), contacts=None), body=body).floor
        found = retarget(drawn, floor=False, body=body)
        up = torch.tensor([0.0, 0.0, lift])
        joints = replace(found.motion, root=found.motion.root + up, contacts=None, notes=())
        mapped = {STANDARD.index(name): own for name, own in body.joints.items()}
        known = torch.zeros(motion.frames, len(STANDARD) + 2, dtype=torch.bool)
        known[:, list(mapped)] = keep.rot[:, list(mapped.values())]
        known[:, -2], known[:, -1] = keep.rot[:, 0], keep.frames
        return cls(motion, drawn, keep, joints, found, lift, mapped, known)

    def notes(self, plant: bool) -> tuple[str, ...]:
        """Returns what was decided on the way."""
        missing = f"; the file has no {', '.join(self.found.unmapped)}, so none is made" if self.found.unmapped else ""
        feet = "feet that stand are held in place" if plant else "feet that stand may slide: they are not planted"
        return (f"joints recognised: {len(self.mapped)} of {len(STANDARD)}{missing}", feet)

    def corrected(self, fill: Fill, *, rate: float = FPS) -> Motion:
        """Computes the 22 joints with what is not kept filled in by ``fill``, at their own rate again.

        rate: frames per second that ``fill`` is shown as its own; less: more seconds in a window.
        """
        slow, known = self.at_model_rate(rate)
        body, scale = on_model_body(slow)
        made = fill(body, known)
        hips = _hips(made) / scale
        rot = torch.where(known[:, :22, None, None] | self.missing_joints[:, None, None], slow.rot, made.rot)
        root = hips - _hips(replace(slow, rot=rot, root=torch.zeros_like(slow.root)))
        root = torch.where(known[:, -2:-1], slow.root, root)
        # smooth: this, not poses, goes to the other rate
        change = replace(slow, root=root - slow.root, rot=slow.rot.mT @ rot, contacts=made.contacts)
        change = resample(change, self.motion.fps, "spline").cut(0, self.motion.frames)
        own = self.joints
        return replace(own, root=own.root + change.root, rot=own.rot @ change.rot, contacts=change.contacts)

    @property
    def missing_joints(self) -> Tensor:
        """(22,): joints that the figure does not have."""
        return torch.tensor([j not in self.mapped for j in range(len(STANDARD))])

    def at_model_rate(self, rate: float = FPS) -> tuple[Motion, Tensor]:
        """Returns the 22 joints at the model's rate, to the last frame and beyond, and what is known of them.

        A sample is known where the frames on either side of it are.
        """
        own, frames = self.joints, self.motion.frames
        ratio = own.fps / rate
        count = math.ceil((frames - 1) / ratio - 1e-6) + 1
        index = torch.arange(math.ceil((count - 1) * ratio) + 2).clamp(max=frames - 1)
        slow = resample(own.clip(index), rate).cut(0, count)
        at = torch.arange(count) * ratio
        low = (at + 1e-4).floor().long().clamp(max=frames - 1)
        high = (at - 1e-4).ceil().long().clamp(max=frames - 1)
        known = self.known[low] & self.known[high]
        # a key between two samples: both stay, so that no correction reaches it
        times = torch.arange(frames) / ratio
        for side in ((times + 1e-4).floor(), (times - 1e-4).ceil()):
            column = side.long().clamp(max=count - 1)[:, None].expand(self.known.shape)
            known = known.long().scatter_reduce(0, column, self.known.long(), "amax").bool()
        return with_contacts(slow), known

    def to_own_rig(self, made: Motion, *, plant: bool) -> Motion:
        """Computes the own motion with the turns and shifts by which ``made`` differs from ``joints``; what is kept is
        the motion's."""
        if plant and made.frames > 1:
            made = self._feet_locked(made)
        skeleton, own = self.motion.skeleton, self.drawn.to(torch.float64)
        turn = made.to(torch.float64).world[1] @ self.joints.to(torch.float64).world[1].mT
        standing = {own_: j for j, own_ in self.mapped.items()}
        world, local = own.world[1], own.rot.clone()
        fresh: list[Tensor] = []
        for j, parent in enumerate(skeleton.parents):
            above = fresh[parent] if parent >= 0 else torch.eye(3, dtype=torch.float64)
            fresh.append(turn[:, standing[j]] @ world[:, j] if j in standing else above @ local[:, j])
            local[:, j] = above.mT @ fresh[j]
        hips = [self.mapped[STANDARD.index(f"{side}_hip")] for side in ("left", "right")]
        here = fk(own.skeleton, torch.zeros_like(own.root), local)[0][:, hips].mean(1)
        root = _hips(made.to(torch.float64)) - torch.tensor([0.0, 0.0, self.lift]).double() - here
        made = replace(self.motion, root=root.to(self.motion.root), rot=local.to(self.motion.rot), contacts=None)
        return restore_keys(made, self.motion, self.keep)

    def _feet_locked(self, made: Motion) -> Motion:
        """Feet that stand stay in place, between frames whose legs are known; between kept frames they step."""
        known, found = self.known[:, [0, *STANDARD.indices(LEGS), len(STANDARD)]].all(-1), with_contacts(made).contacts
        contacts = found if made.contacts is None else torch.where(known[:, None], found, made.contacts)
        some, step = replace(made, contacts=contacts).clip(None), bool(self.keep.frames.any())
        return replace(made, rot=lock_feet(some, known=known[None], step=step).rot[0])


LEGS = [f"{side}_{part}" for side in ("left", "right") for part in ("hip", "knee", "ankle")]


def _hips(motion: Motion) -> Tensor:
    """The middle between the hips (T, 3)."""
    return motion.positions[:, motion.skeleton.indices(["left_hip", "right_hip"])].mean(1)


def on_model_body(joints: Motion) -> tuple[Motion, float]:
    """Returns the 22 joints on the body that models know, the path scaled with it, legs as they are turned; and by how
    much it is larger there."""
    knee = STANDARD.index("left_knee")
    moved = retarget(joints, proportions="standard", plant=False, floor=False).motion
    scale = float(STANDARD.offsets[knee].norm() / moved.skeleton.offsets[knee].norm())
    made = replace(moved, skeleton=STANDARD, root=moved.root * scale, rot=joints.rot, contacts=joints.contacts)
    return replace(made, notes=()), scale


def by_windows(fill: Fill, missing: Tensor, *, onward: bool = False) -> Fill:
    """Returns what fills a whole motion (T) by a fill of windows (B, 60), in what is not known.

    A gap that fits into a window with a known frame on either side is filled in one, in its middle; what was filled in
    is known to the next. Longer ones, and joints that are never known, by windows that overlap and fade into each
    other; onward: one after the other, each going on from what was filled in before, as draws have to: their mean is
    none. missing (22,): joints that the figure does not have; nothing is ever told of them.
    """

    def filled(motion: Motion, known: Tensor) -> Motion:
        frames, has = motion.frames, torch.cat((~missing, torch.ones(2, dtype=torch.bool)))
        index = torch.arange(max(frames, WINDOW)).clamp(max=frames - 1)  # a window at least: its last frame, unknown
        motion, known = motion.clip(index), known[index] & (torch.arange(len(index)) < frames)[:, None]
        done = known.clone()
        for first, last in runs(~(known | ~has)[:, :-1].all(-1)):
            while first < last:
                starts, stop = _next(first, last, motion.frames, onward)
                motion = _filled_in(motion, done, fill, starts, (first, stop))
                done[first:stop] = has
                first = stop
        return motion.cut(0, frames)

    return filled


def _next(first: int, last: int, frames: int, onward: bool) -> tuple[list[int], int]:
    """Where windows begin that fill a gap from ``first`` on, and up to where they do."""
    if last - first <= WINDOW - 2 * _EDGE:
        return [min(max(first - (WINDOW - (last - first)) // 2, 0), frames - WINDOW)], last
    if not onward:
        return overlapping(max(first - _STRIDE, 0), min(last + _STRIDE, frames), frames), last
    most = WINDOW - min(first, _PAST)
    far = min(last - first, most) if last == frames or last - first > 2 * most else (last - first) // 2
    return [min(max(first - _PAST, 0), frames - WINDOW)], first + far


def overlapping(begin: int, end: int, frames: int) -> list[int]:
    """Returns where windows begin that cover begin to end, at most ``_STRIDE`` frames apart, inside the frames."""
    begin = max(min(begin, frames - WINDOW), 0)
    last = max(end - WINDOW, begin)
    return torch.linspace(begin, last, math.ceil((last - begin) / _STRIDE) + 1).round().long().tolist()


def _filled_in(motion: Motion, known: Tensor, fill: Fill, starts: Sequence[int], run: tuple[int, int]) -> Motion:
    """The motion (T) with the frames of a run filled in by windows, which fade into each other where they overlap."""
    at, rise = torch.tensor(starts)[:, None] + torch.arange(WINDOW), torch.arange(WINDOW)
    made = fill(motion.clip(at), known[at])
    weight = torch.minimum(rise + 1, WINDOW - rise).to(made.root).expand(at.shape)
    total = torch.zeros(motion.frames).index_add_(0, at.flatten(), weight.flatten()).clamp(min=1.0)

    def mean(x: Tensor) -> Tensor:  # (B, 60, ...) -> (T, ...)
        part = x * weight.reshape(*at.shape, *(1,) * (x.ndim - 2))
        whole = torch.zeros(motion.frames, *x.shape[2:]).index_add_(0, at.flatten(), part.flatten(0, 1))
        return whole / total.reshape(-1, *(1,) * (x.ndim - 2))

    open_ = ~known
    open_[: run[0]] = open_[run[1] :] = False
    rot = rotation.sixd_to_matrix(rotation.matrix_to_sixd(mean(made.rot)))
    rot = torch.where(open_[:, :-2, None, None], rot, motion.rot)
    contacts = torch.where(open_[:, -1:], (mean(made.contacts) > 0.5).to(rot), motion.contacts)
    return replace(motion, rot=rot, root=torch.where(open_[:, -2:-1], mean(made.root), motion.root), contacts=contacts)
