"""Few numbers whose posterior is bent, as those of an assumed camera, drawn by emcee until its walkers have mixed.

Source: Foreman-Mackey et al. 2013 (emcee; 50 autocorrelation times are its own rule).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import emcee
import numpy as np
import torch
from torch import Tensor

from motionlab.errors import DataError, NotConverged, ShapeError, check_shape

LEAST = 50  # autocorrelation times that a chain of walkers must be long
LOOKS = 2  # looks in a row at which it must be: of many looks at a noisy estimate one is low by chance
BURN = 5  # autocorrelation times that are thrown away at its beginning


@dataclass(frozen=True, eq=False)
class Chain:
    """A chain of W walkers in n numbers, its beginning cut off.

    chain (S, W, n), log_prob (S, W): float64. times (n,): autocorrelation times, in steps. acceptance: mean share of
    accepted proposals. looks: in a row and up to the last one, at which the chain was long enough. least: times that it
    must be long. stopped: a person stopped it.
    """

    chain: Tensor
    log_prob: Tensor
    times: Tensor
    acceptance: float
    names: tuple[str, ...]
    looks: int
    least: float
    stopped: bool

    @property
    def long_enough(self) -> bool:
        """Whether the chain is long enough in every number, and was at the look before."""
        return self.looks >= LOOKS

    def draws(self, count: int | None = None) -> Tensor:
        """Returns draws (N, n), all or ``count`` of them evenly along the chain.

        Raises:
            NotConverged: the chain is too short to report.
        """
        if not self.long_enough:
            lengths = (len(self.chain) / self.times).tolist()
            short = ", ".join(f"{name} {length:.0f}" for name, length in zip(self.names, lengths, strict=True))
            raise NotConverged(
                f"the chain is {len(self.chain)} steps long, in autocorrelation times: {short}; a report needs "
                f"{self.least:g} at {LOOKS} looks in a row, had it at {self.looks} (remedy: more steps or walkers)",
                self.times.tolist(),
            )
        flat = self.chain.flatten(0, 1)
        many = len(flat) if count is None else min(count, len(flat))
        return flat[torch.linspace(0, len(flat) - 1, many).round().long()]


def walkers(
    log_prob: Callable[[Tensor], Tensor],
    start: Tensor,
    *,
    names: Sequence[str],
    generator: torch.Generator,
    steps: int = 2000,
    block: int = 100,
    least: float = LEAST,
) -> Chain:
    """Draws from a posterior over few numbers until the chain is long enough to report at ``LOOKS`` looks in a row.

    At most ``steps``; Ctrl-C keeps what there is. Walkers follow differential evolution: the ensemble itself says how
    the numbers go together, as along a bent ridge.

    Args:
        log_prob: of points (k, n), float64, in nats up to a constant, (k,); what is not finite counts as impossible.
        start: (W, n), at least 2 n walkers, all of them possible.
        names: of the n numbers. generator: the chain depends on nothing else that is random.
        block: steps between two looks at the length. least: autocorrelation times that the chain must be long.

    Raises:
        ShapeError: names do not fit, or too few walkers. DataError: a walker starts at an impossible point.
    """
    many, count = check_shape(start, "W n", "start").values()
    if len(names) != count or many < 2 * count:
        raise ShapeError(f"start: {many} walkers of {count} numbers, at least {2 * count} needed; {len(names)} names")

    def of(points: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            found = log_prob(torch.from_numpy(points)).double().numpy(force=True)
        return np.where(np.isfinite(found), found, -np.inf)

    where = start.double().numpy(force=True).copy()
    first = of(where)
    if not np.isfinite(first).all():
        bad = int((~np.isfinite(first)).sum())
        raise DataError(f"{bad} of {many} walkers start at impossible points", remedy="start nearer the posterior")
    random = np.random.RandomState(int(torch.randint(2**31 - 1, (), generator=generator)))  # what emcee takes
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(many, count, of, vectorize=True, moves=moves)
    state, looks, stopped = emcee.State(where, log_prob=first, random_state=random.get_state()), 0, False
    while sampler.iteration < steps and looks < LOOKS and not stopped:
        try:
            state = sampler.run_mcmc(state, min(block, steps - sampler.iteration))
        except KeyboardInterrupt:
            if not sampler.iteration:
                raise
            stopped = True
        kept, times = _kept(sampler)
        looks = looks + 1 if bool((len(kept) >= least * times).all()) else 0  # not so where a time is not finite
    log_probs = torch.from_numpy(sampler.get_log_prob()[-len(kept) :].copy())
    return Chain(kept, log_probs, times, float(sampler.acceptance_fraction.mean()), tuple(names), looks, least, stopped)


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
