"""The same questions put to many clips: is the truth where the posterior says it is?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D
from motionlab.posterior import LEAST, Posterior, walk
from studies.nb09_posterior import calibration, depth
from studies.nb09_posterior.depth import Known
from studies.nb09_posterior.legs import Open

CM = 100.0


@dataclass(frozen=True, eq=False)
class Draws:
    """Legs that one clip's posterior thinks possible.

    chain: None for a Gaussian. c (D, k): in the directions. ways (D, T, 6, 3): the hidden legs about the pelvis,
    metres; coordinates (D, k): of these, along the directions. energy (D,): nats, None for a Gaussian.
    """

    chain: Posterior | None
    c: Tensor
    ways: Tensor
    coordinates: Tensor
    energy: Tensor | None = None


def sampled(
    clip: Open,
    generator: torch.Generator,
    *,
    temperature: float = 1.0,
    walkers: int = 12,
    steps: int = 800,
    warm: int = 40,
    draws: int = 200,
    least: float = LEAST,
    progress: bool = False,
) -> Draws | None:
    """emcee on the directions of one clip; None where the chain is too short to report."""
    names = [f"direction {k + 1}" for k in range(clip.size)]
    factor = temperature**0.5 * torch.eye(clip.size, dtype=torch.float64)
    chain = walk(
        lambda c: clip.log_prob(c, temperature), clip.mean, factor, walkers=walkers, generator=generator, steps=steps,
        block=25, warm=warm, names=names, units=("s.d.",) * clip.size, least=least, progress=progress,
    )  # fmt: skip
    if not chain.long_enough:
        return None
    c, energy = chain.draws(), -temperature * chain.log_prob.flatten()
    some = torch.linspace(0, len(c) - 1, min(draws, len(c))).round().long()
    ways = clip.roll(c[some])[0]
    return Draws(chain, c[some], ways, clip.coordinates(ways), energy[some])


def gaussian(clip: Open, generator: torch.Generator, *, temperature: float = 1.0, draws: int = 200) -> Draws:
    """Laplace's posterior in the same directions, its legs to first order."""
    c = clip.mean + temperature**0.5 * torch.randn(draws, clip.size, generator=generator, dtype=torch.float64)
    centre = clip.roll(torch.zeros(1, clip.size))[0]
    moved = (c * clip.directions.spread) @ clip.directions.shapes.mT
    return Draws(None, c, centre + moved.float().reshape(-1, *centre.shape[1:]), c)


def spread_out(draws: Draws, clip: Open, generator: torch.Generator, temperature: float = 1.0) -> Draws:
    """The same draws with the scatter of all other directions added to the legs."""
    return Draws(
        draws.chain, draws.c, draws.ways + temperature**0.5 * clip.scatter(len(draws.c), generator), draws.coordinates
    )


def joint_shares(
    clips: Sequence[Open], found: Sequence[Draws], truths: Sequence[Tensor], level: float = 0.9
) -> tuple[Tensor, Tensor]:
    """For each clip (C,): share of its hidden joints and frames that lie in their own ball of a level, and the mean
    radius of these balls in cm. truths: legs about the pelvis (T, 6, 3)."""
    shares, widths = [], []
    for clip, draws, truth in zip(clips, found, truths, strict=True):
        hidden = clip.point.hidden
        places = draws.ways[:, hidden]
        shares.append(calibration.held(places, truth[hidden], (level,))[0])
        widths.append(CM * calibration.radii(places, level)[1].mean())
    return torch.stack(shares), torch.stack(widths)


def fixed_ball(clips: Sequence[Open], truths: Sequence[Tensor], level: float = 0.9, folds: int = 4):
    """As :func:`joint_shares`, for a ball of one size around the fit, in which a level of the joints of the clips in
    the other folds lie."""
    away = []
    for clip, truth in zip(clips, truths, strict=True):
        fit = clip.roll(torch.zeros(1, clip.size))[0][0]
        away.append((truth - fit).norm(dim=-1)[clip.point.hidden])
    fold = [index % folds for index in range(len(clips))]
    shares, widths = [], []
    for index, mine in enumerate(away):
        others = torch.cat([x for x, f in zip(away, fold, strict=True) if f != fold[index]])
        radius = others.quantile(level)
        shares.append((mine <= radius).float().mean())
        widths.append(CM * radius)
    return torch.stack(shares), torch.stack(widths)


@dataclass(frozen=True, eq=False)
class Placed:
    """Where one clip's person may stand: the chain of depth's three numbers, Laplace's mean and factor, the truth.

    again: more chains of the same, each with a guess, a warm-up and walkers of its own.
    """

    chain: Posterior
    mean: Tensor
    factor: Tensor
    truth: Tensor
    again: tuple[Posterior, ...] = ()


def placed(
    fit: Motion,
    betas: Tensor,
    observation: Observation2D,
    camera: Camera,
    truth: Motion,
    known: Known,
    frames: Tensor,
    generator: torch.Generator,
    *,
    walkers: int = 24,
    steps: int = 2000,
    ensembles: int = 2,
    least: float = LEAST,
) -> Placed:
    """One clip under one state of knowledge, its camera's height measured as wrong as that says (at most 5 cm)."""
    error = min(known.camera, 0.05) * float(torch.randn((), generator=generator, dtype=torch.float64))
    view = depth.view(fit, betas, observation, camera, frames)
    exact = depth.true_numbers(view, truth, camera, frames) - torch.tensor([0.0, 0.0, error])
    view = view.moved(error)
    mean, factor = view.laplace(known)
    chain, *again = (
        walk(
            lambda theta: view.log_prob(theta, known), mean, factor, walkers=walkers, generator=generator, steps=steps,
            names=depth.NAMES, units=depth.UNITS, least=least,
        )
        for _ in range(ensembles)
    )  # fmt: skip
    return Placed(chain, mean, factor, exact, tuple(again))
