"""Measures the seams of a filled gap, and whether what was given has stayed, in metres and seconds."""

import torch
from torch import Tensor

from motionlab.metrics.pose import joint_errors


def step_changes(positions: Tensor, fps: float) -> Tensor:
    """Computes the change of velocity into or out of each step between frames, the larger one: (..., T - 1) in m/s.

    The change at frame t is |v_t - v_(t-1)| with v_t = (p_(t+1) - p_t) fps, the mean over the joints of
    positions (..., T, J, 3) in metres. The first and the last step have one such frame, the others two.
    """
    change = torch.linalg.vector_norm(positions.diff(n=2, dim=-3), dim=-1).mean(-1) * fps  # (..., T - 2)
    padded = torch.nn.functional.pad(change, (1, 1), value=-torch.inf)
    return torch.maximum(padded[..., 1:], padded[..., :-1])


def natural_changes(positions: Tensor, fps: float) -> Tensor:
    """Computes :func:`step_changes`, m/s, of real motion (..., T, J, 3) at steps with two neighbours, one list (K,)."""
    return step_changes(positions, fps)[..., 1:-1].flatten()


def worst_known_m(predicted: Tensor, truth: Tensor, known: Tensor) -> Tensor:
    """Computes how far what was given has moved at most, metres (...): the worst joint of the worst known frame.

    Positions (..., T, J, 3), world; known (..., T): the frames that were given; NaN where there are none.
    """
    errors = joint_errors(predicted, truth, align="none")
    kept = known.bool()[..., None].expand(errors.shape)
    worst = torch.where(kept, errors, -torch.inf).amax((-1, -2))
    return torch.where(kept.any(-1).any(-1), worst, torch.nan)
