"""Poses to complete, and poses to know, by person: of recordings, or of synthetic people where there are none.

Known poses are looked up, or averaged by a Gaussian. Source: ridge regression on whatever is given, which is its mean
(Bishop 2006, 2.3).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from data_synth import corpus as synthetic
from data_synth import scenes
from motionlab import splits
from motionlab.bench import person_windows
from motionlab.corpus import Take
from motionlab.diffusion.poses import Poser
from motionlab.heading import stuck_root
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD
from studies.shared.clips import recorded

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

    def at(self, k: int) -> Self:
        """The k-th alone, as one person's."""
        one = slice(k, k + 1)
        return Poses(self.truth.clip(one), self.last.clip(one), torch.zeros_like(self.whose[one]), self.lacks[one])


@cache
def takes(folder: Path | None, part: str, every: int = 1) -> list[Take]:
    """Returns each n-th take of a part; of synthetic people without a folder."""
    if folder:
        return recorded(folder).part(part)[::every]
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


@dataclass(frozen=True, eq=False)
class Known:
    """poses (N, 1) in their stuck frames, known with their mirror images; model: whose numbers of a pose are used."""

    poses: Motion
    model: Poser

    @cached_property
    def _rows(self) -> tuple[Tensor, Tensor]:
        """Places (2 N, 66) and numbers (2 N, 133)."""
        both = self.poses, mirror(self.poses)
        return torch.cat([m.positions.flatten(1) for m in both]), torch.cat([self.model.encode(m) for m in both])

    @cached_property
    def _moments(self) -> tuple[Tensor, Tensor]:
        rows = torch.cat(self._rows, 1).double()
        return rows.mean(0), rows.mT.cov()

    def nearest(self, targets: Tensor, which: Tensor, rank: int = 0) -> Motion:
        """The poses (B, 1) whose joints are nearest to the handles (B, 22, 3), or the n-th nearest."""
        places, numbers = self._rows
        goal = torch.where(which[..., None], targets, 0.0).flatten(1)
        weight = which.to(targets).repeat_interleave(3, -1)
        apart = weight @ places.square().mT - 2 * goal @ places.mT  # less what does not depend on the pose
        return self.model.decode(numbers[apart.topk(rank + 1, largest=False).indices[:, rank]])

    def gaussian(
        self, targets: Tensor, which: Tensor, ridge: float = 1e-4, generator: torch.Generator | None = None
    ) -> Motion:
        """The mean of poses with these handles, were all numbers Gaussian, or a draw. ridge: of targets, m^2."""
        (mean, cov), size = self._moments, self._rows[0].shape[1]
        seen = which.double().repeat_interleave(3, -1)
        among = seen[:, :, None] * (cov[:size, :size] + ridge * torch.eye(size)) * seen[:, None]
        across = seen[:, :, None] * cov[:size, size:]
        gain = torch.linalg.solve(among + torch.diag_embed(1 - seen), across).mT
        off = torch.where(seen > 0, targets.flatten(1).double() - mean[:size], 0.0)
        said = mean[size:] + (gain @ off[..., None])[..., 0]
        if generator is not None:
            left = cov[size:, size:] - gain @ across
            half = torch.linalg.cholesky((left + left.mT) / 2 + 1e-4 * torch.eye(said.shape[1]))
            said = said + (half @ torch.randn(said.shape, generator=generator).double()[..., None])[..., 0]
        return self.model.decode(said.float())
