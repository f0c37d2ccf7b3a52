"""Confidence intervals by the bootstrap: of a statistic, and of the difference of paired samples."""

import math
from typing import NamedTuple

import torch
from torch import Tensor


def interval(
    samples: Tensor, statistic: str, generator: torch.Generator, draws: int = 2000
) -> tuple[float, float, float]:
    """Computes a statistic of samples (N,) and its 95 % bootstrap percentile interval: (value, low, high).

    statistic: "mean", "median", "max", "min", "p95" (95th percentile), or "share" (mean of 0/1 samples, with
    Wilson's interval, which stays honest when all samples agree). One sample has no spread: low = high = value.
    """
    samples = samples.detach().double().flatten()
    if statistic == "share":
        return _wilson(samples.mean().item(), len(samples))
    measure = {
        "mean": lambda x: x.mean(-1),
        "median": lambda x: x.quantile(0.5, -1),
        "p95": lambda x: x.quantile(0.95, -1),
        "max": lambda x: x.amax(-1),
        "min": lambda x: x.amin(-1),
    }[statistic]
    value = measure(samples).item()
    if len(samples) < 2 or statistic in ("max", "min"):  # the bootstrap cannot see past an extreme
        return value, value, value
    pick = torch.randint(len(samples), (draws, len(samples)), generator=generator)
    low, high = measure(samples[pick]).quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return value, low, high


def _wilson(share: float, n: int, z: float = 1.96) -> tuple[float, float, float]:
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return share, max(0.0, centre - half), min(1.0, centre + half)


class Paired(NamedTuple):
    """The mean difference of paired samples with its 95 % bootstrap interval, and how many there were."""

    mean: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        return f"{self.mean:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


def paired(after: Tensor, before: Tensor, generator: torch.Generator) -> Paired:
    """Computes the mean of ``after`` - ``before`` with its 95 % interval; pairs that are not finite are dropped."""
    difference = (after - before).flatten()
    difference = difference[difference.isfinite()]
    return Paired(*interval(difference, "mean", generator), len(difference))
