"""Errors of poses in metres and radians, and smoothness of their paths.

Positions are (..., T, J, 3) in metres, world. A measure averages over frames and joints and keeps the batch axes (...).
Where there is nothing to average (no visible joint, too few frames for a difference) it is NaN, never 0.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, check_shape


def masked_mean(values: Tensor, mask: Tensor | None, axes: int) -> Tensor:
    """Averages over the last ``axes`` axes where ``mask`` holds (None: everywhere); NaN where it never does."""
    dims = tuple(range(-axes, 0))
    kept = torch.ones_like(values) if mask is None else mask.to(values).expand_as(values)
    return torch.where(kept > 0, values * kept, 0.0).sum(dims) / kept.sum(dims)


def align_procrustes(predicted: Tensor, truth: Tensor, *, scale: bool) -> Tensor:
    """Moves each predicted point set (..., J, 3) onto the true one by the best rotation, shift and, if asked, scale.

    min over R, t (and s) of sum_j |s R x_j + t - y_j|^2, frame by frame.

    Raises:
        ShapeError: the two do not have the same number of points.
        DataError: a coordinate is not finite; no best rotation exists then.
    Source: Umeyama 1991.
    """
    sizes = check_shape(predicted, "... J 3", "predicted")
    check_shape(truth, f"... {sizes['J']} 3", "truth")
    for name, points in (("predicted", predicted), ("truth", truth)):
        if not points.isfinite().all():
            first = (~points.isfinite()).nonzero()[0].tolist()
            raise DataError("cannot be aligned: NaN or infinity", place=f"{name}{first}", remedy="leave that frame out")
    centre = truth.mean(-2, keepdim=True)
    x, y = predicted - predicted.mean(-2, keepdim=True), truth - centre
    turn = rotation.nearest(y.mT @ x)
    turned = x @ turn.mT
    if scale:
        turned = turned * ((turned * y).sum((-1, -2)) / turned.square().sum((-1, -2)))[..., None, None]
    return turned + centre


def _check_pair(predicted: Tensor, truth: Tensor) -> None:
    """Both are (..., T, J, 3) with the same T and J: broadcasting one frame over many would hide a mistake."""
    sizes = check_shape(predicted, "... T J 3", "predicted")
    check_shape(truth, f"... {sizes['T']} {sizes['J']} 3", "truth")


def joint_errors(predicted: Tensor, truth: Tensor, *, align: str) -> Tensor:
    """Computes the distance (..., T, J) in metres of every predicted joint from the true one.

    ``align``: "none" (world), "root" (joint 0 of each frame moved onto the true one), "rigid" (Procrustes
    per frame without scale), "similarity" (with scale; what is called PA-MPJPE).

    Raises:
        ShapeError: different numbers of frames or joints.
        ValueError: no such alignment.
        DataError: an alignment by Procrustes of numbers that are not finite.
    """
    _check_pair(predicted, truth)
    if align == "root":
        predicted = predicted - predicted[..., :1, :] + truth[..., :1, :]
    elif align in ("rigid", "similarity"):
        predicted = align_procrustes(predicted, truth, scale=align == "similarity")
    elif align != "none":
        raise ValueError(f'align: expected "none", "root", "rigid" or "similarity", got {align!r}')
    return torch.linalg.vector_norm(predicted - truth, dim=-1)


def mpjpe(predicted: Tensor, truth: Tensor, *, align: str, mask: Tensor | None = None) -> Tensor:
    """Computes the mean per-joint position error (...) in metres; ``mask`` (..., T, J) chooses what counts.

    All joints take part in the alignment (see :func:`joint_errors`), also those that do not count.
    """
    return masked_mean(joint_errors(predicted, truth, align=align), mask, 2)


def acceleration(positions: Tensor, fps: float) -> Tensor:
    """Computes the size (..., T - 2, J) of each joint's acceleration in m/s^2, by second differences."""
    check_shape(positions, "... T J 3", "positions")
    return torch.linalg.vector_norm(positions.diff(n=2, dim=-3), dim=-1) * fps**2


def mean_acceleration(positions: Tensor, fps: float) -> Tensor:
    """Computes the mean size (...) of the acceleration in m/s^2; NaN for fewer than three frames."""
    return masked_mean(acceleration(positions, fps), None, 2)


def acceleration_error(predicted: Tensor, truth: Tensor, fps: float) -> Tensor:
    """Computes the mean size (...) of the difference of accelerations in m/s^2; NaN for fewer than three frames."""
    _check_pair(predicted, truth)
    return masked_mean(acceleration(predicted - truth, fps), None, 2)


def jitter(positions: Tensor, fps: float) -> Tensor:
    """Computes the mean size (...) of the third time derivative in m/s^3; NaN for fewer than four frames."""
    check_shape(positions, "... T J 3", "positions")
    jerk = torch.linalg.vector_norm(positions.diff(n=3, dim=-3), dim=-1) * fps**3
    return masked_mean(jerk, None, 2)


def power_spectrum(velocities: Tensor) -> Tensor:
    """Computes the power (..., F) of velocities (..., T, J, 3) by frequency under a Hann window, summed over joints."""
    window = torch.hann_window(velocities.shape[-3], False, dtype=velocities.dtype, device=velocities.device)
    return torch.fft.rfft(velocities * window[:, None, None], dim=-3).abs().square().sum((-1, -2))


def power_spectrum_ratio(predicted: Tensor, truth: Tensor, fps: float, edges: Sequence[float]) -> Tensor:
    """Computes the power of predicted paths over that of the true ones, by frequency band: (..., bands).

    Below 1: over-smoothed in that band; above 1: added noise. Velocities (first differences) under a Hann
    window, power summed over joints and coordinates. A band without true power gives inf, or NaN where
    there is no predicted power either; so do too few frames to have a frequency in the band.

    Args:
        edges: bands + 1 growing frequencies in Hz; a band holds its lower edge and not its upper one.

    Raises:
        ShapeError: different numbers of frames or joints.
    """
    _check_pair(predicted, truth)
    if truth.shape[-3] < 2:
        return truth.new_full((*np.broadcast_shapes(predicted.shape, truth.shape)[:-3], len(edges) - 1), torch.nan)
    frequency = torch.fft.rfftfreq(truth.shape[-3] - 1, 1 / fps, dtype=truth.dtype, device=truth.device)
    bands = torch.tensor([list(band) for band in pairwise(edges)]).to(truth)
    inside = ((frequency >= bands[:, :1]) & (frequency < bands[:, 1:])).to(truth)  # (bands, F)
    mine, true = (power_spectrum(x.diff(dim=-3)) @ inside.mT for x in (predicted, truth))
    return mine / true
