"""Poses from handles without a network: known poses looked up, or averaged by a Gaussian.

Source: nearest neighbours; ridge regression on whatever is given, which is the mean of a Gaussian (Bishop 2006, 2.3).
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from motionlab.diffusion.poses import Poser
from motionlab.motion import Motion, mirror


@dataclass(frozen=True, eq=False)
class Known:
    """poses (N, 1) in their stuck frames, known with their mirror images; model: whose numbers of a pose are used."""

    poses: Motion
    model: Poser

    @cached_property
    def _rows(self) -> tuple[Tensor, Tensor]:
        """Places (2 N, 66) and numbers (2 N, 133)."""
        both = self.poses, mirror(self.poses)
        return torch.cat([m.positions.flatten(1) for m in both]), torch.cat([self.model.encode(m) for m in both])

    @cached_property
    def _moments(self) -> tuple[Tensor, Tensor]:
        rows = torch.cat(self._rows, 1).double()
        return rows.mean(0), rows.mT.cov()

    def nearest(self, targets: Tensor, which: Tensor, rank: int = 0) -> Motion:
        """The poses (B, 1) whose joints are nearest to the handles (B, 22, 3), or the n-th nearest."""
        places, numbers = self._rows
        goal = torch.where(which[..., None], targets, 0.0).flatten(1)
        weight = which.to(targets).repeat_interleave(3, -1)
        apart = weight @ places.square().mT - 2 * goal @ places.mT  # less what does not depend on the pose
        return self.model.decode(numbers[apart.topk(rank + 1, largest=False).indices[:, rank]])

    def gaussian(
        self, targets: Tensor, which: Tensor, ridge: float = 1e-4, generator: torch.Generator | None = None
    ) -> Motion:
        """The mean of poses with these handles, were all numbers Gaussian, or a draw. ridge: of targets, m^2."""
        (mean, cov), size = self._moments, self._rows[0].shape[1]
        seen = which.double().repeat_interleave(3, -1)
        among = seen[:, :, None] * (cov[:size, :size] + ridge * torch.eye(size)) * seen[:, None]
        across = seen[:, :, None] * cov[:size, size:]
        gain = torch.linalg.solve(among + torch.diag_embed(1 - seen), across).mT
        off = torch.where(seen > 0, targets.flatten(1).double() - mean[:size], 0.0)
        said = mean[size:] + (gain @ off[..., None])[..., 0]
        if generator is not None:
            left = cov[size:, size:] - gain @ across
            half = torch.linalg.cholesky((left + left.mT) / 2 + 1e-4 * torch.eye(said.shape[1]))
            said = said + (half @ torch.randn(said.shape, generator=generator).double()[..., None])[..., 0]
        return self.model.decode(said.float())
