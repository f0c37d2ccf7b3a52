"""How far sources of motion are from each other: their windows described, and a distance with its floor."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from motionlab.errors import ShapeError, check_shape
from motionlab.metrics.distribution import DESCRIPTION_UNITS, Described, describe
from motionlab.motion import Motion, windows


def describe_windows(
    motions: Sequence[Motion], generator: torch.Generator, *, most: int, seconds: float = 2.0
) -> Described:
    """Describe at most ``most`` windows of ``seconds``, half overlapping, drawn at random over all recordings.

    Recordings that are shorter than one window are left out.
    """
    parts, groups = [], []
    for group, motion in enumerate(motions):
        length = round(seconds * motion.fps)
        if motion.frames >= length:
            parts.append(describe(windows(motion, length, length // 2)))
            groups += [group] * len(parts[-1]["root speed"])
    pick = torch.randperm(len(groups), generator=generator)[:most]
    return Described({k: torch.cat([p[k] for p in parts])[pick] for k in DESCRIPTION_UNITS}, torch.tensor(groups)[pick])


def pool(parts: Sequence[Described]) -> Described:
    """Joins several described sets into one; recordings stay apart."""
    first = torch.tensor([0] + [int(p.groups.max()) + 1 for p in parts[:-1]]).cumsum(0)
    groups = torch.cat([p.groups + start for p, start in zip(parts, first, strict=True)])
    return Described({k: torch.cat([p.values[k] for p in parts]) for k in DESCRIPTION_UNITS}, groups)


def apart(part: Described) -> Described:
    """The same windows, each counted as a recording of its own."""
    return Described(part.values, torch.arange(len(part.groups)))


def standardised_energy_distance(
    ours: Described, theirs: Described, generator: torch.Generator, draws: int = 50
) -> tuple[float, Tensor]:
    """Energy distance between two sets, standardised by the second's mean and deviation, and the second's floor."""
    middle, spread = theirs.table.mean(0), theirs.table.std(0)
    x, y = ((d.table - middle) / spread for d in (ours, theirs))
    return _energy_distance(x, y), _distance_floor(y, theirs.groups, generator, draws)


def _energy_distance(x: Tensor, y: Tensor) -> float:
    """Energy distance between samples (N, D) and (M, D): 0 where the distributions agree, never below.

    2 E|X - Y| - E|X - X'| - E|Y - Y'|, square root; every pair but a sample with itself. The estimate is
    unbiased before the root and clamped at zero. It has the unit of the features: standardise them first.

    Source: Szekely and Rizzo 2013, Eq. 5.3 (U-statistic form).
    Raises:
        ShapeError: fewer than two samples on a side, or different D.
    """
    check_shape(y, f"M {check_shape(x, 'N D', 'x')['D']}", "y")
    if min(len(x), len(y)) < 2:
        raise ShapeError(f"energy_distance: needs two samples a side, got {len(x)} and {len(y)}")
    x, y = x.double(), y.double()
    within = [torch.cdist(s, s).sum() / (len(s) * (len(s) - 1)) for s in (x, y)]
    squared = 2 * torch.cdist(x, y).mean() - within[0] - within[1]
    return math.sqrt(max(squared.item(), 0.0))


def _distance_floor(x: Tensor, groups: Tensor, generator: torch.Generator, draws: int = 50) -> Tensor:
    """Distances (draws,) between random halves of one set (N, D), split by group: what sampling alone explains.

    groups (N,): windows of one recording stay on one side, as recordings are the independent units.

    Raises:
        ShapeError: fewer than two groups.
    """
    names = groups.unique()
    if len(names) < 2:
        raise ShapeError("floor: needs at least two groups")
    found = []
    for _ in range(draws):
        mine = torch.isin(groups, names[torch.randperm(len(names), generator=generator)[: len(names) // 2]])
        if 2 <= int(mine.sum()) <= len(x) - 2:
            found.append(_energy_distance(x[mine], x[~mine]))
    return torch.tensor(found)


def halves(part: Described, generator: torch.Generator) -> tuple[Described, Described]:
    """Splits one set into two random halves, whole recordings on either side."""
    names = part.groups.unique()
    mine = torch.isin(part.groups, names[torch.randperm(len(names), generator=generator)[: len(names) // 2]])
    return tuple(Described({k: v[m] for k, v in part.values.items()}, part.groups[m]) for m in (mine, ~mine))
