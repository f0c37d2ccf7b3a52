"""Who is filmed, by what they do: clips of two seconds of real and synthetic people, and how a detector fails on them.
With who performs each: numbers are averaged person by person first.

Where something happens in a clip (somebody sits down), the moment is drawn, not fixed.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Self

import torch
from torch import Tensor

from data_synth import corrupt, scenes
from data_synth.actions import ACTIONS
from data_synth.scenes import Scene
from motionlab import bench
from motionlab.corpus import Take
from motionlab.metrics import SEATED, tilt_and_bend
from motionlab.motion import Motion
from studies.shared import clips
from studies.shared.clips import FRAMES, stacked
from studies.shared.sitting import SEAT, unsupported

Fits = Callable[[Motion], Tensor]
_STANDS = 45.0  # degrees of thighs and knees: straighter legs are those of somebody who stands
_MOMENT = 10  # frames over which somebody must stand, or sit
_DEEP = 0.2  # metres that the pelvis sinks of somebody who crouches
_OVER_FEET = 0.05  # metres that the trunk of somebody who crouches is behind the feet, at most

Cast = list[tuple[str, Motion]]  # who it is, and the clip (T,); all are as long


def who(some: Sequence[Take], fits: Fits, each: int, most: int, seed: int, words: str = "") -> Cast:
    """Returns clips that begin where ``fits`` (starts,) is true, as ``clips.begun``. words: what a take's description
    must match."""
    told = [take for take in some if re.search(words, take.said, re.IGNORECASE)]
    return clips.begun(told, fits, torch.Generator().manual_seed(seed), each, most)


def acted(action: str, fits: Fits, count: int, seed: int, **options) -> Cast:
    """Returns clips of an action of ``data_synth``, each of a person no corpus knows, begun where ``fits`` is true."""
    cast, index = [], 0
    while len(cast) < count:
        generator = torch.Generator().manual_seed(1000 * seed + index)
        motion = ACTIONS[action](scenes.person(index, generator), generator, **options).motion
        starts = fits(motion).nonzero().flatten()
        if len(starts):
            at = int(starts[torch.randint(len(starts), (), generator=generator)])
            cast.append((f"stranger {index}", motion.cut(at, at + FRAMES)))
        index += 1
    return cast


# ------------------------------------------------------------------------------------------------- what a clip shows
def _over(x: Tensor, frames: int = _MOMENT) -> Tensor:
    """Means of x (T,) over so many frames, by where they begin."""
    return x.double().unfold(0, frames, 1).mean(-1)


def sits_down(motion: Motion) -> Tensor:
    """(starts,) true where somebody stands at one end of a clip and sits at the other: bent legs, behind the feet."""
    angles, behind = _angles(motion), _over(unsupported(motion))
    return _from_to((angles < _STANDS).all(0), (angles >= SEATED).all(0) & (behind >= SEAT), turned=True)


def sinks(motion: Motion) -> Tensor:
    """(starts,) true where somebody who stands goes down by ``_DEEP``, over the feet: crouches, kneels, bows."""
    height, behind = _over(motion.root[:, 2]), _over(unsupported(motion))
    stands, last = (_angles(motion) < _STANDS).all(0), FRAMES - _MOMENT
    return _from_to(stands, behind <= _OVER_FEET) & (height[:-last] - height[last:] >= _DEEP)


def _angles(motion: Motion) -> Tensor:
    return torch.stack([_over(a.mean(-1)) for a in tilt_and_bend(motion)])


def _from_to(begin: Tensor, end: Tensor, *, turned: bool = False) -> Tensor:
    last = FRAMES - _MOMENT
    there = begin[:-last] & end[last:]
    return there | (end[:-last] & begin[last:]) if turned else there


def lies(motion: Motion) -> Tensor:
    """(starts,) true where the trunk lies rather than stands, near the floor, for a fifth of the clip."""
    trunk = motion.positions[:, motion.skeleton.index("neck")] - motion.root
    flat = (trunk[:, 2] / trunk.norm(dim=-1) < 0.7) & (motion.root[:, 2] < 0.5)
    return _over(flat, FRAMES) > 0.2


def lively(motion: Motion) -> Tensor:
    """(starts,) true where the joints move by 0.3 m/s about the pelvis, mean over joints."""
    speed = (motion.positions - motion.root[:, None]).diff(dim=0).norm(dim=-1).mean(-1) * motion.fps
    return _over(torch.cat((speed[:1], speed)), FRAMES) > 0.3


def by_person(values: Tensor, people: Sequence[str] | None) -> Tensor:
    """Computes the mean (P,) of every person's clips (B,); without names each clip is a person."""
    if people is None:
        return values
    mine = [[i for i, who in enumerate(people) if who == name] for name in dict.fromkeys(people)]
    return torch.stack([values[rows].nanmean() for rows in mine])


# ------------------------------------------------------------------------------------------------ how a detector fails
def spoilt(scene: Scene, how: Callable, seed: int, **options) -> Scene:
    """Lets the detector fail as a function of ``data_synth.corrupt`` does, clip by clip."""
    generator = torch.Generator().manual_seed(seed)
    seen, wrong = zip(*(how(scene.clip(k), generator, **options) for k in range(len(scene))), strict=True)
    return replace(scene, observation=stacked(seen, camera=None), wrong=torch.stack(wrong))


def two_legs(scene: Scene, lead: int, seed: int) -> Scene:
    """Predicts two legs where one is visible, from ``lead`` frames before a leg is hidden; one draw for all leads."""
    return spoilt(scene, corrupt.two_legs_from_one, seed, lead=lead)


# ------------------------------------------------------------------------------------------ people, and who is filmed
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
        return bench.by_person(values, self.whose)

    def first(self, count: int) -> Self:
        """Returns so many recorded clips, evenly through them."""
        keep = torch.linspace(0, len(self.motions) - 1, min(count, len(self.motions))).round().long()
        some = tuple(self.motions[k] for k in keep.tolist())
        return People(scenes.together(some), self.whose[keep].unique(return_inverse=True)[1], some)


def recorded(folder: Path | str, part: str, count: int, frames: int) -> People:
    """Returns clips of the people of one part of CMU's recordings, "val" or "test", evenly over people; of each
    the first frames."""
    cast = clips.everyday(clips.takes(folder, part), count)
    motions, names = tuple(m.cut(0, frames) for _, m in cast), sorted({who for who, _ in cast})
    return People(scenes.together(motions), torch.tensor([names.index(who) for who, _ in cast]), motions)


def sources(
    folder: Path | None, count: int, practice: int, *, seed: int, frames: int
) -> dict[str, tuple[People, People]]:
    """Returns by source test people and those to tune on: synthetic ones whom the corpus does not know, one
    a clip, and recorded ones where there is a folder."""
    made = [(scenes.held_out(n, seed=seed + k, frames=frames), n) for k, n in enumerate((count, practice))]
    found = {"synthetic": tuple(People(truth, torch.arange(n)) for truth, n in made)}
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

    def first(self, count: int, *, seed: int) -> Self:
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
