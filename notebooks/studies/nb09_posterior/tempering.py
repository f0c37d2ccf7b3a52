"""The temperature at which regions hold what they say, chosen on other clips: all temperatures from one hot chain.

Draws at a temperature H are draws at T <= H with weights proportional to exp(-E (1 / T - 1 / H)). So one chain per clip
tells at every T below its own how wide the region of 90 % would have to be to hold the truth, and nothing about T has
to be foretold from a chain at 1, where the landscape is another one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from studies.nb09_posterior import calibration
from studies.nb09_posterior.trials import Draws

RUNGS, OCTAVES = 9, 2.0  # temperatures looked at, and how far below the chain's own: a fourth


def ladder(hot: float) -> Tensor:
    """Temperatures (RUNGS,), the lowest first; below a fourth of ``hot`` too few draws would count."""
    return hot * 2 ** torch.linspace(-OCTAVES, 0, RUNGS, dtype=torch.float64)


def weights(energy: Tensor, hot: float, temperature: float) -> Tensor:
    """What draws at ``hot`` with these energies (D,) weigh at another temperature; they sum to 1."""
    return (-energy.double() * (1 / temperature - 1 / hot)).softmax(0)


def effective(weights: Tensor) -> float:
    """How many draws of equal weight are worth as much (Kish)."""
    return float(1 / weights.square().sum())


def cooled(draws: Draws, hot: float, temperature: float, generator: torch.Generator, count: int | None = None) -> Draws:
    """Draws (``count``, as many as there are unless given) at a temperature from those at a higher one, by systematic
    resampling; heavy ones are there more than once."""
    share = weights(draws.energy, hot, temperature).cumsum(0)
    count = count or len(share)
    at = (torch.arange(count) + torch.rand((), generator=generator, dtype=torch.float64)) / count
    pick = torch.searchsorted(share, at).clamp(max=len(share) - 1)
    return replace(
        draws, c=draws.c[pick], ways=draws.ways[pick], coordinates=draws.coordinates[pick], energy=draws.energy[pick]
    )


def stretches(
    found: Sequence[Draws | None], exact: Sequence[Tensor], hot: float, generator: torch.Generator, level: float = 0.9
) -> Tensor:
    """How many times as wide the region of a level would have to be at each rung, (C, RUNGS); NaN where no chain is."""
    rows = []
    for draws, truth in zip(found, exact, strict=True):
        if draws is None:
            rows.append(torch.full((RUNGS,), torch.nan, dtype=torch.float64))
            continue
        each = [cooled(draws, hot, float(t), generator).coordinates for t in ladder(hot)]
        rows.append(torch.tensor([calibration.stretch(x, truth, level) for x in each], dtype=torch.float64))
    return torch.stack(rows)


def chosen(stretches: Tensor, hot: float, level: float = 0.9, folds: int | None = None) -> Tensor:
    """For each clip (C,) the lowest rung at which the regions hold ``calibration.needed`` of the *other* clips, or of
    those in other folds; ``hot`` where none does."""
    return torch.stack(
        [_rung(stretches[mask], hot, level, one_more=True) for mask in calibration.others_of(len(stretches), folds)]
    )


def on_all(stretches: Tensor, hot: float, level: float = 0.9) -> Tensor:
    """As :func:`chosen`, one temperature for all clips, chosen on all of them: every clip has a say in its own, so that
    what its regions then hold was asked for and proves nothing."""
    return _rung(stretches, hot, level, one_more=False).expand(len(stretches))


def _rung(stretches: Tensor, hot: float, level: float, one_more: bool) -> Tensor:
    kept = stretches[stretches.isfinite().all(1)]
    least = calibration.needed(level, len(kept)) if one_more else math.ceil(level * len(kept) - 1e-9)
    enough = (kept <= 1).sum(0) >= least
    rung = int(enough.int().argmax()) if len(kept) and enough.any() else -1
    return ladder(hot)[rung]
