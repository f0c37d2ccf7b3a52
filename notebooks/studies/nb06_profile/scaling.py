"""How a cost grows: power laws and straight lines through noisy measurements, with what the noise leaves open.

    y = a x^b e^(s n),  n ~ N(0, 1)

Times scatter by a factor, not by an amount, hence the log-normal noise. Its size s is unknown too, and found.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import emcee
import numpy as np
import torch
from torch import Tensor

_BURN = 300  # steps of every walker that are thrown away


@dataclass(frozen=True, eq=False)
class PowerLaw:
    """Draws (N,) from the posterior of y = a x^b: scale a, exponent b, and noise s, of the logarithm of y."""

    scale: Tensor
    exponent: Tensor
    noise: Tensor

    def interval(self) -> tuple[float, float, float]:
        """Median of the exponent, and its central 95 %."""
        return tuple(self.exponent.quantile(torch.tensor([0.5, 0.025, 0.975]).to(self.exponent)).tolist())

    def at(self, x: Tensor | Sequence[float]) -> Tensor:
        """Draws (N, n) of the curve without its noise, at x (n,)."""
        x = torch.as_tensor(x, dtype=self.scale.dtype)
        return self.scale[:, None] * x ** self.exponent[:, None]

    def text(self) -> str:
        """The exponent as a person writes it, such as "0.97 [0.93, 1.01]"."""
        return "{:.2f} [{:.2f}, {:.2f}]".format(*self.interval())


def power_law(
    x: Tensor | Sequence[float], y: Tensor | Sequence[float], *, seed: int = 0, draws: int = 4000
) -> PowerLaw:
    """The posterior of a power law through n positive points, by emcee's affine-invariant walkers.

    Priors: flat in log a and b, and in log s between e^-9 and e^2.

    Args:
        x, y: (n,), positive, at least three points at two or more places. seed: the draws depend on nothing else.
    """
    x, y = (np.asarray(torch.as_tensor(v, dtype=torch.float64)).ravel() for v in (x, y))
    centre = np.log(x).mean()  # about which scale and exponent are independent
    u, v = np.log(x) - centre, np.log(y)

    def log_posterior(parameters: np.ndarray) -> np.ndarray:
        level, slope, noise = parameters.T[..., None]
        misfit = (v - level - slope * u) / np.exp(noise)
        value = -0.5 * (misfit**2).sum(-1) - len(v) * noise[:, 0]
        return np.where((noise[:, 0] > -9) & (noise[:, 0] < 2), value, -np.inf)

    (slope, level), walkers = np.polyfit(u, v, 1), 16
    spread = max((v - level - slope * u).std(), 1e-3)
    random = np.random.RandomState(seed)  # what emcee takes; nothing global is touched
    start = np.array([level, slope, np.log(spread)]) + random.normal(size=(walkers, 3)) * [spread, spread, 0.3]
    sampler = emcee.EnsembleSampler(walkers, 3, log_posterior, vectorize=True)
    state = emcee.State(start, random_state=random.get_state())
    sampler.run_mcmc(state, _BURN + -(-draws // walkers), skip_initial_state_check=True)
    levels, slopes, noises = torch.from_numpy(sampler.get_chain(discard=_BURN, flat=True)[-draws:].copy()).unbind(-1)
    return PowerLaw((levels - slopes * centre).exp(), slopes, noises.exp())


def laws(
    x: Sequence[float], seconds: Mapping[tuple[str, float], Tensor], series: Iterable[str], *, seed: int = 0
) -> dict[str, tuple[Sequence[float], Tensor, PowerLaw]]:
    """Finds the power law of each series in milliseconds: (x (k,), measurements (k, n), law).

    seconds: by series and x.
    """
    found = {}
    for name in series:
        y = 1e3 * torch.stack([seconds[name, at] for at in x])
        found[name] = x, y, power_law(torch.tensor(x).repeat_interleave(y.shape[1]), y.flatten(), seed=seed)
    return found


def slopes(x: Sequence[float], seconds: Mapping[tuple[str, float], Tensor], name: str) -> Tensor:
    """Computes one exponent per round (n,): the slope of a line through the logarithms."""
    u = torch.tensor(x).double().log()
    y = torch.stack([seconds[name, at] for at in x]).log()
    u = u - u.mean()
    return (u[:, None] * y).sum(0) / u.square().sum()


def fits(x: Sequence[float], y: Sequence[float], limit: float) -> float:
    """Computes where the straight lines through each two points (x_i, y_i), (x_j, y_j) reach y = ``limit``, the median;
    infinite where a line does not rise, as that of a few kilobytes."""
    found = []
    for (x0, y0), (x1, y1) in combinations(zip(x, y, strict=True), 2):
        if (x1 - x0) * (y1 - y0) <= 0:
            return math.inf
        found.append(x0 + (limit - y0) * (x1 - x0) / (y1 - y0))
    return torch.tensor(found, dtype=torch.float64).median().item() if found else math.inf
