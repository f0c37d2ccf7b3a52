"""Draws from a posterior over a few numbers by emcee's walkers; refuses to report chains that are too short.

All walkers of a move are evaluated in one batch. A chain counts by its length in autocorrelation times, and one that
never saw a second mode underestimates them: compare ensembles that began apart (notebook 09, ``agreement``). With the
stretch and differential-evolution moves walkers are not independent, so that R-hat across walkers says nothing; with
Metropolis-Hastings moves alone (``mixed``) they are chains of their own in one batch.

Source: Foreman-Mackey et al. 2013 (emcee); Goodman & Weare 2010; the 50 autocorrelation times are emcee's own rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import emcee
import numpy as np
import torch
from emcee import moves
from torch import Tensor
from tqdm.auto import tqdm

from motionlab.errors import DataError, NotConverged, ShapeError, check_shape

LEAST = 50  # autocorrelation times that a chain must be long
LOOKS = 2  # looks in a row at which it must be: of many looks at a noisy estimate one is low by chance
BURN = 5  # autocorrelation times that are thrown away at its beginning
_FEW = 0.35  # of independent proposals: below, the Gaussian behind them is a bad one
_BULK, _TAIL = 1.15, 8.0  # of the independent proposal: wider than the Gaussian, degrees of freedom of its tails

LogProb = Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Posterior:
    """A chain of W walkers in n numbers, its beginning cut off.

    chain (S, W, n), log_prob (S, W): float64. times (n,): autocorrelation times, in steps. acceptance: mean share of
    accepted proposals. names, units: of the numbers. burned: steps cut off. stopped: a person stopped it. looks: in a
    row and up to the last one, at which the chain was long enough. least: autocorrelation times that it must be long.
    """

    chain: Tensor
    log_prob: Tensor
    times: Tensor
    acceptance: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    burned: int
    stopped: bool = False
    looks: int = LOOKS
    least: float = LEAST

    @property
    def lengths(self) -> Tensor:
        """Length of the chain in autocorrelation times (n,)."""
        return len(self.chain) / self.times

    @property
    def long_enough(self) -> bool:
        """Whether the chain is ``least`` autocorrelation times long in every number, and was at the look before."""
        return self.looks >= LOOKS and _long(self.lengths, self.least)

    def draws(self, count: int | None = None) -> Tensor:
        """Returns draws (N, n), all or ``count`` of them evenly along the chain.

        Raises:
            NotConverged: the chain is too short to report.
        """
        if not self.long_enough:
            short = ", ".join(
                f"{name} {length:.0f}" for name, length in zip(self.names, self.lengths.tolist(), strict=True)
            )
            raise NotConverged(
                f"the chain is {len(self.chain)} steps long, in autocorrelation times: {short}; a report needs "
                f"{self.least:g} at {LOOKS} looks in a row, it had them at {self.looks} (remedy: more steps, walkers "
                "nearer the posterior, or other moves)",
                self.times.tolist(),
            )
        flat = self.chain.flatten(0, 1)
        if count is None or count >= len(flat):
            return flat
        return flat[torch.linspace(0, len(flat) - 1, count).round().long()]

    def summary(self, level: float = 0.9) -> dict[str, tuple[float, float, float]]:
        """Computes the median and the ends of the central ``level`` of every number, by name.

        Raises:
            NotConverged: the chain is too short to report.
        """
        half = (1 - level) / 2
        at = self.draws().quantile(torch.tensor([0.5, half, 1 - half], dtype=torch.float64), 0)
        return {name: tuple(each) for name, each in zip(self.names, at.mT.tolist(), strict=True)}

    def report(self, level: float = 0.9) -> list[dict[str, object]]:
        """Returns a table's rows: every number with its interval, its autocorrelation time and the length of its chain.

        Raises:
            NotConverged: the chain is too short to report.
        """
        return [
            {
                "number": name,
                "unit": unit,
                "median": median,
                f"{100 * level:g} % interval": f"{low:.3g} to {high:.3g}",
                "autocorrelation time, steps": time,
                "length, such times": f"{length:.0f}",
            }
            for (name, (median, low, high)), unit, time, length in zip(
                self.summary(level).items(), self.units, self.times.tolist(), self.lengths.tolist(), strict=True
            )
        ]


def sample(
    log_prob: LogProb,
    start: Tensor,
    *,
    names: Sequence[str],
    generator: torch.Generator,
    units: Sequence[str] | None = None,
    steps: int = 2000,
    block: int = 100,
    moves: Sequence[tuple[moves.Move, float]] | None = None,
    least: float = LEAST,
    progress: bool = False,
) -> Posterior:
    """Draws from a posterior by walkers until the chain is long enough to report at ``LOOKS`` looks in a row.

    At most ``steps``; Ctrl-C keeps what there is.

    Args:
        log_prob: of points (k, n), float64, in nats up to a constant, (k,); what is not finite counts as impossible.
        start: (W, n), at least 2 n walkers, all of them possible.
        names, units: of the n numbers. generator: the chain depends on nothing else that is random.
        block: steps between two looks at the length. moves: emcee's, with their shares; its stretch move by default.
        least: autocorrelation times that the chain must be long to report.
        progress: show a bar of the length in autocorrelation times.

    Raises:
        ShapeError: names do not fit, or too few walkers. DataError: a walker starts at an impossible point.
    """
    walkers, count = check_shape(start, "W n", "start").values()
    units = tuple(units or ("",) * count)
    if len(names) != count or len(units) != count:
        raise ShapeError(f"start: {count} numbers, but {len(names)} names and {len(units)} units")
    if walkers < 2 * count:
        raise ShapeError(f"start: {count} numbers need at least {2 * count} walkers, got {walkers}")

    def many(points: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            found = log_prob(torch.from_numpy(points)).double().numpy(force=True)
        return np.where(np.isfinite(found), found, -np.inf)

    where = start.double().numpy(force=True).copy()
    first = many(where)
    if not np.isfinite(first).all():
        bad = int((~np.isfinite(first)).sum())
        raise DataError(f"{bad} of {walkers} walkers start at impossible points", remedy="start nearer the posterior")
    seed = int(torch.randint(2**31 - 1, (), generator=generator))
    random = np.random.RandomState(seed)  # what emcee takes; nothing global is touched
    sampler = emcee.EnsembleSampler(walkers, count, many, vectorize=True, moves=list(moves) if moves else None)
    state = emcee.State(where, log_prob=first, random_state=random.get_state())
    return _until_long(sampler, state, tuple(names), units, steps, block, least, progress)


def _until_long(sampler, state, names, units, steps: int, block: int, least: float, progress: bool) -> Posterior:
    stopped, found, looks = False, None, 0
    with tqdm(total=least, desc="autocorrelation times", disable=not progress, bar_format="{l_bar}{bar}") as bar:
        while sampler.iteration < steps and not stopped:
            try:
                state = sampler.run_mcmc(state, min(block, steps - sampler.iteration))
            except KeyboardInterrupt:
                stopped = True
            if not sampler.iteration:
                raise KeyboardInterrupt
            found = _posterior(sampler, names, units, stopped)
            looks = looks + 1 if _long(found.lengths, least) else 0
            found = replace(found, looks=looks, least=least)
            bar.n = min(least, round(found.lengths.nan_to_num(0.0).amin().item(), 1))
            bar.refresh()
            if found.long_enough:
                break
    if found is None:
        raise ShapeError(f"steps: expected at least 1, got {steps}")
    return found


def _posterior(sampler, names, units, stopped: bool) -> Posterior:
    """The chain so far, less ``BURN`` of its longest autocorrelation time, at most half."""
    chain, log_prob = sampler.get_chain(), sampler.get_log_prob()
    longest = _times(torch.from_numpy(chain)).amax().item()
    burned = min(math.ceil(BURN * longest), len(chain) // 2) if math.isfinite(longest) else len(chain) // 2
    kept = torch.from_numpy(chain[burned:].copy())
    return Posterior(
        kept, torch.from_numpy(log_prob[burned:].copy()), _times(kept), float(sampler.acceptance_fraction.mean()),
        names, units, burned, stopped,
    )  # fmt: skip


def _long(lengths: Tensor, least: float) -> bool:
    return bool((lengths >= least).all())  # not so where a time is not finite


def _times(chain: Tensor) -> Tensor:
    """Integrated autocorrelation times (n,), in steps, of a chain (S, W, n); NaN where a number never moved."""
    with np.errstate(invalid="ignore", divide="ignore"):
        found = emcee.autocorr.integrated_time(chain.numpy(force=True), tol=0)
    return torch.from_numpy(np.maximum(found, 1.0))  # an estimate below one step is noise; NaN stays


def _independent(mean: Tensor, factor: Tensor) -> moves.Move:
    """Proposals that do not look where the walker is: a Student t around a Gaussian's mean (n,), factor (n, n).

    The covariance is factor factor^T. Where the posterior is nearly this Gaussian, a chain forgets in a few steps; the
    heavy tails keep it right where it is not, and another move beside it keeps it moving.
    """
    centre, scale = mean.double().numpy(force=True), _BULK * factor.double().numpy(force=True)
    inverse, size = np.linalg.inv(scale), len(centre)

    def log_density(points: np.ndarray) -> np.ndarray:
        squared = (((points - centre) @ inverse.T) ** 2).sum(-1)
        return -0.5 * (_TAIL + size) * np.log1p(squared / _TAIL)

    def propose(points: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        wide = np.sqrt(_TAIL / random.chisquare(_TAIL, size=(len(points), 1)))
        new = centre + wide * random.normal(size=points.shape) @ scale.T
        return new, log_density(points) - log_density(new)

    return moves.MHMove(propose)


def _near(factor: Tensor) -> moves.Move:
    """Small steps by a Gaussian of this factor (n, n); by the factor and not, as emcee has it, by a singular value
    decomposition, whose signs depend on rounding."""
    scale = 2.4 / len(factor) ** 0.5 * factor.double().numpy(force=True)  # Roberts, Gelman & Gilks 1997

    def propose(points: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        return points + random.normal(size=points.shape) @ scale.T, np.zeros(len(points))

    return moves.MHMove(propose)


def mixed(mean: Tensor, factor: Tensor) -> list[tuple[moves.Move, float]]:
    """Makes moves from a Gaussian guess of the posterior: independent proposals, and small steps where it is wrong."""
    return [(_independent(mean, factor), 0.75), (_near(factor), 0.25)]


def _guess(
    log_prob: LogProb, mean: Tensor, factor: Tensor, generator: torch.Generator, *, rounds: int = 2, draws: int = 64
) -> tuple[Tensor, Tensor]:
    """A better Gaussian guess, mean (n,) and factor (n, n), by least squares: a parabola through the better half of
    ``draws`` of the last.

    Curvatures are kept between a fourth and nine times the last ones', and the mean within two of its deviations.
    """
    count = len(mean)
    upper = torch.triu_indices(count, count)
    for _ in range(rounds):
        x = torch.randn(draws, count, generator=generator, dtype=torch.float64)  # in the last guess's own axes
        value = log_prob(mean + x @ factor.mT).double()
        value = torch.where(value.isfinite(), value, -torch.inf)
        best = value.topk(max(2 * len(upper[0]) + 2 * count, draws // 2)).indices  # far off no parabola holds
        best = best[value[best].isfinite()]
        terms = torch.cat((torch.ones(draws, 1).double(), x, x[:, upper[0]] * x[:, upper[1]]), 1)[best]
        weight = (0.25 * (value[best] - value.max())).clamp(min=-3.0).exp()[:, None]
        found = torch.linalg.lstsq(weight * terms, weight * value[best, None]).solution[:, 0]
        bent = torch.zeros(count, count, dtype=torch.float64)
        bent[upper[0], upper[1]] = -found[1 + count :]
        size, axes = torch.linalg.eigh(bent + bent.mT)
        size = size.clamp(1 / 4, 9.0)
        step = axes @ ((axes.mT @ found[1 : 1 + count]) / size)
        step = step / max(1.0, float(step.norm()) / 2)
        mean = mean + factor @ step
        factor = torch.linalg.cholesky(factor @ (axes / size) @ axes.mT @ factor.mT)
    return mean, factor


def walk(
    log_prob: LogProb, mean: Tensor, factor: Tensor, *, walkers: int, generator: torch.Generator, warm: int = 40, **how
) -> Posterior:
    """Draws by :func:`sample` from a Gaussian guess, mean (n,) and factor (n, n), that need only be near.

    The guess is improved first, and again by ``warm`` steps, up to six times while few proposals are accepted; all this
    is thrown away.

    how: goes to ``sample``.
    """

    def plain(points: Tensor) -> Tensor:
        with torch.no_grad():
            return log_prob(points)

    mean, factor = _guess(plain, mean.double(), factor.double(), generator)
    at = mean + 0.7 * torch.randn(walkers, len(mean), generator=generator, dtype=torch.float64) @ factor.mT
    first = how | {"steps": warm, "block": warm, "progress": False}
    for _ in range(6):
        found = sample(log_prob, at, generator=generator, moves=mixed(mean, factor), **first)
        flat, at = found.chain.flatten(0, 1), found.chain[-1]
        mean = flat.mean(0)
        factor = torch.linalg.cholesky(torch.atleast_2d(flat.mT.cov()) + 1e-3 * factor @ factor.mT)
        if found.acceptance > _FEW or found.stopped:
            break
    return sample(log_prob, at, generator=generator, moves=mixed(mean, factor), **how)
