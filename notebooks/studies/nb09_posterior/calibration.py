"""Does a region of 90 % hold the truth in 90 % of the clips? How sure one may be of that, and how wide the region is.

A region grows with its level, so that one number per clip says all: the level u at which it first holds the truth. Is
the posterior right, u is uniform on 0..1. One truth per clip is one sample, however many frames and joints it has.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from motionlab.errors import check_shape
from motionlab.metrics import intervals

LEVELS = (0.5, 0.8, 0.9, 0.95)


def distances(draws: Tensor, points: Tensor) -> Tensor:
    """Mahalanobis distances (P,) of points (P, n) from draws (N, n), by the draws' own mean and covariance."""
    check_shape(draws, "N n", "draws")
    centre = draws.mean(0)
    factor = torch.linalg.cholesky(torch.atleast_2d((draws - centre).mT.cov()))
    return torch.linalg.solve_triangular(factor, (points - centre).mT, upper=False).norm(dim=0)


def stretch(draws: Tensor, truth: Tensor, level: float = 0.9) -> float:
    """How many times as wide the region of a level would have to be to hold the truth (n,), draws (N, n)."""
    radius = distances(draws, draws).quantile(level)
    return float(distances(draws, truth[None])[0] / radius)


def level_of(draws: Tensor, truth: Tensor, factor: float = 1.0) -> float:
    """The smallest level whose region holds the truth (n,): the share of draws (N, n) nearer to their middle than it.

    factor: how many times as wide the regions are made.
    """
    return float((distances(draws, draws) * factor < distances(draws, truth[None])).double().mean())


def ranks(draws: Tensor, truth: Tensor) -> Tensor:
    """Share of draws (N, n) below the truth (n,), one for each number: uniform on 0..1 where the posterior is right."""
    return (draws < truth).double().mean(0)


def radii(draws: Tensor, level: float = 0.9) -> tuple[Tensor, Tensor]:
    """Balls that hold a level of draws (N, M, 3) of M places: their middles (M, 3) and radii (M,)."""
    middle = draws.mean(0)
    return middle, (draws - middle).norm(dim=-1).quantile(level, 0)


def held(draws: Tensor, truth: Tensor, levels: Sequence[float] = LEVELS, factor: float = 1.0) -> Tensor:
    """Share (levels,) of M places (M, 3) that lie in the ball of that level of their draws (N, M, 3)."""
    found = []
    for level in levels:
        middle, radius = radii(draws, level)
        found.append(((truth - middle).norm(dim=-1) <= factor * radius).double().mean())
    return torch.stack(found)


def needed(level: float, others: int) -> int:
    """How many of so many other clips a region must hold for one more clip like them to be held with probability
    ``level``: its rank among them is as likely to be any; all of them where they are too few to promise that much."""
    return min(others, math.ceil(level * (others + 1) - 1e-9))


def others_of(count: int, folds: int | None = None) -> Tensor:
    """(C, C) bool: [i, j] where clip j is another clip than i (``folds`` None: leave one out), or of another fold; clip
    i is in fold i modulo ``folds``."""
    fold = torch.arange(count) % (folds or count)
    return fold[:, None] != fold


def fold_factors(stretches: Tensor, level: float = 0.9, folds: int | None = None) -> Tensor:
    """For each clip (C,) the factor on the spread that holds ``needed`` of the *other* clips. NaN among the stretches
    (C,) is a clip that does not count; where no other counts, NaN is the answer."""
    found = []
    for mask in others_of(len(stretches), folds):
        others = stretches[mask & stretches.isfinite()].sort().values
        found.append(others[needed(level, len(others)) - 1] if len(others) else stretches.new_tensor(torch.nan))
    return torch.stack(found)


def coverage(levels_of: Tensor, generator: torch.Generator, levels: Sequence[float] = LEVELS) -> list[dict]:
    """A row per level: share of clips whose region holds the truth, from u (C,), and Wilson's 95 % interval."""
    rows = []
    for level in levels:
        value, low, high = intervals.interval((levels_of <= level).double(), "share", generator)
        rows.append({"level": level, "share": value, "low": low, "high": high, "n": len(levels_of)})
    return rows


def table(found: Mapping[str, Tensor], widths: Mapping[str, float], generator: torch.Generator) -> list[dict[str, str]]:
    """Rows for a report: who says how much and how often it is so, beside how wide the region of 90 % is (cm)."""
    return [
        {"region": name}
        | {
            f"{100 * row['level']:g} %": f"{100 * row['share']:.0f} [{100 * row['low']:.0f}, {100 * row['high']:.0f}]"
            for row in coverage(levels_of, generator)
        }
        | {"radius of 90 %, cm": f"{widths[name]:.1f}", "n": str(len(levels_of))}
        for name, levels_of in found.items()
    ]
