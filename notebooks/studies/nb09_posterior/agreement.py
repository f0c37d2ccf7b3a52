"""Do chains that know nothing of each other agree? No autocorrelation time can tell: that of a chain which never left
one of two places is short.

Source: Gelman & Rubin 1992 (R-hat); split in halves as in Gelman et al., Bayesian Data Analysis, 2013.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from motionlab.errors import ShapeError
from motionlab.posterior import Posterior

AGREED = 1.01  # R-hat up to which ensembles are said to agree: Vehtari et al. 2021
_CHAINS = 2  # at the least


def r_hat(chains: Sequence[Tensor]) -> Tensor:
    """R-hat (n,) of chains (S, W, n): 1 where all agree.

    Every chain counts as two, its former and its latter half, each with all its walkers. An ensemble is one chain; with
    Metropolis-Hastings moves each of its walkers is one, too: ``r_hat(chain.split(1, 1))``.

    Raises:
        ShapeError: a single chain, which has nothing to agree with.
    """
    if len(chains) < _CHAINS:
        raise ShapeError(f"r_hat: expected at least {_CHAINS} chains, got {len(chains)}")
    halves = [half.flatten(0, 1).double() for chain in chains for half in chain.tensor_split(2)]
    within = torch.stack([half.var(0) for half in halves]).mean(0)
    between = torch.stack([half.mean(0) for half in halves]).var(0)
    return (1 + between / within).sqrt()


def worst(ensembles: Sequence[Posterior]) -> float:
    """The largest R-hat of any number between independent ensembles."""
    return r_hat([each.chain for each in ensembles]).max().item()


def of_walkers(chain: Posterior) -> float:
    """The largest R-hat of any number between the walkers of one ensemble, whose moves must be Metropolis-Hastings."""
    return r_hat(chain.chain.split(1, 1)).max().item()
