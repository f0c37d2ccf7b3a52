"""Who is filmed, by what they do: clips of two seconds of real and synthetic people, and how a detector fails on them.

Where something happens in a clip (somebody sits down), the moment is drawn, not fixed.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from data_synth import corrupt, scenes
from data_synth.actions import ACTIONS
from data_synth.scenes import Scene
from motionlab.corpus import Take
from motionlab.metrics.gait import SEATED, tilt_and_bend
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
