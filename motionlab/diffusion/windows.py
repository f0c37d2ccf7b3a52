"""Training windows: cut from motions at any frame, also mirrored; and masks of their known parts, as models learn them.

Source: CondMDI (Cohan et al. 2024), random frames x random joints; the test cases of thesis 4.2.1.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from motionlab.diffusion.features import UNITS
from motionlab.errors import DataError, ShapeError
from motionlab.motion import Motion, mirror
from motionlab.retarget import retarget
from motionlab.skeleton import STANDARD

_EDGE = 5  # known frames on either side of what lies between
_APART = (4, 45)  # frames from one lone key to the next
_KINDS = ("nothing", "frames", "gap", "between", "onward", "keys", "joints", "entries", "legs")
LEGS = ("hip", "knee", "ankle", "foot")


@dataclass(frozen=True, eq=False)
class Windows:
    """All frames of many motions in one row.

    root (N, 3) metres, rot (N, 22, 3, 3), contacts (N, 9) or None; offsets (C, 22, 3) metres, one body per motion;
    clip (N,): the motion of each frame. begins (M,): the frames from which ``length`` frames lie inside one motion.
    mirrored: every second window drawn, by chance, is seen in the mirror. seen (C, 22): False where a motion lacks a
    joint (or its mirror image), so that its rotation is made up and teaches nothing; None: all were recorded. people
    (C,): whose each motion is: windows are drawn evenly by person, then by begin; None: by begin.
    """

    root: Tensor
    rot: Tensor
    contacts: Tensor | None
    offsets: Tensor
    clip: Tensor
    begins: Tensor
    length: int
    fps: float
    mirrored: bool = True
    seen: Tensor | None = None
    people: Tensor | None = None

    def draw(self, count: int, generator: torch.Generator) -> Motion:
        """Draws windows (count, length) evenly over begins, or people, each with its own body, mirrored at random."""
        return self.drawn(count, generator)[0]

    def drawn(self, count: int, generator: torch.Generator) -> tuple[Motion, Tensor]:
        """Draws windows as :meth:`draw`, and returns the motions (count,) that they are of, too."""
        begin = self._begins(count, generator)
        motion, clips = self.cut(begin), self.clip[begin]
        if self.mirrored:
            flip = torch.rand(count, generator=generator) < 0.5
            other = mirror(motion.clip(flip))
            for mine, seen in (
                (motion.root, other.root), (motion.rot, other.rot), (motion.contacts, other.contacts),
                (motion.skeleton.offsets, other.skeleton.offsets),
            ):  # fmt: skip
                if mine is not None:
                    mine[flip] = seen
        return motion, clips

    def _begins(self, count: int, generator: torch.Generator) -> Tensor:
        if self.people is None:
            return self.begins[torch.randint(len(self.begins), (count,), generator=generator)]
        order, first, each = self._by_person
        person = torch.randint(len(each), (count,), generator=generator)
        nth = (torch.rand(count, generator=generator, dtype=torch.float64) * each[person]).long()
        return self.begins[order[first[person] + nth]]

    @cached_property
    def _by_person(self) -> tuple[Tensor, Tensor, Tensor]:
        """The begins in the order of people, where each person's start there, and how many they are."""
        whose = torch.unique(self.people[self.clip[self.begins]], return_inverse=True)[1]
        each = whose.bincount()
        return whose.argsort(stable=True), each.cumsum(0) - each, each

    def evenly(self, count: int) -> Motion:
        """Returns at most ``count`` windows, evenly over all begins, none mirrored: the same at every call."""
        return self.cut(spread(self.begins, count))

    def cut(self, begin: Tensor) -> Motion:
        """Returns the windows (B, length) that begin at these frames (B,)."""
        at = begin[:, None] + torch.arange(self.length)
        skeleton = replace(STANDARD, offsets=self.offsets[self.clip[begin]][:, None])
        contacts = None if self.contacts is None else self.contacts[at]
        return Motion(skeleton, self.root[at], self.rot[at], self.fps, contacts)

    @property
    def digest(self) -> str:
        """A hash of all numbers, for the recipe."""
        whole = hashlib.sha256(repr((self.length, self.fps, self.mirrored, self.contacts is None)).encode())
        for x in (self.root, self.rot, self.contacts, self.offsets, self.clip, self.seen, self.people):
            whole.update(b"" if x is None else x.numpy().tobytes())
        return whole.hexdigest()[:16]


def spread(items: Tensor, count: int) -> Tensor:
    """Returns at most ``count`` items (N,), evenly from the first to the last."""
    return items[torch.linspace(0, len(items) - 1, min(count, len(items))).round().long()]


def gather(
    motions: Sequence[Motion], length: int, *, mirrored: bool = True, missing: Sequence[Sequence[str]] | None = None,
    people: Sequence[str] | None = None,
) -> Windows:  # fmt: skip
    """Cuts windows of ``length`` frames from motions at one frame rate, all with contacts or none; drops shorter ones.

    missing: for every motion the joints whose rotations were not recorded; None: none is missing. people: for every
    motion whose it is; windows are then drawn evenly by person.

    Raises:
        DataError: no motion is that long; frame rates differ; some have contacts and some not; numbers are not finite.
        ShapeError: a motion is not on the 22 joints, or has batch axes.
    """
    every = zip(motions, missing or [()] * len(motions), people or [""] * len(motions), strict=True)
    long = [row for row in every if row[0].frames >= length]
    if not long:
        raise DataError(f"no motion has {length} frames", remedy="give longer motions")
    used, lacks, whose = zip(*long, strict=True)
    for m in used:
        if m.skeleton.names != STANDARD.names or m.rot.ndim != 4:
            raise ShapeError(f"{m.name or 'motion'}: expected one clip on the 22 joints; retarget first")
        if m.fps != used[0].fps or (m.contacts is None) != (used[0].contacts is None):
            remedy = "motion.resample, contact.with_contacts"
            raise DataError("another frame rate than the first, or only one has contacts", place=m.name, remedy=remedy)
        if not (m.root.isfinite().all() and m.rot.isfinite().all()):
            raise DataError("numbers that are not finite", place=m.name, remedy="leave this motion out")
    seen = torch.tensor([[name not in names for name in STANDARD.names] for names in lacks])
    numbers = {name: k for k, name in enumerate(dict.fromkeys(whose))}
    counts = torch.tensor([m.frames for m in used])
    starts = counts.cumsum(0) - counts
    return Windows(
        root=torch.cat([m.root for m in used]).float(),
        rot=torch.cat([m.rot for m in used]).float(),
        contacts=None if used[0].contacts is None else torch.cat([m.contacts for m in used]).float(),
        offsets=torch.stack([m.skeleton.offsets.reshape(-1, 3) for m in used]).float(),
        clip=torch.repeat_interleave(torch.arange(len(used)), counts),
        begins=torch.cat([at + torch.arange(n - length + 1) for at, n in zip(starts, counts, strict=True)]),
        length=length,
        fps=used[0].fps,
        mirrored=mirrored,
        seen=seen & seen[:, STANDARD.mirror_indices] if any(lacks) else None,
        people=None if people is None else torch.tensor([numbers[name] for name in whose]),
    )


def on_standard(motion: Motion) -> Motion:
    """Computes the motion on the standard body: retargeted with feet planted, then scaled, path and all, to its size.

    Source: thesis 4.1.2: "retargeted to a standard skeleton". Contacts stay as they were labelled.
    """
    moved = retarget(motion, proportions="standard").motion
    here, there = (s.offsets[s.index("left_knee")].norm() for s in (moved.skeleton, STANDARD))
    return replace(moved, skeleton=STANDARD, root=moved.root * (there / here), contacts=motion.contacts)


def draw_units(frames: int, count: int, generator: torch.Generator, kinds: Mapping[str, float]) -> Tensor:
    """Draws masks (count, frames, U) over the units of a frame, bool, True where known; each window's kind is drawn by
    its odds.

    nothing: all is unknown. frames: whole frames, each by the window's own chance. gap: all but a run of frames, which
    may reach either end; between: which has ``_EDGE`` known frames or more on either side, in windows that are longer.
    onward: all behind some first frames. keys: lone frames, as far apart as animators' keys. joints: some joints, in
    all frames. entries: other joints in every frame. legs: all but both legs, with or without the root's place.
    Contacts are known with whole frames only.

    Raises:
        ValueError: an unknown kind, or odds that are not positive.
    """
    if not kinds or set(kinds) - set(_KINDS) or not all(odds > 0 for odds in kinds.values()):
        raise ValueError(f"kinds: expected odds above 0 for some of {', '.join(_KINDS)}, got {dict(kinds)}")
    chosen = torch.multinomial(torch.tensor(list(kinds.values())), count, replacement=True, generator=generator)
    names = list(kinds)
    found = [_drawn(names[kind], frames, generator) for kind in chosen.tolist()]
    return torch.stack([mask.expand(frames, UNITS).bool() for mask in found])


def _drawn(kind: str, frames: int, generator: torch.Generator) -> Tensor:
    """A mask (frames or 1, U or 1) of one kind."""

    def number(low: int, high: int) -> int:
        return int(torch.randint(low, high, (), generator=generator))

    def chance(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    time = torch.arange(frames)[:, None]
    if kind == "nothing":
        return torch.zeros(1, 1)
    if kind == "frames":
        return chance(frames, 1) < chance(1)
    if kind == "gap":
        length = number(1, max(frames, 2))  # at least a frame stays known
        start = number(0, frames - min(length, frames) + 1)
        return (time < start) | (time >= start + length)
    if kind == "between":
        inside = _drawn("gap", max(frames - 2 * _EDGE, 1), generator)
        before = (frames - len(inside)) // 2
        return pad(inside, (0, 0, before, frames - before - len(inside)), value=True)
    if kind == "onward":
        return time < number(1, max(frames, 2))
    if kind == "keys":
        apart = number(_APART[0], _APART[1] + 1)
        return (time - number(0, min(apart, frames))) % apart == 0
    if kind == "legs":
        known = torch.ones(1, UNITS, dtype=torch.bool)
        known[:, [j for j, name in enumerate(STANDARD.names) if name.endswith(LEGS)]] = False
        known[:, -2] = chance() < 0.5
    else:
        known = chance(1 if kind == "joints" else frames, UNITS) < chance(1)
    known[:, -1] = False
    return known
