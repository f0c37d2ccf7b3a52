"""Plots of what generated motion scores: dots beside a floor, distances to the training set, errors through a gap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from torch import Generator, Tensor

from motionlab.errors import ShapeError
from motionlab.metrics.intervals import interval
from motionlab.viz.palette import INK, LINE, ROLE, colour
from studies.shared.plots import canvas, paints

Rows = Mapping[str, Sequence[Mapping[str, float]]]  # who -> one row of measures per sampling seed


def scores(
    rows: Rows,
    measures: Mapping[str, str],
    *,
    floor: Mapping[str, float] | None = None,
    roles: Mapping[str, str] | None = None,
    log: Sequence[str] = ("frechet",),
    columns: int = 3,
    width: float = 11.0,
) -> Figure:
    """One panel per measure, one line per generator, one dot per seed.

    measures: name -> what is good of it ("low", "high", or the number it should be, which is drawn dotted).
    floor: name -> the same measure between two sets of real motion, a dashed line. log: measures on a log axis.

    Raises:
        ShapeError: nothing to draw.
    """
    if not rows or not measures:
        raise ShapeError("nothing to plot: expected rows of some generators, and measures")
    lines, paint = -(-len(measures) // columns), paints(list(rows), roles)
    figure, axes = canvas(lines, columns, size=(width, lines * (0.8 + 0.24 * len(rows))), sharey=True)
    for ax, (name, good) in zip(axes, measures.items(), strict=False):
        for line, (who, some) in enumerate(rows.items()):
            values = np.array([row[name] for row in some], float)
            values = values[np.isfinite(values)]
            ax.plot(values, [line] * len(values), "o", ms=6, color=paint[who], mec="white", mew=0.6, zorder=3)
        if floor is not None and np.isfinite(floor.get(name, np.nan)):
            ax.axvline(floor[name], color=INK, lw=1.2, ls="--", zorder=1)
        if good.replace(".", "", 1).isdecimal():
            ax.axvline(float(good), color=LINE, lw=1.5, ls=":", zorder=1)
        positive = all(row[name] > 0 for some in rows.values() for row in some)
        if name in log and positive:
            ax.set_xscale("log")
            ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_locator(NullLocator())
        ax.set_title(f"{name} ({f'should be {good}' if good[0].isdigit() else f'{good} is good'})")
        ax.grid(visible=False, axis="y")
    axes[0].set_yticks(range(len(rows)), list(rows))
    axes[0].set_ylim(len(rows) - 0.4, -0.6)
    for ax in axes[len(measures) :]:
        ax.set_axis_off()
    return figure


def cumulative(
    series: Mapping[str, Tensor],
    *,
    xlabel: str,
    quantile: tuple[str, float] | None = None,
    roles: Mapping[str, str] | None = None,
    size: tuple[float, float] = (7.0, 3.4),
) -> Figure:
    """Share of each set (N,) that lies below x; quantile: (label, share), the x below which that much of it lies."""
    _, (ax,) = canvas(size=size)
    paint = paints(list(series), roles)
    for label, values in series.items():
        x = np.sort(np.asarray(values, float))
        share = 100 * np.arange(1, len(x) + 1) / len(x)
        ax.step(x, share, where="post", color=paint[label], lw=1.8, label=f"{label} (n = {len(x)})")
    if quantile:
        label, share = quantile
        at = float(np.quantile(np.asarray(series[label], float), share))
        ax.axvline(at, color=INK, lw=1.0, ls="--")
        ax.annotate(f" {100 * share:g} % of {label}", (at, 97), fontsize=8, va="top")
    ax.set(xlabel=xlabel, ylabel="share below (%)", ylim=(0, 101))
    ax.set_xlim(left=0)
    ax.legend(frameon=False, fontsize=9, labelcolor=INK)
    return ax.figure


def through_gaps(
    gaps: Mapping[int, Mapping[str, Tensor]], *, fps: float, roles: Mapping[str, str] | None = None
) -> Figure:
    """Joint error through a gap: one panel per length, method -> (N, gap) metres; means and their standard errors."""
    figure, axes = canvas(1, len(gaps), size=(2.9 * len(gaps), 3.0), sharey=True)
    paint = paints(list(next(iter(gaps.values()))), roles)
    for ax, (gap, methods) in zip(axes, gaps.items(), strict=True):
        time = (np.arange(gap) + 1) / fps
        for label, errors in methods.items():
            x = 100 * np.asarray(errors, float)
            middle, error = x.mean(0), x.std(0) / np.sqrt(len(x))
            ax.fill_between(time, middle - error, middle + error, color=paint[label], alpha=0.2, lw=0)
            ax.plot(time, middle, color=paint[label], lw=1.8, label=label)
        ax.set_title(f"gap of {gap} frames")
        ax.set_xlabel("time after the last known frame (s)", fontsize=8.5)
    axes[0].set_ylabel("joint error (cm)")
    axes[0].set_ylim(bottom=0)  # shared; set earlier it would hold the top where the first gap has it
    lines = axes[0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower center", ncols=2 * len(gaps), frameon=False, fontsize=8.5, labelcolor=INK)
    return figure


def learning(curve: Sequence[Mapping[str, float]], parts: Sequence[str]) -> Figure:
    """The features' training: the share of each part of a window that the latent numbers miss, held out, by step."""
    _, (ax,) = canvas(size=(6.0, 2.8))
    paint = paints(list(parts))
    for part in parts:
        ax.plot(
            [row["step"] for row in curve], [100 * row[part] for row in curve], color=paint[part], lw=1.8, label=part
        )
    ax.axhline(100, color=ROLE["observation"], lw=1, ls=":")
    ax.set(xlabel="step", ylabel="variance missed, held out (%)", yscale="log")
    ax.set_yticks(ticks := (1, 3, 10, 30, 100), [f"{x:g}" for x in ticks])
    ax.minorticks_off()
    ax.set_ylim(top=300)
    ax.legend(frameon=False, fontsize=9, labelcolor=INK, loc="upper right", ncols=len(parts))
    return ax.figure


# ------------------------------------------------------------------------------------------------------------- meeting
# What accuracy costs: errors over seconds.


def errors_and_seconds(
    points: Mapping[str, tuple[float, Tensor]],
    roles: Mapping[str, str],
    generator: Generator,
    *,
    ylabel: str,
    lasts: float = 2.0,
) -> Figure:
    """A point per method with its name: label -> (seconds per clip, errors (N,)); means and 95 % intervals over clips.

    Methods without a role are grey. lasts: seconds of a clip, marked by a line.
    """
    fig, (ax,) = canvas(size=(7.6, 3.6))
    for name, (seconds, errors) in points.items():
        errors = errors[errors.isfinite()]
        value, low, high = interval(errors, "mean", generator)
        paint = colour(roles[name]) if name in roles else colour("observation")
        ax.errorbar(seconds, value, [[value - low], [high - value]], fmt="o", color=paint, ms=7, lw=1.4, capsize=3)
        ax.annotate(name, (seconds, value), (7, 4), textcoords="offset points", fontsize=8, color=INK)
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    ax.set_xlim(low, high * 8)  # room for the names
    ax.axvline(lasts, color=LINE, lw=1, zorder=0)
    ax.annotate("as long as the clip lasts", (lasts, ax.get_ylim()[1]), (-3, -4), textcoords="offset points",
                rotation=90, ha="right", va="top", fontsize=7, color=INK)  # fmt: skip
    ax.set_xlabel("seconds per clip after stage 2", color=INK)
    ax.set_ylabel(ylabel, color=INK)
    return fig
