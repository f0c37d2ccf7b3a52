"""What is measured of sets of windows, and how sure each number is by person.

Coverage and recall are shares of recorded windows, so each person has their own. What belongs to a set as a whole (a
Frechet distance, a ratio of means) is left once without each person and as many samples; the pseudo-values say how sure
it is (jackknife). What a sample has by itself is over the mean of the training motion, which is known in full.

Source: Naeem et al. 2020 (coverage), Kynkaanniemi et al. 2019 (recall), Heusel et al. 2017 (Frechet); Efron and Stein
1981 (pseudo-values); Lopez-Paz and Oquab 2017 (the classifier of two samples).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from motionlab import metrics
from motionlab.bench import by_person
from motionlab.metrics import interval
from motionlab.motion import Motion
from studies.shared import small_measures
from studies.shared.feature_training import motion_encoder

#: Ratios of means, by the field of ``Judged`` that is averaged.
RATIOS = ("travel", "slide", "acceleration")


@dataclass(frozen=True, eq=False)
class Judged:
    """What is measured of windows, once: latent (N, D) learnt features; travel (N,): m/s of the pelvis over the floor;
    slide (N,): mm a frame of balls of feet that are down, NaN where none is; acceleration (N,): m/s^2 of the joints."""

    latent: Tensor
    travel: Tensor
    slide: Tensor
    acceleration: Tensor

    @classmethod
    def of(cls, motion: Motion) -> Self:
        """Measures windows (N, T) on the standard body, feet on a floor at z = 0."""
        shaken = motion.fps**2 * motion.positions.diff(n=2, dim=-3).norm(dim=-1).mean((-1, -2))
        slide, latent = small_measures.slide_mm(motion), motion_encoder("features_real")(motion)
        return cls(latent, small_measures.travel(motion), slide, shaken)

    def clip(self, rows: Tensor) -> Self:
        """Those rows, a mask or indices, as ``Motion.clip`` takes them."""
        return Judged(self.latent[rows], self.travel[rows], self.slide[rows], self.acceleration[rows])


def shares(made: Judged, real: Judged, whose: Tensor) -> dict[str, Tensor]:
    """Coverage and recall (P,) of each person: of their windows, how many have a sample among their five nearest
    people's windows; how many lie within a sample's three nearest samples."""
    apart = torch.cdist(made.latent.double(), real.latent.double())
    latents = ((real.latent.double(), 5), (made.latent.double(), 3))
    around, among = (torch.cdist(x, x).kthvalue(k + 1, dim=1).values for x, k in latents)
    found = {"coverage": (apart < around).any(0), "recall": (apart <= among[:, None]).any(0)}
    return {name: by_person(hit.double(), whose) for name, hit in found.items()}


def frechet(made: Judged, real: Judged) -> float:
    """The Frechet distance of the features."""
    return metrics.frechet(made.latent, real.latent)


def ratio(name: str) -> Callable[[Judged, Judged], float]:
    """Returns what computes the mean of a field over the other set's."""
    return lambda made, real: float(getattr(made, name).nanmean() / getattr(real, name).nanmean())


def pseudo(measure: Callable[..., float], sets: Sequence[Judged | Motion], groups: Tensor) -> Tensor:
    """Computes the jackknife's pseudo-values (G,) of a measure of sets of one size, left without each group (N,) of
    rows in all of them at once: G times the whole less G - 1 times what is left."""
    names = groups.unique()
    whole = measure(*sets)
    left = torch.tensor([measure(*(x.clip(groups != name) for x in sets)) for name in names], dtype=torch.float64)
    return len(names) * whole - (len(names) - 1) * left


def told_apart(x: Judged, y: Judged, generator: torch.Generator) -> Tensor:
    """How often the five nearest others tell which of two sets a sample is of: (2 N,), shares of random halvings; a
    coin is right in half. One half of one set stands beside the other half of the other, as sets begun from the same
    noise are nearer to each other than chance."""
    half, (right, tried) = len(x.latent) // 2, torch.zeros(2, 2, len(x.latent))
    label = torch.arange(2 * half) >= half
    for _ in range(40):
        order = torch.randperm(len(x.latent), generator=generator)
        a, b = order[:half], order[half : 2 * half]
        z = torch.cat((x.latent[a], y.latent[b])).double()
        near = torch.cdist(z, z).fill_diagonal_(torch.inf).topk(5, largest=False).indices
        hit = ((label[near].double().mean(1) > 0.5) == label).float()
        for k, rows, part in ((0, a, hit[:half]), (1, b, hit[half:])):
            right[k, rows] += part
            tried[k, rows] += 1
    return (right / tried).flatten().double()


def over(made: Judged, taught: Judged, name: str) -> Tensor:
    """A field of each sample over the mean of the training motion's (N,); those without one are left out."""
    values = getattr(made, name).double()
    return values[values.isfinite()] / getattr(taught, name).double().nanmean()


def row(
    made: Judged, real: Judged, whose: Tensor, taught: Judged, generator: torch.Generator
) -> dict[str, tuple[float, float, float]]:
    """Every measure of a set: beside people, with 95 % intervals by person; over training motion, by sample."""
    found = shares(made, real, whose) | {"Frechet distance": pseudo(frechet, [made, real], whose)}
    found |= {f"{name} (ratio)": over(made, taught, name) for name in RATIOS}
    return {name: interval(values, "mean", generator) for name, values in found.items()}


def against(made: Judged, other: Judged, real: Judged, whose: Tensor, taught: Judged) -> dict[str, Tensor]:
    """Coverage of people by person (P,), and how a set compares with another of the same noise: pseudo-values (P,) of
    ratios of means, and of Frechet distances to training motion."""

    def farther(x: Judged, y: Judged) -> float:
        return frechet(x, taught) / frechet(y, taught)

    found = {"coverage": shares(made, real, whose)["coverage"], "Frechet": pseudo(farther, [made, other], whose)}
    return found | {name: pseudo(ratio(name), [made, other], whose) for name in RATIOS}


def beside_the_best(
    judged: Mapping[str, Judged], rivals: Sequence[str], real: Judged, whose: Tensor, taught: Judged
) -> dict[str, tuple[Tensor, Tensor, str]]:
    """What D06 asks of "P", and the same of the best of some rivals: test -> (values, the rival's, its name). covers:
    by person (P,), coverage less 0.8 times that of "training people", the more the better. The others are over
    training motion, by sample, the nearer to 1 the better."""
    cover = {name: shares(made, real, whose)["coverage"] for name, made in judged.items()}
    cover = {name: mine - 0.8 * cover["training people"] for name, mine in cover.items()}
    best = max(rivals, key=lambda name: cover[name].mean())
    found = {"covers": (cover["P"], cover[best], best)}
    for test, name in (("travel", "travel"), ("slides", "slide"), ("acceleration", "acceleration")):
        values = {who: over(judged[who], taught, name) for who in ("P", *rivals)}
        best = min(rivals, key=lambda who: abs(math.log(max(float(values[who].mean()), 1e-9))))
        found[test] = (values["P"], values[best], best)
    return found
