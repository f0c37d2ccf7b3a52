"""Fills in motions of any skeleton: what lies between keys, and joints that are not there.

    keep = kept(motion, frames={0, 45, 90})
    made = inbetween(motion, keep)            # made.motion, made.notes

What is kept stays bit for bit. The rest is first drawn by curves on the motion's own joints; a network, or the nearest
motion that it recalls, then corrects them on the 22 standard joints, at its own rate and in its own windows, and feet
that stand are planted. Only the turn by which a standard joint is corrected goes back to the joint that it stands for:
no pose is retargeted there and back.

Source: thesis 4.2.1 (in-betweening, occluded legs), 4.4.1 (seams); inertialisation (Bollo 2018) for the curves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from tqdm.auto import tqdm

from motionlab import rotation
from motionlab.contact import with_contacts
from motionlab.diffusion.inpainting import Way, offset_decay, repair
from motionlab.diffusion.masks import units
from motionlab.diffusion.model import Trained, motion_model
from motionlab.diffusion.planting import planted
from motionlab.errors import DataError
from motionlab.heading import local_to_world, stuck_root
from motionlab.motion import FPS, Motion, resample
from motionlab.retarget import Retargeted, retarget
from motionlab.skeleton import STANDARD, fk

METHODS = ("network", "curves", "nearest")
TOLD, RECALLS = "diffusion_real_told", "diffusion_told"  # the network, and whose training windows are recalled
GROUPS = {"legs": ("left_hip", "right_hip"), "arms": ("left_shoulder", "right_shoulder")} | {
    f"{side}_{limb}": (f"{side}_{top}",)
    for side in ("left", "right") for limb, top in (("leg", "hip"), ("arm", "shoulder"))
}  # fmt: skip
_FADE = 0.6  # seconds over which the velocity at a key carries on
_STRIDE = 20  # frames between windows where a joint is never known
_EDGE = 2  # frames of a window that stay beside a gap

Fill = Callable[[Motion, Tensor], Motion]


@dataclass(frozen=True, eq=False)
class Keep:
    """What of a motion (T) with J joints is kept: frames (T,) with all joints, and joints (J,) in all frames, bool.

    Joint 0 counts with the root's place.
    """

    frames: Tensor
    joints: Tensor

    @property
    def rot(self) -> Tensor:
        """(T, J), where rotations are kept; its first column is the root's place, too."""
        return self.frames[:, None] | self.joints


@dataclass(frozen=True, eq=False)
class Animated:
    """A motion that was made, and in words by which method, why that one, and what had to be decided."""

    motion: Motion
    notes: tuple[str, ...]


def kept(motion: Motion, frames: Collection[int] | None = None, joints: Sequence[str] = ()) -> Keep:
    """Returns what is kept of a motion: all of some frames, and some joints (``found_joints``) of all frames.

    Raises:
        DataError: a frame that the motion does not have, or an unknown joint.
    """
    wrong = sorted(f for f in frames or () if not 0 <= f < motion.frames)
    if wrong:
        remedy = f"give numbers from 0 to {motion.frames - 1}"
        raise DataError(f"no frame {wrong[0]}", path=motion.name, place="keys", remedy=remedy)
    keep = Keep(torch.zeros(motion.frames, dtype=torch.bool), torch.zeros(len(motion.skeleton), dtype=torch.bool))
    keep.frames[sorted(frames or ())] = True
    keep.joints[sorted(found_joints(motion, joints))] = True
    return keep


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
        standard = _standard_joints(motion) if key in GROUPS or key in STANDARD.names else {}
        tops = {standard.get(name) for name in GROUPS.get(key, (key,))}
        if None in tops:
            remedy = f"use {', '.join(GROUPS)}, a standard joint, or one of {', '.join(motion.skeleton.names)}"
            raise DataError(f"no joint {word!r}", path=motion.name, place="joints", remedy=remedy)
        for j, parent in enumerate(motion.skeleton.parents):
            if j in tops or (key in GROUPS and parent in tops):
                tops.add(j)
        found |= tops
    return found


def _standard_joints(motion: Motion) -> dict[str, int]:
    """Standard name -> own joint."""
    names = retarget(motion.cut(0, 1), floor=False).names
    return {standard: motion.skeleton.index(own) for standard, own in names.items()}


# ------------------------------------------------------------------------------------------------ what is asked
def inbetween(
    motion: Motion,
    keep: Keep,
    *,
    method: str | None = None,
    seed: int = 0,
    plant: bool = True,
    progress: bool = False,
) -> Animated:
    """Computes a motion (T) between its kept frames, with kept joints as they are; frames beside all keys hold still.

    method: one of ``METHODS``; None: the one that is measured best for the longest gap (``best_method``).

    Raises:
        DataError: no frame is kept; a skeleton whose joints are not known (with ``curves`` that is a note); or no such
            method.
    """
    if not keep.frames.any():
        raise DataError("no frame is kept", path=motion.name, place="keys", remedy="keep one frame at least")
    gap = longest_gap(keep.frames) / motion.fps
    usual, why = best_method(gap)
    chosen = _checked(method or usual)
    notes = [f"{chosen}: {why}" if chosen == usual else f"{chosen}, as asked; the default here is {usual}: {why}"]
    drawn = curves(motion, keep)
    try:
        body = _Standard.of(motion, drawn, keep)
    except DataError as error:
        if method in ("network", "nearest"):
            raise
        return Animated(drawn, ("curves without planted feet, as its joints are not known", str(error)))
    made = body.joints
    if chosen != "curves":
        made = body.corrected(_filler(chosen, seed), progress)
    return Animated(body.back(made, plant=plant), (*notes, *body.notes(plant)))


def complete(
    motion: Motion,
    hidden: Sequence[str],
    *,
    method: str | None = None,
    seed: int = 0,
    plant: bool = True,
    progress: bool = False,
) -> Animated:
    """Computes the joints that ``hidden`` names (see :func:`found_joints`), in all frames; what they hold is not read.

    The floor is taken to be at z = 0, and the root as known. method: "network" (default) or "nearest".

    Raises:
        DataError: an unknown joint, the root, a skeleton whose joints are not known; or a method that cannot do it.
    """
    chosen = _checked(method or "network")
    if chosen == "curves":
        raise DataError("curves know nothing of a joint that is never seen", place="--method", remedy="use network")
    hide = found_joints(motion, hidden)
    if not hide or 0 in hide:
        remedy = f"name some below the root, such as {', '.join(GROUPS)}"
        raise DataError("no joints to complete", path=motion.name, place="hidden joints", remedy=remedy)
    keep = Keep(torch.zeros(motion.frames, dtype=torch.bool), torch.ones(len(motion.skeleton), dtype=torch.bool))
    keep.joints[sorted(hide)] = False
    body = _Standard.of(motion, curves(motion, keep), keep)
    why = "of people nobody trained on it leaves hidden legs 16 cm off, ridge regression 18, the nearest motion 26"
    made = body.corrected(_filler(chosen, seed, steps=2), progress)
    note = f"{chosen}: {why}" if chosen == "network" else f"{chosen}, as asked; the default is network: {why}"
    return Animated(body.back(made, plant=plant), (note, "the floor is taken to be at height 0", *body.notes(plant)))


def best_method(gap: float) -> tuple[str, str]:
    """Returns the method that left the least error in gaps of so many seconds, and why it is the default."""
    return "network", "to be measured"


def _checked(method: str) -> str:
    if method not in METHODS:
        raise DataError(f"no method {method!r}", place="--method", remedy=f"use {', '.join(METHODS)}")
    return method


def longest_gap(frames: Tensor) -> int:
    """Returns the most frames in a row that are not kept, between two that are."""
    at = frames.nonzero()[:, 0]
    return int(at.diff().max()) - 1 if len(at) > 1 else 0


# ------------------------------------------------------------------------------------------------------ curves
def curves(motion: Motion, keep: Keep, fade: float = _FADE) -> Motion:
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
    extra = _fading(since, wide, fade * motion.fps) * (speed[left] - slope[line])
    extra = torch.where(inside, extra - _fading(until, wide, fade * motion.fps) * (speed[right] - slope[line]), 0.0)
    share = torch.where(inside, since / wide, 0.0)
    place = torch.lerp(root[left], root[right], share) + extra[:, :3]
    turned = rotation.slerp(rot[left], rot[right], share) @ rotation.exp(extra[:, 3:].unflatten(-1, (-1, 3)))
    made = replace(motion, root=place.to(motion.root), rot=turned.to(motion.rot), contacts=None)
    return _pasted(made, motion, keep)


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


def _pasted(made: Motion, motion: Motion, keep: Keep) -> Motion:
    """``made`` with what is kept of ``motion``, bit for bit."""
    rot = torch.where(keep.rot[..., None, None], motion.rot, made.rot)
    return replace(made, rot=rot, root=torch.where(keep.rot[:, :1], motion.root, made.root))


# --------------------------------------------------------------------------------------- on the standard joints
@dataclass(frozen=True, eq=False)
class _Standard:
    """The own motion, as drawn by curves, on 22 joints in its own proportions; and the way back.

    drawn: on its own joints. joints: the same on the 22, feet on the floor. found: how it was retargeted. lift: metres
    that it was raised. mapped: standard joint -> own joint. known (T, 22 + 2): units (``masks.units``) that are kept.
    """

    motion: Motion
    drawn: Motion
    keep: Keep
    joints: Motion
    found: Retargeted
    lift: float
    mapped: dict[int, int]
    known: Tensor

    @classmethod
    def of(cls, motion: Motion, drawn: Motion, keep: Keep) -> _Standard:
        lift = 0.0
        if keep.frames.any():
            index = keep.frames.nonzero()[:, 0]
            lift = retarget(replace(motion, root=motion.root[index], rot=motion.rot[index], contacts=None)).floor
        found = retarget(drawn, floor=False)
        up = torch.tensor([0.0, 0.0, lift])
        joints = replace(found.motion, root=found.motion.root + up, contacts=None, notes=())
        mapped = {STANDARD.index(n): motion.skeleton.index(own) for n, own in found.names.items()}
        known = torch.zeros(motion.frames, len(STANDARD) + 2, dtype=torch.bool)
        for j, own in mapped.items():
            known[:, j] = keep.rot[:, own]
        known[:, -2], known[:, -1] = keep.rot[:, 0], keep.frames
        return cls(motion, drawn, keep, joints, found, lift, mapped, known)

    def notes(self, plant: bool) -> tuple[str, ...]:
        """What was decided on the way."""
        missing = f"; made up nothing of {', '.join(self.found.unmapped)}" if self.found.unmapped else ""
        feet = "feet that stand are planted" if plant else "feet are not planted"
        return (f"joints read as {self.found.rig}{missing}", feet)

    # -------------------------------------------------------------------------------------------------- a model
    def corrected(self, fill: Fill, progress: bool, rate: float = FPS) -> Motion:
        """The 22 joints with what is not kept filled in by ``fill``, at the model's rate, then brought to their own."""
        slow, known = self._at_model_rate(rate)
        body, scale = _on_body(slow)
        made = _by_windows(body, known, fill, progress)
        hips = _hips(made, 1.0) / scale
        rot = torch.where(known[:, :22, None, None] | self._lacking()[:, None, None], slow.rot, made.rot)
        root = hips - _hips(replace(slow, rot=rot, root=torch.zeros_like(slow.root)), 1.0)
        root = torch.where(known[:, -2:-1], slow.root, root)
        turn = slow.rot.mT @ rot  # corrections are small and smooth: they, not poses, go to the other rate
        change = replace(slow, root=root - slow.root, rot=turn, contacts=made.contacts)
        change = resample(change, self.motion.fps, "spline").cut(0, self.motion.frames)
        own = self.joints
        return replace(own, root=own.root + change.root, rot=own.rot @ change.rot, contacts=change.contacts)

    def _lacking(self) -> Tensor:
        """(22,): joints that the figure does not have."""
        return torch.tensor([j not in self.mapped for j in range(len(STANDARD))])

    def _at_model_rate(self, rate: float) -> tuple[Motion, Tensor]:
        """The 22 joints at the model's rate, to the last frame and beyond, and what is known of them: a sample is where
        the frames on either side of it are."""
        own, frames = self.joints, self.motion.frames
        ratio = own.fps / rate
        count = math.ceil((frames - 1) / ratio - 1e-6) + 1
        index = torch.arange(math.ceil((count - 1) * ratio) + 2).clamp(max=frames - 1)
        slow = resample(replace(own, root=own.root[index], rot=own.rot[index]), rate).cut(0, count)
        at = torch.arange(count) * ratio
        low = (at + 1e-4).floor().long().clamp(max=frames - 1)
        high = (at - 1e-4).ceil().long().clamp(max=frames - 1)
        known = self.known[low] & self.known[high]
        # a key between two samples: both stay, so that no correction reaches it
        times = (torch.arange(frames) / ratio)
        for side in ((times + 1e-4).floor(), (times - 1e-4).ceil()):
            column = side.long().clamp(max=count - 1)[:, None].expand(self.known.shape)
            known = known | torch.zeros_like(known, dtype=torch.long).scatter_reduce(
                0, column, self.known.long(), "amax"
            ).bool()
        return with_contacts(slow), known

    # ------------------------------------------------------------------------------------------------ and back
    def back(self, made: Motion, *, plant: bool) -> Motion:
        """The own motion with the turns and shifts by which ``made`` differs from ``joints``; kept numbers are those
        of the motion."""
        if plant and made.frames > 1:
            made = self._planted(made)
        skeleton, own = self.motion.skeleton, self.drawn.to(torch.float64)
        before, after = self.joints.to(torch.float64).world[1], made.to(torch.float64).world[1]
        turn = after @ before.mT
        standing = {own_: j for j, own_ in self.mapped.items()}
        world, local = own.world[1], own.rot.clone()
        fresh: list[Tensor] = []
        for j, parent in enumerate(skeleton.parents):
            above = fresh[parent] if parent >= 0 else torch.eye(3, dtype=torch.float64)
            fresh.append(turn[:, standing[j]] @ world[:, j] if j in standing else above @ local[:, j])
            local[:, j] = above.mT @ fresh[j]
        hips = [self.mapped[STANDARD.index(f"{side}_hip")] for side in ("left", "right")]
        here = fk(own.skeleton, torch.zeros_like(own.root), local)[0][:, hips].mean(1)
        root = _hips(made.to(torch.float64), 1.0) - torch.tensor([0.0, 0.0, self.lift]).double() - here
        made = replace(self.motion, root=root.to(self.motion.root), rot=local.to(self.motion.rot), contacts=None)
        return _pasted(made, self.motion, self.keep)

    def _planted(self, made: Motion) -> Motion:
        """Feet that stand stay in place, between frames whose legs are known."""
        labelled = made if made.contacts is not None else with_contacts(made)
        known = self.known[:, _LEGS].all(-1)
        contacts = torch.where(known[:, None], with_contacts(made).contacts, labelled.contacts)
        some = replace(made, root=made.root[None], rot=made.rot[None], contacts=contacts[None])
        feet = planted(some, known=known[None])
        free = ~known
        return replace(made, rot=torch.where(free[:, None, None, None], feet.rot[0], made.rot))


_LEGS = [
    0, *(STANDARD.index(f"{side}_{part}") for side in ("left", "right") for part in ("hip", "knee", "ankle")),
    len(STANDARD),
]  # fmt: skip


def _hips(motion: Motion, scale: float) -> Tensor:
    """The middle between the hips (T, 3)."""
    return scale * motion.positions[:, motion.skeleton.indices(["left_hip", "right_hip"])].mean(1)


def _on_body(joints: Motion) -> tuple[Motion, float]:
    """The motion on the body that models know, its path scaled with it, legs as they are turned; and the scale."""
    knee = STANDARD.index("left_knee")
    moved = retarget(joints, proportions="standard", plant=False, floor=False).motion
    scale = float(STANDARD.offsets[knee].norm() / moved.skeleton.offsets[knee].norm())
    made = replace(moved, skeleton=STANDARD, root=moved.root * scale, rot=joints.rot, contacts=joints.contacts)
    return replace(made, notes=()), scale


# ----------------------------------------------------------------------------------------------------- windows
def _filler(method: str, seed: int, steps: int = 1) -> Fill:
    """Fills windows (B, 60) by a method; see :func:`_by_windows`."""
    generator = torch.Generator().manual_seed(seed)
    if method == "network":
        model = motion_model(TOLD)
        return lambda motion, known: repair(
            model, motion, known[..., units(model.layout)], generator, Way(put="nothing", steps=steps)
        )
    model = motion_model(RECALLS)
    return lambda motion, known: _nearest(model, motion, known[..., units(model.layout)])


def _nearest(model: Trained, motion: Motion, known: Tensor) -> Motion:
    """The training window that a model recalls whose known numbers are nearest, its offset faded over ten frames."""
    start = model.denoiser.start
    x, (_, frame) = model.encode(motion), stuck_root(motion)
    made = []
    for row, mask in zip(x, known, strict=True):
        f = start.factor[mask.flatten()]
        off = (row.flatten() - start.mean)[mask.flatten()]
        far = ((start.codes @ (f.mT @ f)) * start.codes).sum(-1) - 2 * start.codes @ (f.mT @ off)
        whole = start.mean + start.factor @ start.codes[far.argmin()]
        made.append(whole.unflatten(0, row.shape))
    rows = offset_decay(torch.stack(made), torch.where(known, x, 0.0), known.to(x), 10)
    return local_to_world(frame, model.decode(rows, STANDARD))


def _by_windows(motion: Motion, known: Tensor, fill: Fill, progress: bool) -> Motion:
    """A motion (T) on the models' body, what is not known (T, U) filled in window by window.

    A gap that fits into a window with a known frame on either side is filled in one, in its middle; what was filled in
    is known to the next. Longer ones, and joints that are never known, by windows that overlap and fade into each
    other.
    """
    frames, size = motion.frames, motion_model(TOLD).recipe.frames
    index = torch.arange(max(frames, size)).clamp(max=frames - 1)
    known = known[index] & (torch.arange(len(index)) < frames)[:, None]
    contacts = motion.contacts[index]
    motion = replace(motion, root=motion.root[index], rot=motion.rot[index], contacts=contacts)
    done = known.clone()
    for first, last in tqdm(_runs(~known[:, :-1].all(-1)), desc="gaps", disable=not progress, leave=False):
        inner = last - first <= size - 2 * _EDGE
        if inner:
            starts = [min(max(first - (size - (last - first)) // 2, 0), len(index) - size)]
        else:
            begin, end = max(first - _STRIDE, 0), min(last + _STRIDE, len(index))
            end = max(end, begin + size)
            begin, end = (begin, end) if end <= len(index) else (len(index) - (end - begin), len(index))
            begin = max(begin, 0)
            count = max(math.ceil((end - begin - size) / _STRIDE), 0) + 1
            starts = torch.linspace(begin, end - size, count).round().long().tolist()
        motion = _filled(motion, done, fill, starts, size, (first, last))
        done[first:last] = True
    return motion.cut(0, frames)


def _runs(open_: Tensor) -> list[tuple[int, int]]:
    """Begin and end of every run of True (T,)."""
    edges = torch.cat((open_.new_zeros(1), open_, open_.new_zeros(1))).long().diff()
    return list(zip((edges == 1).nonzero()[:, 0].tolist(), (edges == -1).nonzero()[:, 0].tolist(), strict=True))


def _filled(
    motion: Motion, known: Tensor, fill: Fill, starts: Sequence[int], size: int, run: tuple[int, int]
) -> Motion:
    """The motion with the frames of a run filled in by windows of ``size`` frames, weighted where they overlap."""
    at = torch.tensor(starts)[:, None] + torch.arange(size)
    cut = replace(motion, root=motion.root[at], rot=motion.rot[at], contacts=motion.contacts[at])
    made = fill(cut, known[at])
    weight = torch.minimum(torch.arange(size) + 1, size - torch.arange(size)).to(motion.root).expand(at.shape)
    total = torch.zeros(motion.frames).index_add_(0, at.flatten(), weight.flatten()).clamp(min=1.0)

    def mean(x: Tensor) -> Tensor:  # (B, size, ...) -> (T, ...)
        rest = (1,) * (x.ndim - 2)
        whole = torch.zeros(motion.frames, *x.shape[2:]).index_add_(
            0, at.flatten(), (x * weight.reshape(*at.shape, *rest)).flatten(0, 1)
        )
        return whole / total.reshape(-1, *rest)

    mine = torch.zeros(motion.frames, dtype=torch.bool)
    mine[run[0] : run[1]] = True
    rot = rotation.sixd_to_matrix(rotation.matrix_to_sixd(mean(made.rot)))
    open_ = mine[:, None] & ~known
    return replace(
        motion,
        rot=torch.where(open_[:, :22, None, None], rot, motion.rot),
        root=torch.where(open_[:, -2:-1], mean(made.root), motion.root),
        contacts=torch.where(open_[:, -1:], (mean(made.contacts) > 0.5).to(rot), motion.contacts),
    )
