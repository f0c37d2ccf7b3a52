"""Clips of people, synthetic or recorded, with who performs each: numbers are averaged person by person first."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from data_synth import scenes
from data_synth.scenes import Scene
from motionlab.bench.cases import by_person
from motionlab.motion import Motion
from studies.shared.clips import everyday, takes


class People(NamedTuple):
    """Clips (B, T) with a skeleton each, the number of the person (B,) in each, and recorded clips one by one."""

    truth: Motion
    whose: Tensor
    motions: tuple[Motion, ...] = ()

    @property
    def count(self) -> int:
        """Number of people."""
        return len(self.whose.unique())

    def mean(self, values: Tensor) -> Tensor:
        """Computes the mean (P,) of each person's clips from one number (B,) a clip."""
        return by_person(values, self.whose)

    def first(self, count: int) -> People:
        """Returns so many recorded clips, evenly through them."""
        keep = torch.linspace(0, len(self.motions) - 1, min(count, len(self.motions))).round().long()
        some = tuple(self.motions[k] for k in keep.tolist())
        return People(scenes.together(some), self.whose[keep].unique(return_inverse=True)[1], some)


def recorded(folder: Path | str, part: str, count: int, frames: int) -> People:
    """Returns clips of the people of one part of CMU's recordings, "val" or "test", evenly over people; of each
    the first frames."""
    cast = everyday(takes(folder, part), count)
    motions, names = tuple(m.cut(0, frames) for _, m in cast), sorted({who for who, _ in cast})
    return People(scenes.together(motions), torch.tensor([names.index(who) for who, _ in cast]), motions)


def sources(
    folder: Path | None, count: int, practice: int, *, seed: int, frames: int
) -> dict[str, tuple[People, People]]:
    """Returns by source test people and those to tune on: synthetic ones whom the corpus does not know, one
    a clip, and recorded ones where there is a folder."""
    made = [(scenes.held_out(n, seed=seed + k, frames=frames), n) for k, n in enumerate((count, practice))]
    found = {"synthetic": tuple(People(clips, torch.arange(n)) for clips, n in made)}
    if folder is not None:
        found["CMU"] = recorded(folder, "test", count, frames), recorded(folder, "val", practice, frames)
    return found


class Filmed(NamedTuple):
    """People, and what a camera of known place sees of them in plain view."""

    people: People
    scene: Scene

    @property
    def known(self) -> dict[str, object]:
        """Arguments of ``testops.fit`` where camera and floor are known."""
        return {"cameras": self.scene.cameras, "floor": "camera"}

    def first(self, count: int, *, seed: int) -> Filmed:
        """Returns so many of the clips; synthetic ones are all kept."""
        return filmed(self.people.first(count), seed=seed) if self.people.motions else self


def filmed(people: People, *, seed: int) -> Filmed:
    """Films recorded clips in plain view."""
    return Filmed(people, scenes.film_recorded("plain view", people.motions, seed=seed))


def shots(
    people: dict[str, tuple[People, People]], count: int, *, seed: int, frames: int
) -> dict[str, tuple[Filmed, Filmed]]:
    """Films every source: at most ``count`` test clips, half as many easy synthetic ones, one person a clip,
    and those to tune on."""
    counts = (-(-count // 2), len(people["synthetic"][1].whose))
    easy = [scenes.film("easy", n, seed=seed + k, frames=frames) for k, n in enumerate(counts)]
    made = {"synthetic": tuple(Filmed(People(s.truth, torch.arange(len(s))), s) for s in easy)}
    if "CMU" in people:
        tested, tried = people["CMU"]
        made["CMU"] = (filmed(tested.first(count), seed=seed), filmed(tried, seed=seed + 1))
    return made
