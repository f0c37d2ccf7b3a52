"""The people of notebook 04: clips of two seconds of people nobody trained on, sits, and clips to go on from."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from data_synth import scenes
from motionlab import corpus, splits
from motionlab.corpus import Take
from motionlab.humor import state
from motionlab.humor.priors import Cvae
from motionlab.humor.rollout import sample_rollout
from motionlab.metrics import SEATED, tilt_and_bend
from motionlab.motion import FPS, Motion
from motionlab.training.courses import person_states
from motionlab.training.quality import quality_row
from studies.shared.clips import whole

FRAMES = 62  # two seconds, and a frame before them from which the first velocity is taken
DESCENT = 0.2  # metres that a pelvis sinks in two seconds of going down
_MOST = 24  # windows of two seconds of each person
_WALKING = 0.5  # m/s: who is faster over a whole window walks
_STRAIGHT = 40.0  # degrees: knees that bend less are those of somebody who stands
_SITS = re.compile(r"\bsit(s|ting)?\b(?!.?up)", re.IGNORECASE)
_NOT = re.compile(r"motorcycle|kneel", re.IGNORECASE)  # mimed saddles; scenes in which this person may be who kneels
_KINDS = {"walk": r"\bwalk", "run": r"\brun", "sit down": _SITS.pattern, "dance": r"danc|salsa", "jump": r"jump"}


@dataclass(frozen=True, eq=False)
class Clips:
    """motion (N, 62): clips, a frame of lead each. whose (N,): numbers of the people. names: of those people."""

    motion: Motion
    whose: Tensor
    names: tuple[str, ...]

    def described(self) -> str:
        """Returns how many people and clips there are, and how many of the people taught the priors."""
        taught = sum(who.startswith("cmu") and splits.part_of(who) == "train" for who in self.names)
        return f"{len(self.names)} people, {taught} of whom taught the prior, {len(self.whose)} clips"

    def of(self, indices: Sequence[int]) -> Self:
        """Returns some of the clips."""
        kept, whose = self.whose[list(indices)].unique(return_inverse=True)
        return Clips(self.motion.clip(list(indices)), whose, tuple(self.names[i] for i in kept))


def everybody(folder: Path | str | None, every: int) -> list[Take]:
    """Loads all takes of the corpus, or every so manieth recording; none without a folder."""
    return [*corpus.assemble(folder, splits.real_sources(folder), every=every, progress=False).takes] if folder else []


def report_part(takes: Sequence[Take]) -> list[Take]:
    """Returns the takes of people nobody trained on."""
    return [take for take in takes if take.part == "test"]


def drawn(count: int) -> Clips:
    """Draws synthetic clips, each of a person that the corpus does not know; every eighth from the third sits down."""
    names = tuple(f"stranger {i}" for i in range(count))
    return Clips(scenes.held_out(count, seed=0, frames=FRAMES), torch.arange(count), names)


def recorded(takes: Sequence[Take], each: int) -> Clips | None:
    """Returns at most ``each`` clips of every person, evenly through what they did; None where there are none."""
    cuts = whole(takes, FRAMES).items()
    return _together((who, cut) for who, mine in cuts for cut in splits.subsample(mine, each))


def going_down(takes: Sequence[Take], each: int) -> Clips | None:
    """Returns at most ``each`` clips of every person who goes down from standing: the steepest two seconds of a take.

    The pelvis sinks by ``DESCENT`` or more; the knees, at first straighter than 40 degrees, and the thighs end bent by
    60 degrees or more.
    """
    found: dict[str, list[tuple[float, Motion]]] = {}
    for take in takes:
        if steepest := _steepest(take.motion):
            found.setdefault(take.person, []).append(steepest)
    ordered = {who: sorted(mine, key=lambda pair: -pair[0])[:each] for who, mine in found.items()}
    return _together((who, cut) for who, mine in ordered.items() for _, cut in mine)


def who_goes_down(takes: Sequence[Take]) -> dict[str, Clips]:
    """Returns clips of recorded people who go down: whose take's description says that they sit, of all parts, since
    few do; and who do otherwise (crouch, pick up, kneel), of people nobody trained on."""
    told = [t for t in takes if _SITS.search(t.said) and not _NOT.search(t.said)]
    others = [take for take in report_part(takes) if take not in told]
    found = {"cmu sits": going_down(told, 2), "cmu, other ways down": going_down(others, 3)}
    return {name: clips for name, clips in found.items() if clips is not None}


def _steepest(motion: Motion) -> tuple[float, Motion] | None:
    if motion.frames < FRAMES:
        return None
    tilt, bend = (angle.mean(-1) for angle in tilt_and_bend(motion))
    height, last = motion.root[:, 2], FRAMES - 1
    sunk = height[:-last] - height[last:]
    down = (bend[:-last] < _STRAIGHT) & (bend[last:] >= SEATED) & (tilt[last:] >= SEATED) & (sunk >= DESCENT)
    if not down.any():
        return None
    start = int(torch.where(down, sunk, 0.0).argmax())
    return float(sunk[start]), motion.cut(start, start + FRAMES)


def _together(pairs: Iterator[tuple[str, Motion]]) -> Clips | None:
    some = list(pairs)
    if not some:
        return None
    names = tuple(dict.fromkeys(who for who, _ in some))
    whose = torch.tensor([names.index(who) for who, _ in some])
    return Clips(scenes.together([replace(cut, name="") for _, cut in some]), whose, names)


def starts(takes: Sequence[Take], strangers: Clips, own: Motion | None = None) -> dict[str, Motion]:
    """Returns clips (T,) to go on from, by what they show: of people nobody trained on, synthetic ones, your own."""
    found = {}
    for kind, words in _KINDS.items():
        fits = [t for t in report_part(takes) if re.search(words, t.said, re.IGNORECASE) and t.motion.frames > 60]
        if fits:
            steepest = _steepest(fits[0].motion) if kind == "sit down" else None
            found[f"{kind} ({fits[0].person})"] = steepest[1] if steepest else fits[0].motion.cut(0, 140)
    found |= {f"{kind} (synthetic)": strangers.motion.clip(i) for kind, i in (("walk", 0), ("sit down", 2))}
    return found | ({"your own": own} if own is not None else {})


def judged_rows(
    models_by_name: Mapping[str, Cvae], takes: Sequence[Take], strangers: Clips, seed: int
) -> dict[tuple[str, str], dict[str, dict[str, float]]]:
    """Computes measures of every person, means over windows, by prior and source: synthetic people, and recorded ones
    nobody trained on; of walkers the share who go on, too."""
    begun = state.from_motion(strangers.motion, causal=True)[:, 1:]
    each = zip(begun[:, None], strangers.motion.contacts[:, None, 1:], strict=True)
    sources = {"synthetic": dict(zip(strangers.names, each, strict=True))}
    if real := person_states(report_part(takes), _MOST):
        sources["cmu"] = real
    return {
        (name, source): {
            who: quality_row(model, *windows, seed) | _walkers(model, windows[0], seed)
            for who, windows in persons.items()
        }
        for name, model in models_by_name.items()
        for source, persons in sources.items()
    }


@torch.no_grad()
def _walkers(model: Cvae, states: Tensor, seed: int) -> dict[str, float]:
    """Of windows in which a person walks, the share whose samples still do in the last half second."""

    def over_floor(states: Tensor) -> Tensor:  # (W, T - 1) of the pelvis, m/s
        return state.unpack(states)["joints"][:, :, 0, :2].diff(dim=1).norm(dim=-1) * FPS

    speed = over_floor(states)
    walking = speed.mean(1) > _WALKING
    if not walking.any():
        return {"walkers who go on": float("nan")}
    first, generator = states[walking, 0], torch.Generator().manual_seed(seed)
    made = sample_rollout(model, first, states.shape[1] - 1, generator=generator).states
    still = over_floor(made)[:, -15:].mean(1) > 0.5 * speed[walking].mean(1)
    return {"walkers who go on": float(still.float().mean())}
