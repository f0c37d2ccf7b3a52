"""Few numbers whose posterior is bent, as those of an assumed camera, drawn by emcee until its walkers have mixed.

Source: Foreman-Mackey et al. 2013 (emcee; 50 autocorrelation times are its own rule).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import emcee
import numpy as np
import torch
from torch import Tensor

from motionlab.errors import NotConverged

LEAST = 50  # autocorrelation times that a chain of walkers must be long
LOOKS = 2  # looks in a row at which it must be: of many looks at a noisy estimate one is low by chance
BURN = 5  # autocorrelation times that are thrown away at its beginning


@dataclass(frozen=True, eq=False)
class Chain:
    """A chain (S, W, n) of W walkers in n numbers, float64, its beginning cut off. times (n,): of autocorrelation, in
    steps. looks: in a row and up to the last one, at which it was ``least`` times long."""

    chain: Tensor
    times: Tensor
    looks: int
    least: float

    def draws(self, count: int | None = None) -> Tensor:
        """Returns draws (N, n), all or ``count`` of them evenly along the chain.

        Raises:
            NotConverged: the chain is too short to report.
        """
        if self.looks < LOOKS:
            lengths = ", ".join(f"{len(self.chain) / time:.0f}" for time in self.times.tolist())
            raise NotConverged(
                f"the chain is {len(self.chain)} steps long, in autocorrelation times: {lengths}; a report needs "
                f"{self.least:g} at {LOOKS} looks in a row, had it at {self.looks} (remedy: more steps or walkers)",
                self.times.tolist(),
            )
        flat = self.chain.flatten(0, 1)
        many = len(flat) if count is None else min(count, len(flat))
        return flat[torch.linspace(0, len(flat) - 1, many).round().long()]


def walkers(
    log_prob: Callable[[Tensor], Tensor], start: Tensor, *, generator: torch.Generator, steps: int = 2000,
    block: int = 100, least: float = LEAST,
) -> Chain:  # fmt: skip
    """Draws from a posterior over few numbers until the chain is long enough to report at ``LOOKS`` looks in a row.

    Walkers follow differential evolution: the ensemble itself says how the numbers go together, as along a bent ridge.

    Args:
        log_prob: of points (k, n), float64, in nats up to a constant, (k,); what is not finite counts as impossible.
        start: (W, n), at least 2 n walkers. generator: the chain depends on nothing else that is random.
        steps: at most. block: steps between two looks at the length. least: autocorrelation times that it must be long.
    """

    @torch.no_grad()
    def of(points: np.ndarray) -> np.ndarray:
        found = log_prob(torch.from_numpy(points)).double().numpy(force=True)
        return np.where(np.isfinite(found), found, -np.inf)

    random = np.random.RandomState(int(torch.randint(2**31 - 1, (), generator=generator)))  # what emcee takes
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(*start.shape, of, vectorize=True, moves=moves)
    state, looks = emcee.State(start.double().numpy(force=True), random_state=random.get_state()), 0
    while sampler.iteration < steps and looks < LOOKS:
        state = sampler.run_mcmc(state, min(block, steps - sampler.iteration))
        kept, times = _kept(sampler)
        looks = looks + 1 if bool((len(kept) >= least * times).all()) else 0  # not so where a time is not finite
    return Chain(kept, times, looks, least)


def _kept(sampler: emcee.EnsembleSampler) -> tuple[Tensor, Tensor]:
    """The chain so far, less ``BURN`` of its longest autocorrelation time, at most half; and its times (n,)."""
    chain = torch.from_numpy(sampler.get_chain().copy())
    longest = autocorrelation_times(chain).amax().item()
    cut = min(math.ceil(BURN * longest), len(chain) // 2) if math.isfinite(longest) else len(chain) // 2
    return chain[cut:], autocorrelation_times(chain[cut:])


def autocorrelation_times(chain: Tensor) -> Tensor:
    """Computes integrated autocorrelation times (n,), in steps, of (S, W, n); NaN where a number never moved."""
    with np.errstate(invalid="ignore", divide="ignore"):
        found = emcee.autocorr.integrated_time(chain.numpy(force=True), tol=0)
    return torch.from_numpy(np.maximum(found, 1.0))  # an estimate below one step is noise; NaN stays
