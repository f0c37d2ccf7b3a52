"""The figures of notebook 12: whether roots and legs know of each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.errors import ShapeError
from motionlab.viz.palette import INK, colour
from studies.shared.plots import canvas, median_band, paints


def roots_and_legs(panels: Mapping[str, tuple[Tensor, Tensor]], roles: Mapping[str, str], most: int = 300) -> Figure:
    """Speed of the root (N,) over speed of the feet about the pelvis (N,), m/s: a panel per source, a dot per clip, and
    the correlation of all of them. At most ``most`` dots, evenly."""
    fig, axes = canvas(1, len(panels), size=(2.4 * len(panels) + 0.6, 2.8), sharex=True, sharey=True)
    for ax, (name, pair) in zip(axes, panels.items(), strict=True):
        root, legs = (x.double().numpy(force=True) for x in pair)
        pick = np.linspace(0, len(root) - 1, min(most, len(root))).round().astype(int)
        ax.scatter(legs[pick], root[pick], s=11, color=colour(roles[name]), alpha=0.55, lw=0)
        ax.set_title(f"{name}: r = {np.corrcoef(root, legs)[0, 1]:.2f}", color=INK, fontsize=9)
        ax.set_xlabel("feet about the pelvis (m/s)", color=INK)
        ax.locator_params(nbins=4)
    axes[0].set_ylabel("root over the floor (m/s)", color=INK)
    high = [np.percentile(np.concatenate([p[k].numpy(force=True) for p in panels.values()]), 99.5) for k in (0, 1)]
    axes[0].set_xlim(0, 1.08 * high[1])
    axes[0].set_ylim(0, 1.08 * high[0])
    return fig


def ways(panels: Mapping[str, Tensor], roles: Mapping[str, str]) -> Figure:
    """Roots (N, T, 3) seen from above, a panel per source, all to one scale; dots: where they begin."""
    fig, axes = canvas(1, len(panels), size=(2.7 * len(panels), 2.9))
    found = {name: roots[..., :2].numpy(force=True) for name, roots in panels.items()}
    ends = {name: (x.min((0, 1)), x.max((0, 1))) for name, x in found.items()}
    half = 0.55 * max((high - low).max() for low, high in ends.values())
    for ax, (name, x) in zip(axes, found.items(), strict=True):
        ax.plot(*x.transpose(2, 1, 0), color=colour(roles[name]), lw=1.0, alpha=0.6)
        ax.scatter(*x[:, 0].T, s=8, color=INK, zorder=3, lw=0)
        ax.set_title(name, color=INK, fontsize=9)
        ax.set_aspect("equal")
        middle = sum(ends[name]) / 2
        ax.set_xlim(middle[0] - half, middle[0] + half)
        ax.set_ylim(middle[1] - half, middle[1] + half)
        ax.set_xlabel("x (m)", color=INK)
    axes[0].set_ylabel("y (m)", color=INK)
    return fig


def curves(
    x: Sequence[float],
    series: Mapping[str, Tensor],
    *,
    xlabel: str = "time (s)",
    ylabel: str,
    roles: Mapping[str, str] | None = None,
    size: tuple[float, float] = (7.0, 3.2),
) -> Figure:
    """Curves (T,) over x (T,); of several repetitions (N, T) the median, with its quartiles as a band.

    Raises:
        ShapeError: a series that is not as long as x.
    """
    x, paint = np.asarray(x, float), paints(list(series), roles)
    _, (ax,) = canvas(size=size)
    for label, values in series.items():
        y = np.atleast_2d(values.numpy(force=True).astype(float))
        if y.ndim != 2 or y.shape[1] != len(x):
            raise ShapeError(f"{label}: expected ({len(x)},) or (N, {len(x)}), got {tuple(values.shape)}")
        median_band(ax, x, y, paint[label], label, alpha=0.18, ls="-")
    ax.set_xlabel(xlabel, color=INK)
    ax.set_ylabel(ylabel, color=INK)
    ax.legend(frameon=False, fontsize=9, labelcolor=INK)
    return ax.figure
