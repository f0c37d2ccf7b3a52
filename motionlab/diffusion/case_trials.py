"""The test cases run: every way of a model and every rival on the same windows with the same masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.diffusion import cases, rivals
from motionlab.diffusion.cases import JOINTS
from motionlab.diffusion.denoising import Noise, Start, denoise
from motionlab.diffusion.judge import Scaled
from motionlab.diffusion.repair import Way, repair
from motionlab.diffusion.rivals import RIDGES, Rivals
from motionlab.diffusion.trained import Trained, silenced
from motionlab.errors import ShapeError
from motionlab.metrics.generation import kid
from motionlab.metrics.pose import acceleration_error, power_spectrum_ratio
from motionlab.motion import Motion

#: Each way's model and how it is used; steps are set by the trial unless they are the point.
WAYS: Mapping[str, tuple[str, Way]] = {
    "Eq. 4.10": ("free", Way()),
    "imputed": ("free", Way(put="imputed")),
    "guided": ("free", Way(put="imputed", weight=5.0)),
    "told": ("told", Way(put="imputed")),
    "told, 5 steps": ("told", Way(put="imputed", steps=5)),
    "told, one look": ("told", Way(put="imputed", steps=1)),
    "start, guided": ("free", Way(put="imputed", weight=5.0, begin=0.75)),
}
PLAIN = ("Eq. 4.10", "imputed", "guided")
#: Of these "start, guided" is the free model, begun from what the told one starts from.
TOLD = tuple(name for name in WAYS if name not in PLAIN)
#: How denoising may begin; which is best is found on other windows.
STARTS = (
    *(Start(level=level, looks=4) for level in (0.7, 1.0, 1.4)),
    *(Start(level=level, topped=False) for level in (0.7, 1.0, 1.4, 2.0)),
    *(Start(level=level, topped=False, steps=5) for level in (1.0, 1.4)),
    *(Start(level=2.0, steps=8, pull=pull) for pull in (0.01, 0.03, 0.1)),
    *(Start(level=level, topped=False, filtered=True) for level in (0.2, 0.35, 0.5)),
    *(Start(level=level, looks=4, filtered=True) for level in (0.2, 0.35, 0.5)),
)
FINISH = 8  # frames over which the offset at a gap's ends fades


@dataclass(frozen=True, eq=False)
class Bench:
    """free, told: models. rivals: fitted to training windows. steps: of the sampler."""

    free: Trained
    told: Trained
    rivals: Rivals
    steps: int = 25

    def fill(
        self, name: str, motion: Motion, known: Tensor, generator: torch.Generator, **changes: float | bool
    ) -> Motion:
        """Motions (B, T) filled by one of ``WAYS``, or by that way with ``changes`` to it.

        What is known stays as it is to the bit, unless the way leaves out the last overwrite and has no finish.
        """
        which, way = WAYS[name]
        way = replace(way, steps=min(way.steps, self.steps), **changes)
        model = self.free if which == "free" else self.told
        guess = self.start(motion, known, generator) if way.begin < 1 else None
        made = repair(model, motion, cases.columns(model.layout, known), generator, way, guess=guess)
        return made if way.put == "overwrite" and not way.last and not way.finish else pasted(made, motion, known)

    def best(
        self,
        names: Sequence[str],
        practice: Motion,
        known: Tensor,
        generator: torch.Generator,
        joints: tuple[str, ...] | None = None,
        **changes: float | bool,
    ) -> str:
        """The way of the least error on windows that settings are chosen on."""
        return cases.chosen(
            names, lambda name: self.fill(name, practice, known, generator, **changes), practice, known, joints
        )

    def contest(
        self,
        motion: Motion,
        known: Tensor,
        generator: torch.Generator,
        *,
        plain: str,
        told: str,
        regression: bool = True,
        through_time: bool = False,
        **changes: float | bool,
    ) -> dict[str, Motion]:
        """Everybody's answer for the same windows. plain, told: the ways that were chosen; ``changes`` are theirs.

        regression: the rivals that know other windows. through_time: those that know only this one.
        """
        found = {}
        if regression:
            finish = int(changes.get("finish", 0))
            for name, fill in {"mean": "mean", "nearest": "nearest", "ridge": "regression"}.items():
                found[name] = getattr(self.rivals, fill)(motion, known, finish)
        if through_time:
            found |= {"hold": rivals.held(motion, known), "slerp": rivals.interpolated(motion, known)}
            found["curves"] = self.curves(motion, known, generator)
        found["Eq. 4.10"] = self.fill("Eq. 4.10", motion, known, generator)
        found["not told"] = self.fill(plain, motion, known, generator, **changes)
        found["start alone"] = self.start(motion, known, generator)
        return found | {"told": self.fill(told, motion, known, generator, **changes)}

    def start(self, motion: Motion, known: Tensor, generator: torch.Generator) -> Motion:
        """What the told model would say without its network: training motion recalled, and smooth curves."""
        return self._silent(silenced(self.told), motion, known, generator)

    def curves(self, motion: Motion, known: Tensor, generator: torch.Generator) -> Motion:
        """Smooth curves through what is known, drawn to the mean of all training windows: a start without recall."""
        model = silenced(self.told)
        model.denoiser.start.factor.zero_()
        model.denoiser.start.last = None
        return self._silent(model, motion, known, generator)

    @staticmethod
    def _silent(model: Trained, motion: Motion, known: Tensor, generator: torch.Generator) -> Motion:
        way = WAYS["told, one look"][1]
        return pasted(repair(model, motion, cases.columns(model.layout, known), generator, way), motion, known)


def reversals(model: Trained, walks: Motion, generator: torch.Generator, steps: int) -> Tensor:
    """(B,): of people who walk, 1 where the legs that Eq. 4.10 gives them go the other way (``reversed_walk``)."""
    known = cases.legs(len(walks.root), walks.frames)
    made = repair(model, walks, cases.columns(model.layout, known), generator, Way(steps=steps))
    return cases.reversed_walk(made, walks)


def pasted(made: Motion, given: Motion, known: Tensor) -> Motion:
    """A motion with its known rotations and places as they were given: without the rounding of a way there and back."""
    rot = torch.where(known[..., :JOINTS, None, None], given.rot, made.rot)
    return replace(made, rot=rot, root=torch.where(known[..., JOINTS, None], given.root, made.root))


# ---------------------------------------------------------------------------------------------------- windows
def middle(motions: Sequence[Motion], frames: int, around: int = 0) -> list[Motion]:
    """The middle ``frames`` of every motion that has them, with up to ``around`` more on either side."""
    found = []
    for motion in motions:
        if motion.frames >= frames:
            start = (motion.frames - frames) // 2
            found.append(motion.cut(max(start - around, 0), start + frames + around))
    return found


def spread(motion: Motion, count: int) -> Motion:
    """At most ``count`` of windows (N, T), evenly."""
    picked = torch.linspace(0, len(motion.root) - 1, min(count, len(motion.root))).round().long()
    return motion.clip(picked)


# -------------------------------------------------------------------------------------------------- denoising
@dataclass(frozen=True)
class Cleaning:
    """All settings for one kind of noise, as chosen on other windows."""

    noise: Noise
    filters: Mapping[str, Mapping[str, float]]
    best: str  #: the filter of the least error
    ridge: float
    start: Start

    @classmethod
    def chosen(cls, noise: Noise, bench: Bench, practice: Motion, generator: torch.Generator) -> Cleaning:
        """On windows (N, T) to choose on, with noise of their own."""
        noisy = noise.on(practice, generator)
        filters = {name: rivals.tune(name, noisy, practice) for name in rivals.FILTERS}
        smooth = {name: rivals.filtered(noisy, name, **settings) for name, settings in filters.items()}
        best = cases.chosen(list(smooth), smooth.__getitem__, practice)
        rough = smooth[best]
        ridge = cases.chosen(RIDGES, lambda w: _linear(bench, w, noisy, rough, noise), practice)
        start = cases.chosen(STARTS, lambda s: denoise(bench.free, noisy, rough, noise, generator, s), practice)
        return cls(noise, filters, best, ridge, start)

    def clean(self, noisy: Motion, bench: Bench, generator: torch.Generator) -> dict[str, Motion]:
        """What each method makes of noisy motions (N, T), the noisy ones first."""
        found = {"noisy": noisy}
        found |= {name: rivals.filtered(noisy, name, **settings) for name, settings in self.filters.items()}
        rough = found[self.best]
        found["linear"] = _linear(bench, self.ridge, noisy, rough, self.noise)
        found["diffusion"] = denoise(bench.free, noisy, rough, self.noise, generator, self.start)
        return found


def _linear(bench: Bench, ridge: float, noisy: Motion, rough: Motion, noise: Noise) -> Motion:
    return replace(bench.rivals, ridge=ridge).wiener(noisy, rough, noise.turn, noise.shift)


def cleaned(made: Mapping[str, Motion], truth: Motion) -> dict[str, dict[str, Tensor]]:
    """Of every method: joint error, error of acceleration, each (B,), and power over true power by band (B, bands)."""
    nothing = torch.zeros(*truth.root.shape[:2], JOINTS + 2, dtype=torch.bool)
    return {
        name: {
            "error, cm": cases.error_cm(motion, truth, nothing),
            "acceleration error, m/s^2": acceleration_error(motion.positions, truth.positions, truth.fps),
            "power": power_spectrum_ratio(motion.positions, truth.positions, truth.fps, cases.BANDS),
        }
        for name, motion in made.items()
    }


# -------------------------------------------------------------------------------------------------- switching
def kernel_distances(made: Motion, real: Motion, generator: torch.Generator, groups: int = 8) -> Tensor:
    """Kernel distance (groups,) to real windows of each of so many groups of windows, which share none.

    Raises:
        ShapeError: fewer than two windows in a group.
    """
    if len(made.root) < 2 * groups:
        raise ShapeError(f"{len(made.root)} windows in {groups} groups: two are needed in each")
    scaled = Scaled(real)
    features, goal = scaled(made)[torch.randperm(len(made.root), generator=generator)], scaled.real
    return torch.tensor(
        [kid(part, goal, generator, subsets=1, size=len(goal)).value for part in features.chunk(groups)]
    )
