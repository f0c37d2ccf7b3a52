"""Clips of two seconds of the people of the CMU library, and parts of what a camera saw."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from motionlab import corpus, splits
from motionlab.corpus import Corpus, Take
from motionlab.motion import Motion
from motionlab.observation import Observation2D

FRAMES = 60


@lru_cache(maxsize=1)
def recorded(folder: Path | str) -> Corpus:
    """Reads the clean stretches of all recordings in a folder, once a notebook."""
    return corpus.assemble(folder, splits.real_sources(folder), progress=False)


@lru_cache(maxsize=8)
def takes(folder: Path | str, part: str) -> tuple[Take, ...]:
    """Loads the recordings of the CMU library's people of one part, longer than a clip."""
    found = recorded(folder).part(part)
    return tuple(t for t in found if t.source == "cmu_library" and t.motion.frames > FRAMES)


def whole(some: Sequence[Take], frames: int = FRAMES) -> dict[str, list[Motion]]:
    """Cuts takes into clips, one after the other, by person."""
    found: dict[str, list[Motion]] = {}
    for take in some:
        starts = range(0, take.motion.frames - frames + 1, frames)
        found.setdefault(take.person, []).extend(take.motion.cut(start, start + frames) for start in starts)
    return found


def everyday(some: Sequence[Take], count: int) -> list[tuple[str, Motion]]:
    """Returns ``count`` clips of whatever people do, and who they are, as evenly over people as can be."""
    by_person = whole(some)
    each = -(-count // len(by_person))
    pairs = [(who, m) for who, motions in by_person.items() for m in splits.subsample(motions, each + 2)[1:-1]]
    return splits.subsample(pairs, count)


def begun(
    some: Sequence[Take], fits: Callable[[Motion], Tensor], generator: torch.Generator, each: int, most: int
) -> list[tuple[str, Motion]]:
    """Returns clips that begin where ``fits`` (starts,) is true, at most ``each`` a person and ``most`` in all.
    Beginnings are drawn; clips of one take do not overlap."""
    found: dict[str, list[Motion]] = {}
    for take in some:
        starts = fits(take.motion).nonzero().flatten()
        while len(starts):
            at = int(starts[torch.randint(len(starts), (), generator=generator)])
            found.setdefault(take.person, []).append(take.motion.cut(at, at + FRAMES))
            starts = starts[(starts - at).abs() >= FRAMES]
    return splits.subsample([(who, m) for who, motions in found.items() for m in splits.subsample(motions, each)], most)


def goes(motion: Motion, metres: float = 1.5) -> Tensor:
    """(starts,) true where the pelvis goes farther in the clip."""
    return (motion.root[FRAMES - 1 :, :2] - motion.root[: motion.frames - FRAMES + 1, :2]).norm(dim=-1) > metres


def part(seen: Observation2D, *at) -> Observation2D:
    """Returns keypoints at indices of their first axes, clips and frames."""
    return replace(seen, keypoints=seen.keypoints[at], confidence=seen.confidence[at])


def stacked(several: Sequence[Observation2D], **what) -> Observation2D:
    """Returns keypoints of equal shape as clips of one; what: other fields of it."""
    points, confidence = (torch.stack([getattr(each, n) for each in several]) for n in ("keypoints", "confidence"))
    return replace(several[0], keypoints=points, confidence=confidence, **what)
