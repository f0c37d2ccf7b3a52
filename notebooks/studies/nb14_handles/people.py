"""Poses to complete, and poses to know, by person: of recordings, or of synthetic people where there are none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from data_synth import corpus as synthetic
from data_synth import scenes
from motionlab import corpus, splits
from motionlab.bench import person_windows
from motionlab.corpus import Take
from motionlab.heading import stuck_root
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

#: Handles by name: joints, or how many are drawn at random for every pose.
SETS: dict[str, tuple[str, ...] | int] = {
    "hands": ("left_wrist", "right_wrist"),
    "random 3": 3,
    "five ends": ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle"),
    "random 6": 6,
}
_BEFORE = 30  # frames from the last pose to the one in question: a second


@dataclass(frozen=True, eq=False)
class Poses:
    """truth, last: poses (N, 1) and those a second before, on the standard body, each in its own stuck frame. whose
    (N,). lacks (N, 22): joints that a figure lacks; nobody is asked for them."""

    truth: Motion
    last: Motion
    whose: Tensor
    lacks: Tensor

    @property
    def places(self) -> Tensor:
        """(N, 22, 3), metres."""
        return self.truth.positions[:, 0]

    def at(self, k: int) -> Poses:
        """The k-th alone, as one person's."""
        one = slice(k, k + 1)
        return Poses(self.truth.clip(one), self.last.clip(one), torch.zeros_like(self.whose[one]), self.lacks[one])


@cache
def takes(folder: Path | None, part: str, every: int = 1) -> list[Take]:
    """Returns each n-th take of a part; of synthetic people without a folder."""
    if folder:
        return corpus.assemble(folder, splits.real_sources(folder), progress=False).part(part)[::every]
    if part == "test":
        clips = scenes.held_out(16)
        motions = [clips.clip(k) for k in range(16)]
    else:
        made = synthetic.build(version="B")
        motions = [s.motion for s in (made.train if part == "train" else made.heldout_sequences)[::every]]
    return [Take(m, part, splits.SYNTHETIC, f"{part} {k}", "", m.fps, ()) for k, m in enumerate(motions)]


def poses(some: Sequence[Take], each: int) -> Poses:
    """At most ``each`` poses of every person, evenly over the takes."""
    motion, whose, lacks = person_windows(some, _BEFORE + 1, each)
    last, truth = (
        stuck_root(replace(motion, root=motion.root[:, at, None], rot=motion.rot[:, at, None], contacts=None))[0]
        for at in (0, -1)
    )
    return Poses(truth, last, whose, lacks[:, 0, : len(STANDARD)])


def handles(chosen: tuple[str, ...] | int, count: int, generator: torch.Generator) -> Tensor:
    """Which joints (count, 22) are handles: those of these names, or so many drawn anew for every pose."""
    if isinstance(chosen, int):
        return torch.rand(count, len(STANDARD), generator=generator).argsort(-1).argsort(-1) < chosen
    which = torch.zeros(count, len(STANDARD), dtype=torch.bool)
    which[:, STANDARD.indices(list(chosen))] = True
    return which
