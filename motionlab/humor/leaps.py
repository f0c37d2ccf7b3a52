"""Leaps from valley to valley: the first state's mixture has components, and each makes a valley of stage 3's energy.

Where ``init_gmm`` says that one of its components made the first state, a search stays with that component: on the
way to another the density is next to nothing. All other terms are, around a roll-out, nearly quadratic in the change d
of the first state and of what is shared, while nu = 0 and later latents give way. So the least of the energy with
component k alone,

    E_k = min_d  g d + 1/2 d H d + w (1/2 |W_k (f + F d - m_k)|^2 - c_k),

is a linear system, and how deep its valley is is known, nearly, before it is entered; its matrix gives a leap the
coordinates to search in. g: gradient of all terms but the mixture's. H: their matrix (``Loop.rest``). f, F: the first
state's features and how they move. W_k, m_k, c_k: whitener, mean and constant of the component; w: the mixture's
weight.

Source: none; HuMoR (Rempe et al. 2021) has the mixture, and its optimiser stays where stage 2 puts it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.humor.loop import Loop, mixed_features, opened
from motionlab.humor.riccati import factorised
from motionlab.humor.stages import Problem, rolled_terms
from motionlab.humor.variables import Variables

_RIDGE = 1e-4


def starts(problem: Problem, unknown: Variables, loop: Loop, most: int, share: float) -> tuple[Tensor, Tensor, Tensor]:
    """Where searches begin: R rows, first those of all clips where they are, then leaps.

    most: leaps of a clip; only to where the energy should be lower than now by more than ``share`` of its size, the
    valley of its own component included.

    Returns:
        whose each row is (R,), its shaper (R, f, f) of the first state and what is shared, and where it begins in these
        coordinates (R, f). Rows that stay have ``Loop.first``; those of leaps one that makes the matrix of their valley
        the identity.
    """
    clips, size = loop.first.shape[:2]
    stay, here = torch.arange(clips, device=loop.first.device), loop.first.new_zeros(clips, size)
    if not most or not _weight(problem, unknown):
        return stay, loop.first, here
    found = valleys(problem, unknown, loop)
    gain, which = found.deepest(most)
    who, k = (gain > share * found.energy.abs()[:, None]).nonzero().unbind(1)
    shaper, begin = entered(loop, found, who, which[who, k])
    return torch.cat((stay, who)), torch.cat((loop.first, shaper)), torch.cat((here, begin))


class Valleys(NamedTuple):
    """energy (B,); by how much each component's valley should be lower, gain (B, K); where it is (B, K, f), and its
    matrix (B, K, f, f), both in the coordinates of ``Loop.first``."""

    energy: Tensor
    gain: Tensor
    where: Tensor
    matrix: Tensor

    def deepest(self, most: int) -> tuple[Tensor, Tensor]:
        """Gains (B, most) of those that promise most, and which components they are."""
        return self.gain.topk(min(most, self.gain.shape[1]), 1)


def entered(loop: Loop, found: Valleys, who: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
    """Shapers (R, f, f) and beginnings (R, f) of searches in the valleys of components which (R,) of clips who (R,).

    Components differ in width by orders of magnitude: in the coordinates of another a step of Newton's misses by as
    much, and the search leaves the valley again.
    """
    factor = factorised(found.matrix[who, which])
    shaper = torch.linalg.solve_triangular(factor.mT, loop.first[who].to(factor), upper=True, left=False)
    begin = (factor.mT @ found.where[who, which, :, None])[..., 0]
    return shaper.to(loop.first), begin.to(loop.first)


def valleys(problem: Problem, unknown: Variables, loop: Loop) -> Valleys:
    """All components' valleys.

    Where rounding left no valley the point is a saddle, and a search from there a waste.
    """
    clips, size = loop.first.shape[:2]
    weight, gmm = _weight(problem, unknown), problem.priors.initial
    new = {"nu": torch.zeros_like(unknown["z"][:, 0]), "first": loop.first.new_zeros(clips, size).requires_grad_()}
    with torch.enable_grad():
        terms = rolled_terms(problem, *opened(problem, unknown, loop, new))
        whole = sum(terms.values())
        rest = whole - terms.get("init_motion_prior", 0.0)
        g = torch.autograd.grad(rest.sum(), new["first"])[0].double()
    with torch.no_grad():
        f = mixed_features(problem, unknown)
        off, way, constant = gmm.whitened(f, loop.features)
        h = loop.rest.double() + _RIDGE * torch.eye(size, dtype=torch.float64, device=g.device)
        matrix = h[:, None] + weight * way.mT @ way
        toward = -g[:, None] - weight * (way.mT @ off[..., None])[..., 0]
        d = torch.linalg.solve_ex(matrix, toward[..., None])[0][..., 0]
        change = 0.5 * (d[..., None, :] @ h[:, None] @ d[..., None])[..., 0, 0] + (d * g[:, None]).sum(-1)
        least = change + weight * (0.5 * (off + (way @ d[..., None])[..., 0]).square().sum(-1) - constant)
        now = -weight * gmm.log_prob(f).double()
    gain = (now[:, None] - least).nan_to_num(nan=-torch.inf)
    return Valleys(whole.detach(), gain.to(whole), d, matrix)


def _weight(problem: Problem, unknown: Variables) -> float:
    return problem.weights.of(3, frames=unknown["z"].shape[2] + 1).get("init_motion_prior", 0.0)
