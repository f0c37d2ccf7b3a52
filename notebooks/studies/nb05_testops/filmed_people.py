"""Clips of people, synthetic or recorded, with who performs each: numbers are averaged person by person first."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from data_synth import scenes
from data_synth.scenes import Scene
from motionlab.bench.person_windows import by_person
from motionlab.motion import Motion
from studies.nb05_testops.cast import everyday
from studies.shared.clips import FRAMES, takes


class People(NamedTuple):
    """Clips (B, T) with a skeleton each, and the number of the person (B,) in each.

    name: "synthetic" or "CMU". motions: the clips one by one.
    """

    name: str
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
        """Returns so many clips, evenly through them."""
        keep = torch.linspace(0, len(self.motions) - 1, min(count, len(self.motions))).round().long()
        some = tuple(self.motions[k] for k in keep.tolist())
        return People(self.name, scenes.together(some), self.whose[keep].unique(return_inverse=True)[1], some)


def synthetic(count: int, *, seed: int, frames: int) -> People:
    """Returns everyday clips of people whom the corpus does not know, one person a clip."""
    return People("synthetic", scenes.held_out(count, seed=seed, frames=frames), torch.arange(count))


def recorded(folder: Path | str, part: str, count: int, *, frames: int = FRAMES) -> People:
    """Returns clips of the people of one part of CMU's recordings, "choose" or "report", evenly over people; of each
    the first frames."""
    cast = everyday(takes(folder, part), count)
    motions, names = tuple(m.cut(0, frames) for m in cast.motions), sorted(set(cast.people))
    return People("CMU", scenes.together(motions), torch.tensor([names.index(who) for who in cast.people]), motions)


def sources(
    folder: Path | None, count: int, practice: int, *, seed: int, frames: int
) -> dict[str, tuple[People, People]]:
    """Returns by source the people to report on and those to tune on; recorded ones where there is a folder."""
    found = {"synthetic": tuple(synthetic(n, seed=seed + k, frames=frames) for k, n in enumerate((count, practice)))}
    if folder is not None:
        parts = {"report": count, "choose": practice}
        found["CMU"] = tuple(recorded(folder, part, n, frames=frames) for part, n in parts.items())
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


def easy(count: int, *, seed: int, frames: int) -> Filmed:
    """Films easy synthetic clips, one person a clip."""
    scene = scenes.film("easy", count, seed=seed, frames=frames)
    return Filmed(People("synthetic", scene.truth, torch.arange(count)), scene)


def shots(
    people: dict[str, tuple[People, People]], count: int, *, seed: int, frames: int
) -> dict[str, tuple[Filmed, Filmed]]:
    """Films every source: at most ``count`` clips to report on, half as many synthetic ones, and those to tune on."""
    practice = len(people["synthetic"][1].whose)
    made = {"synthetic": tuple(easy(n, seed=seed + k, frames=frames) for k, n in enumerate((-(-count // 2), practice)))}
    if "CMU" in people:
        tested, tried = people["CMU"]
        made["CMU"] = (filmed(tested.first(count), seed=seed), filmed(tried, seed=seed + 1))
    return made
