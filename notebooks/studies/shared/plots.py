"""Plots as matplotlib figures: numbers over time, distributions; a canvas and colours for other figures.

Every function returns a matplotlib Figure that pyplot does not know; nothing global is changed. A series
whose label names a role has its colour, others take theirs from ``roles`` (label -> role) or in turn.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.viz.palette import INK, LINE, ROLE, colour

_STYLE = {
    "font.size": 10, "font.family": "DejaVu Sans", "axes.titlesize": 10.5, "axes.titlelocation": "left",
    "axes.labelsize": 10, "axes.labelcolor": INK, "axes.edgecolor": LINE, "axes.linewidth": 1.0,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True,
    "grid.color": "#e8ebf0", "grid.linewidth": 0.8, "text.color": INK, "xtick.color": INK, "ytick.color": INK,
    "xtick.labelsize": 9, "ytick.labelsize": 9, "xtick.major.size": 0, "ytick.major.size": 0,
    "legend.frameon": False, "legend.fontsize": 9, "lines.solid_capstyle": "round", "figure.dpi": 110,
}  # fmt: skip
_TURN = ("ours", "baseline", "6d", "axis-angle", "stage2", "quaternion", "stage3", "observation", "truth")


def canvas(rows: int = 1, columns: int = 1, *, size: tuple[float, float], **shared) -> tuple[Figure, np.ndarray]:
    """Returns a figure of ``size`` inches in the house style and its axes in reading order (rows * columns,); shared:
    "sharex" and "sharey", as of ``Figure.subplots``."""
    with rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        return figure, figure.subplots(rows, columns, squeeze=False, **shared).ravel()


def paints(labels: Sequence[str], roles: Mapping[str, str] | None = None) -> dict[str, tuple[float, float, float]]:
    """Returns a colour for each label: its role's, or the next that is free."""
    named = {label: (roles or {}).get(label, label) for label in labels}
    wanted = [role for label, role in named.items() if role in ROLE or label in (roles or {})]
    free = [role for role in _TURN if role not in wanted] or list(_TURN)
    taken = iter(range(len(labels)))
    return {n: colour(role if role in wanted else free[next(taken) % len(free)]) for n, role in named.items()}


def over_time(
    panels: Mapping[str, Mapping[str, Tensor]], *, ylabel: str, fps: float, roles: Mapping[str, str],
    hidden: Mapping[str, Tensor] | None = None, size: tuple[float, float], log_from: float,
) -> Figure:  # fmt: skip
    """Draws one panel per case: median over clips of each series (B, T) or (T,) with its quartiles.

    hidden: case -> mask (T,) of the frames to shade. log_from: where the logarithmic axis begins.
    """
    fig, axes = canvas(1, len(panels), size=size, sharey=True)
    for ax, (name, series) in zip(axes, panels.items(), strict=True):
        paint = paints(list(series), roles)
        for label, values in series.items():
            y = np.atleast_2d(values.numpy(force=True))
            t = np.arange(y.shape[1]) / fps
            line = (0, (4, 2)) if roles.get(label) == "truth" else "-"
            median_band(ax, t, y, paint[label], label, alpha=0.15, ls=line)
        if hidden and name in hidden:
            mask = hidden[name].numpy()
            shaded = {"where": mask, "color": LINE, "alpha": 0.35, "lw": 0, "transform": ax.get_xaxis_transform()}
            ax.fill_between(np.arange(len(mask)) / fps, 0, 1, **shaded)  # from the bottom to the top of the panel
        ax.set(title=name, xlabel="time (s)")
    axes[0].set_yscale("log")
    axes[0].set_ylim(bottom=log_from)  # behind all panels: a limit stops the axis they share from growing
    axes[0].set_ylabel(ylabel)
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig


def median_band(ax: Axes, x: np.ndarray, rows: np.ndarray, tint, label: str, *, alpha: float, ls) -> None:
    """Draws the median of rows (N, T) over x (T,), with the quartiles as a band where there are several."""
    if len(rows) > 1:
        ax.fill_between(x, *np.nanpercentile(rows, (25, 75), axis=0), color=tint, alpha=alpha, lw=0)
    ax.plot(x, np.nanmedian(rows, axis=0), color=tint, lw=1.8, label=label, ls=ls)


def intervals(
    panels: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]], roles: Mapping[str, str], *,
    size: tuple[float, float],
) -> tuple[Figure, np.ndarray]:  # fmt: skip
    """Draws means with their intervals, a panel per label of its axis, a line per name, a colour per series; also the
    axes.

    panels: label -> series -> name -> (mean, low, high, ...); of a number without an interval all three are one.
    """
    names = list(dict.fromkeys(name for by in panels.values() for found in by.values() for name in found))
    fig, axes = canvas(1, len(panels), size=size, sharey=True)
    for ax, (xlabel, by) in zip(axes, panels.items(), strict=True):
        for k, (label, tint) in enumerate(paints(list(by), roles).items()):
            for name, (mean, low, high, *_) in by[label].items():
                y = names.index(name) + 0.3 * (k - (len(by) - 1) / 2)
                ax.plot((low, high), (y, y), color=tint, lw=2)
                ax.plot(mean, y, "o", color=tint, ms=5)
            ax.plot([], [], "o-", color=tint, label=label)
        ax.set(xlabel=xlabel)
    axes[0].set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.5, -0.5))
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig, axes


def boxes(series: Mapping[str, Sequence[float]], *, xlabel: str, roles: Mapping[str, str]) -> Figure:
    """Draws one distribution per source on its own line: its density, the middle half as a bar, the median as a dot."""
    found = {label: x[np.isfinite(x)] for label, x in ((n, np.asarray(y, float)) for n, y in series.items())}
    paint = paints(list(found), roles)
    _, (ax,) = canvas(size=(7.0, 0.8 + 0.42 * len(found)))
    for row, (label, x) in enumerate(found.items()):
        low, quarter, middle, three, high = np.percentile(x, (1, 25, 50, 75, 99))
        edges = np.linspace(low, high, 49) if high > low else np.array([low - 0.5, low + 0.5])
        share = np.histogram(x, edges)[0].astype(float)
        share = np.convolve(share, np.hanning(7)[1:-1] / 3, "same") if len(share) > 7 else share
        centre = (edges[1:] + edges[:-1]) / 2
        half = 0.42 * share / max(share.max(), 1e-12)
        ax.fill_between(centre, row - half, row + half, color=paint[label], alpha=0.28, lw=0)
        ax.plot([quarter, three], [row, row], color=paint[label], lw=5, solid_capstyle="butt")
        ax.plot(middle, row, "o", color="white", mec=INK, ms=5)
    ax.set_yticks(range(len(found)), [f"{label}  (n = {len(values):,})" for label, values in found.items()])
    ax.set_ylim(len(found) - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel(xlabel, color=INK)
    return ax.figure
