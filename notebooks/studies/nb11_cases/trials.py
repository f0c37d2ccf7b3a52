"""Denoising, reversed walks and switching: what notebook 11 measures beside the shared cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.bench import cases, rivals
from motionlab.bench.cases import JOINTS
from motionlab.bench.rivals import RIDGES
from motionlab.diffusion.denoising import Noise, ReverseProcess, denoise
from motionlab.diffusion.embedding import Scaled
from motionlab.diffusion.inpainting import Way, repair
from motionlab.diffusion.model import Trained
from motionlab.errors import ShapeError
from motionlab.metrics.generation import kid
from motionlab.metrics.pose import acceleration_error, power_spectrum_ratio
from motionlab.motion import Motion
from studies.shared.bench import Bench

#: How denoising may begin; which is best is found on other windows.
STARTS = (
    *(ReverseProcess(level=level, looks=4) for level in (0.7, 1.0, 1.4)),
    *(ReverseProcess(level=level, topped=False) for level in (0.7, 1.0, 1.4, 2.0)),
    *(ReverseProcess(level=level, topped=False, steps=5) for level in (1.0, 1.4)),
    *(ReverseProcess(level=2.0, steps=8, pull=pull) for pull in (0.01, 0.03, 0.1)),
    *(ReverseProcess(level=level, topped=False, filtered=True) for level in (0.2, 0.35, 0.5)),
    *(ReverseProcess(level=level, looks=4, filtered=True) for level in (0.2, 0.35, 0.5)),
)
FINISH = 8  # frames over which the offset at a gap's ends fades


def reversals(model: Trained, walks: Motion, generator: torch.Generator, steps: int) -> Tensor:
    """(B,): of people who walk, 1 where the legs that Eq. 4.10 gives them go the other way (``reversed_walk``)."""
    known = cases.legs(len(walks.root), walks.frames)
    made = repair(model, walks, cases.columns(model.layout, known), generator, Way(steps=steps))
    return cases.reversed_walk(made, walks)


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
    start: ReverseProcess

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
