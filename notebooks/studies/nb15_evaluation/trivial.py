"""Generators that anybody could write down: what a trained one must beat, and what a measure must see through.

All draw windows (count, T) on the standard body from training windows, by a model's own numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from motionlab.baselines import cosine_transform
from motionlab.diffusion.gaussian_guess import power
from motionlab.diffusion.model import Trained
from motionlab.diffusion.windows import Windows
from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

Generate = Callable[[int, torch.Generator], Motion]


def copying(windows: Windows) -> Generate:
    """Random training windows: perfect by every measure but that of copies."""
    return lambda count, generator: replace(windows.draw(count, generator), skeleton=STANDARD)


def mean_held(model: Trained, x0: Tensor) -> Generate:
    """The mean pose of training windows x0 (M, T, D), over one spot, held: no variety at all."""
    pose = x0.mean((0, 1)).expand(x0.shape[1:])
    return lambda count, generator: model.decode(pose.expand(count, *pose.shape))


def spectral_gaussian(model: Trained, x0: Tensor) -> Generate:
    """Every number a Gaussian process with its own spectrum, independent of all others: smooth nonsense."""
    deviation, back = power(x0).sqrt(), cosine_transform(x0.shape[1]).T.to(x0)

    def draw(count: int, generator: torch.Generator) -> Motion:
        noise = torch.randn(count, *deviation.shape, generator=generator)
        return model.decode(back @ (deviation * noise))

    return draw


def pca_gaussian(model: Trained, x0: Tensor, kept: float = 0.99) -> Generate:
    """A Gaussian over whole windows with the mean and covariance of x0 (M, T, D), all but the least variance of it.

    Raises:
        ShapeError: fewer than two windows, or ``kept`` not a share.
    """
    if len(x0) < 2 or not 0 < kept < 1:
        raise ShapeError(f"needs two windows and a share of variance, got {len(x0)} and {kept}")
    flat = x0.flatten(1)
    mean = flat.mean(0)
    values, vectors = torch.linalg.eigh((flat - mean) @ (flat - mean).T)  # of M windows, not of T x D numbers
    values = values.flip(0).clamp(min=0)
    size = int((values.cumsum(0) / values.sum() < kept).sum()) + 1
    basis = vectors.flip(1)[:, :size].T @ (flat - mean) / (len(x0) - 1) ** 0.5  # rows: axes times deviations

    def draw(count: int, generator: torch.Generator) -> Motion:
        x = mean + torch.randn(count, size, generator=generator) @ basis
        return model.decode(x.unflatten(1, x0.shape[1:]))

    return draw
