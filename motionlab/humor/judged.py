"""What a fit of stage 3 says of itself: would the prior make such a motion, and does it meet what was seen?"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.humor import variables
from motionlab.humor.observed import Evidence
from motionlab.humor.stages import Problem
from motionlab.humor.variables import Rolled, Variables

#: From here on a fit is doubtful. On practice clips, of moves that the prior has seen, surprise was 0.05 to
#: 0.47 and misfit 6 to 13 pixels of 1280, or 7 cm where every joint had N(0, 4 cm) of noise.
SURPRISED, MISFIT_METRES, MISFIT_WIDTH = 0.5, 0.12, 1 / 64  # the last of the image's width: 20 pixels of 1280


@dataclass(frozen=True, eq=False)
class Judged:
    """Per clip (B,).

    surprise: mean square of (z - mu) / sigma over all transitions and latents: 1 for motion drawn from the prior, less
    for motion like that of its training, which its latents overfit; large where a motion is not one that it would make.
    misfit: root mean square distance of what was seen, metres or pixels; from ``bound`` on it is doubtful.
    """

    surprise: Tensor
    misfit: Tensor
    bound: float
    pixels: bool

    @property
    def doubtful(self) -> Tensor:
        """(B,) true where either is not finite or above its bound."""
        return ~((self.surprise <= SURPRISED) & (self.misfit <= self.bound))

    def doubts(self) -> tuple[str, ...]:
        """A sentence for every clip that is doubtful."""
        unit = "{:.0f} px" if self.pixels else "{:.2f} m"
        rows = zip(self.surprise.tolist(), self.misfit.tolist(), self.doubtful.tolist(), strict=True)
        return tuple(
            f"stage 3 doubts clip {k}: surprise of the prior {surprise:.2f} (up to {SURPRISED:g} is usual), what was "
            f"seen is missed by {unit.format(misfit)}"
            for k, (surprise, misfit, doubtful) in enumerate(rows)
            if doubtful
        )


@torch.no_grad()
def of_rollout(rolled: Rolled, evidence: Evidence) -> Judged:
    """Judge roll-outs of B rows."""
    prior, weight = rolled.rollout.prior, (evidence.weight > 0).to(rolled.states)
    surprise = ((rolled.rollout.z - prior.mean).square() * (-prior.log_var).exp()).mean((1, 2))
    off = (rolled.body.observed - evidence.values).square().sum(-1)
    missed = torch.where(weight > 0, off, 0.0).sum((1, 2)) / weight.sum((1, 2)).clamp(min=1)
    bound = MISFIT_METRES if evidence.view is None else MISFIT_WIDTH * evidence.view.size[0]
    return Judged(surprise, missed.sqrt(), bound, evidence.view is not None)


@torch.no_grad()
def judged(problem: Problem, unknown: Variables) -> Judged:
    """Judge the roll-out of unknowns (G, 1, ...)."""
    return of_rollout(variables.roll(unknown, problem.priors, problem.evidence), problem.evidence)
