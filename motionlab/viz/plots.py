"""Plots on paper: curves, distributions, spectra, bars, matrices and stick figures, in one style.

Every function returns a matplotlib Figure that pyplot does not know; nothing global is changed. A series
whose label names a role has its colour, others take theirs from ``roles`` (label -> role) or in turn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.signal import welch

from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.viz.figures import single
from motionlab.viz.palette import INK, LINE, ROLE, colour, side_of, sides
from motionlab.viz.viewpoint import good_azimuth, left_of

Series = Mapping[str, torch.Tensor | np.ndarray | Sequence[float]]
_STYLE = {
    "font.size": 10, "font.family": "DejaVu Sans", "axes.titlesize": 10.5, "axes.titlelocation": "left",
    "axes.labelsize": 10, "axes.labelcolor": INK, "axes.edgecolor": LINE, "axes.linewidth": 1.0,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True,
    "grid.color": "#e8ebf0", "grid.linewidth": 0.8, "text.color": INK, "xtick.color": INK, "ytick.color": INK,
    "xtick.labelsize": 9, "ytick.labelsize": 9, "xtick.major.size": 0, "ytick.major.size": 0,
    "legend.frameon": False, "legend.fontsize": 9, "lines.solid_capstyle": "round", "figure.dpi": 110,
}  # fmt: skip
_TURN = ("ours", "baseline", "6d", "axis-angle", "stage2", "quaternion", "stage3", "observation", "truth")


def canvas(
    rows: int = 1,
    columns: int = 1,
    *,
    size: tuple[float, float] = (7.0, 3.2),
    sharex: bool | str = False,
    sharey: bool | str = False,
) -> tuple[Figure, np.ndarray]:
    """A figure of ``size`` inches in the house style and its axes in reading order (rows * columns,)."""
    with rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        return figure, figure.subplots(rows, columns, sharex=sharex, sharey=sharey, squeeze=False).ravel()


def paints(labels: Sequence[str], roles: Mapping[str, str] | None = None) -> dict[str, tuple[float, float, float]]:
    """A colour for each label: its role's, or the next that is free."""
    named = {label: (roles or {}).get(label, label) for label in labels}
    wanted = [role for label, role in named.items() if role in ROLE or label in (roles or {})]
    free = [role for role in _TURN if role not in wanted] or list(_TURN)
    taken = iter(range(len(labels)))
    return {
        label: colour(role if role in wanted else free[next(taken) % len(free)]) for label, role in named.items()
    }  # fmt: skip


def _rows(values) -> np.ndarray:
    return np.asarray(values.detach().cpu() if isinstance(values, torch.Tensor) else values, float)


def _samples(series: Series) -> dict[str, np.ndarray]:
    found = {label: (x := _rows(values).ravel())[np.isfinite(x)] for label, values in series.items()}
    empty = [label for label, values in found.items() if not len(values)]
    if empty or not found:
        raise ShapeError(f"nothing to plot{' for ' + ', '.join(empty) if empty else ''}: no finite values")
    return found


def curves(
    x: torch.Tensor | np.ndarray | Sequence[float],
    series: Series,
    *,
    xlabel: str = "time (s)",
    ylabel: str,
    band: tuple[float, float] = (25, 75),
    roles: Mapping[str, str] | None = None,
    size: tuple[float, float] = (7.0, 3.2),
) -> Figure:
    """Curves (T,) over x (T,); of several repetitions (N, T) the median, with percentiles as a band.

    Raises:
        ShapeError: a series that is not as long as x.
    """
    x, paint = _rows(x), paints(list(series), roles)
    _, (ax,) = canvas(size=size)
    for label, values in series.items():
        y = np.atleast_2d(_rows(values))
        if y.ndim != 2 or y.shape[1] != len(x):
            raise ShapeError(f"{label}: expected ({len(x)},) or (N, {len(x)}), got {_rows(values).shape}")
        if len(y) > 1:
            ax.fill_between(x, *np.nanpercentile(y, band, axis=0), color=paint[label], alpha=0.18, lw=0)
        ax.plot(x, np.nanmedian(y, axis=0), color=paint[label], lw=1.8, label=label)
    return _finish(ax, xlabel, ylabel, legend=True)


def histograms(
    series: Series,
    *,
    xlabel: str,
    bins: int = 60,
    clip: float = 0.5,
    log: bool = False,
    roles: Mapping[str, str] | None = None,
    size: tuple[float, float] = (7.0, 3.0),
) -> Figure:
    """Distributions over common bins, in % of each source's samples.

    ``clip`` percent at each end of all samples share the outermost bin. ``log``: bins evenly in the logarithm.
    """
    found = _samples(series)
    together, paint = np.concatenate(list(found.values())), paints(list(found), roles)
    together = together[together > 0] if log else together
    low, high = np.percentile(together, (clip, 100 - clip))
    if high <= low:
        low, high = low - 0.5, high + 0.5
    edges = np.geomspace(low, high, bins + 1) if log else np.linspace(low, high, bins + 1)
    _, (ax,) = canvas(size=size)
    for label, values in found.items():
        share = 100 * np.histogram(values.clip(edges[0], edges[-1]), edges)[0] / len(values)
        ax.stairs(share, edges, color=(*paint[label], 0.16), fill=True)
        ax.stairs(share, edges, color=paint[label], lw=1.6, label=f"{label} (n = {len(values):,})")
    ax.set_xscale("log" if log else "linear")
    ax.set_ylim(bottom=0)
    return _finish(ax, xlabel, "share (%)", legend=True)


def spectrum(
    series: Mapping[str, tuple[torch.Tensor | np.ndarray, float]],
    *,
    unit: str,
    roles: Mapping[str, str] | None = None,
    size: tuple[float, float] = (7.0, 3.2),
) -> Figure:
    """Power spectral density (Welch) of signals: label -> ((..., T), frames per second), averaged over ``...``."""
    paint = paints(list(series), roles)
    _, (ax,) = canvas(size=size)
    for label, (values, fps) in series.items():
        x = _rows(values)
        frequency, power = welch(x, fs=fps, nperseg=min(256, x.shape[-1]), axis=-1)
        power = power.reshape(-1, power.shape[-1]).mean(0)
        ax.loglog(frequency[1:], power[1:], color=paint[label], lw=1.8, label=label)
    return _finish(ax, "frequency (Hz)", f"power ({unit}²/Hz)", legend=True)


def bars(
    groups: Mapping[str, Mapping[str, tuple[float, float, float]]],
    *,
    ylabel: str,
    roles: Mapping[str, str] | None = None,
    size: tuple[float, float] = (7.0, 3.2),
) -> Figure:
    """Estimates with intervals: group -> label -> (value, low, high), the labels of a group side by side."""
    labels = list(dict.fromkeys(label for group in groups.values() for label in group))
    paint = paints(labels, roles)
    _, (ax,) = canvas(size=size)
    width = 0.8 / max(len(labels), 1)
    for k, label in enumerate(labels):
        at = [i for i, group in enumerate(groups.values()) if label in group]
        value, low, high = np.array([group[label] for group in groups.values() if label in group], float).T
        x = np.array(at) + (k - (len(labels) - 1) / 2) * width
        ax.bar(x, value, 0.92 * width, color=paint[label], label=label)
        ax.errorbar(x, value, (value - low, high - value), fmt="none", ecolor=INK, elinewidth=1.2, capsize=3)
    ax.set_xticks(range(len(groups)), list(groups))
    ax.grid(visible=False, axis="x")
    return _finish(ax, "", ylabel, legend=len(labels) > 1)


def heatmap(
    values: torch.Tensor | np.ndarray,
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    label: str,
    limits: tuple[float, float] | None = None,
    cmap: str = "viridis",
    size: tuple[float, float] | None = None,
) -> Figure:
    """A matrix (R, C) by names, its unit on the colour bar; what is not finite stays empty.

    Raises:
        ShapeError: names and values do not fit.
    """
    values = _rows(values)
    if values.shape != (len(rows), len(columns)):
        raise ShapeError(f"values: expected ({len(rows)}, {len(columns)}), got {values.shape}")
    figure, (ax,) = canvas(size=size or (2.2 + 0.28 * len(columns), 1.6 + 0.22 * len(rows)))
    low, high = limits or (None, None)
    image = ax.imshow(np.ma.masked_invalid(values), aspect="auto", cmap=cmap, vmin=low, vmax=high)
    ax.set_xticks(range(len(columns)), columns, rotation=60, ha="right", rotation_mode="anchor", fontsize=8)
    ax.set_yticks(range(len(rows)), rows, fontsize=8)
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)
    bar = figure.colorbar(image, ax=ax, fraction=0.04, pad=0.02)
    bar.set_label(label, color=INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(size=0, labelsize=8)
    return figure


def boxes(
    series: Series,
    *,
    xlabel: str,
    log: bool = False,
    roles: Mapping[str, str] | None = None,
    size: tuple[float, float] | None = None,
) -> Figure:
    """One distribution per source on its own line: its density, the middle half as a bar, the median as a dot."""
    found = _samples(series)
    paint = paints(list(found), roles)
    _, (ax,) = canvas(size=size or (7.0, 0.8 + 0.42 * len(found)))
    for row, (label, values) in enumerate(found.items()):
        x = np.log10(values[values > 0]) if log else values
        low, quarter, middle, three, high = np.percentile(x, (1, 25, 50, 75, 99))
        edges = np.linspace(low, high, 49) if high > low else np.array([low - 0.5, low + 0.5])
        share = np.histogram(x, edges)[0].astype(float)
        share = np.convolve(share, np.hanning(7)[1:-1] / 3, "same") if len(share) > 7 else share
        centre = (edges[1:] + edges[:-1]) / 2
        half = 0.42 * share / max(share.max(), 1e-12)
        back = (lambda v: 10**v) if log else (lambda v: v)
        ax.fill_between(back(centre), row - half, row + half, color=paint[label], alpha=0.28, lw=0)
        ax.plot(back(np.array([quarter, three])), [row, row], color=paint[label], lw=5, solid_capstyle="butt")
        ax.plot(back(middle), row, "o", color="white", mec=INK, ms=5)
    ax.set_xscale("log" if log else "linear")
    ax.set_yticks(range(len(found)), [f"{label}  (n = {len(values):,})" for label, values in found.items()])
    ax.set_ylim(len(found) - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    return _finish(ax, xlabel, "", legend=False)


def stick_figures(
    motion: Motion, n: int = 10, role: str | tuple = "ours", *, azimuth: float | None = None, size=(10.0, 2.4)
) -> Figure:
    """``n`` poses side by side as lines, left light and right dark: quick, and needs no graphics driver."""
    motion, tones = single(motion), sides(colour(role))
    frames = np.linspace(0, motion.frames - 1, n).round().astype(int)
    points, root = _rows(motion.positions[frames]), _rows(motion.root)
    turn = np.radians(good_azimuth(root, left_of(motion), 2.0) if azimuth is None else azimuth)
    across = (points - root[frames, None]) @ np.array([-np.sin(turn), np.cos(turn), 0.0])
    place = np.concatenate(([0.0], np.cumsum(across.max(1)[:-1] - across.min(1)[1:] + 0.2)))
    figure, (ax,) = canvas(size=size)
    for x, height, start, frame in zip(across, points[..., 2], place, frames, strict=True):
        for j, parent in enumerate(motion.skeleton.parents[1:], start=1):
            tone = tones[side_of(motion.skeleton.names[j])]
            ax.plot(x[[j, parent]] + start, height[[j, parent]], color=tone, lw=2.2, solid_capstyle="round")
        below = {"xytext": (0, -4), "textcoords": "offset points", "ha": "center", "va": "top"}
        ax.annotate(f"{frame / motion.fps:.2f} s", (start, 0), fontsize=8, **below)
    ax.axhline(0, color=LINE, lw=1)
    ax.set_aspect("equal")
    ax.axis("off")
    return figure


def _finish(ax: Axes, xlabel: str, ylabel: str, *, legend: bool) -> Figure:
    ax.set_xlabel(xlabel, color=INK)
    ax.set_ylabel(ylabel, color=INK)
    if legend:
        ax.legend(frameon=False, fontsize=9, labelcolor=INK)
    return ax.figure
