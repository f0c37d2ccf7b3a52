"""The figures of notebook 09: what is open, how open, and whether it is as open as somebody says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import binom, norm
from torch import Tensor

from motionlab.motion import Motion
from motionlab.viz import movie
from motionlab.viz.palette import INK, LINE, PAPER, ROLE, blend, colour
from motionlab.viz.scene import Scene
from studies.shared.plots import canvas, paints


def corner(
    series: Mapping[str, Tensor],
    names: Sequence[str],
    *,
    truth: Tensor | None = None,
    gaussian: tuple[Tensor, Tensor] | None = None,
    roles: Mapping[str, str] | None = None,
    most: int = 1200,
    size: float = 1.9,
) -> Figure:
    """Draws (N, n) by label: every number's distribution on the diagonal, every pair's below it.

    truth (n,): black lines. gaussian: mean (n,) and factor (n, n), its curve and the ellipse that holds 90 %.
    """
    count, paint = len(names), paints(list(series), roles)
    fig, axes = canvas(count, count, size=(size * count + 0.6, size * count + 0.2))
    grid = axes.reshape(count, count)
    every = torch.cat(list(series.values())).numpy(force=True)
    low, high = np.percentile(every, (0.2, 99.8), axis=0)
    if truth is not None:
        low, high = np.minimum(low, truth.numpy()), np.maximum(high, truth.numpy())
    if gaussian is not None:
        middle, reach = gaussian[0].numpy(force=True), 2.5 * gaussian[1].norm(dim=1).numpy(force=True)
        low, high = np.minimum(low, middle - reach), np.maximum(high, middle + reach)
    low, high = low - 0.06 * (high - low), high + 0.06 * (high - low)
    for row in range(count):
        for column in range(count):
            ax = grid[row, column]
            if column > row:
                ax.set_visible(False)
                continue
            _cell(ax, row, column, series, paint, (low, high), truth, gaussian, most)
            ax.set_xlim(low[column], high[column])
            ax.set_xlabel(names[column] if row == count - 1 else "")
            ax.set_ylabel(names[row] if column == 0 and row else "")
            ax.tick_params(labelbottom=row == count - 1, labelleft=column == 0 and row > 0, labelsize=8)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="upper right", frameon=False, fontsize=9)
    return fig


def _cell(ax, row, column, series, paint, limits, truth, gaussian, most) -> None:
    low, high = limits
    if row == column:
        for label, draws in series.items():
            values = draws[:, row].numpy(force=True)
            edges = np.linspace(low[row], high[row], 41)
            share = np.histogram(values, edges, density=True)[0]
            ax.stairs(share, edges, color=(*paint[label], 0.2), fill=True)
            ax.stairs(share, edges, color=paint[label], lw=1.5, label=label)
        if gaussian is not None:
            x, deviation = np.linspace(low[row], high[row], 200), float(gaussian[1][row].norm())
            ax.plot(x, norm.pdf(x, float(gaussian[0][row]), deviation), color=ROLE["baseline"], lw=1.5, label="Laplace")
        ax.set_yticks([])
        ax.grid(visible=False)
    else:
        for label, draws in series.items():
            some = draws[:: max(1, len(draws) // most)].numpy(force=True)
            ax.plot(some[:, column], some[:, row], ".", ms=2.2, color=paint[label], alpha=0.3, mew=0)
        if gaussian is not None:
            around = np.stack((np.cos(t := np.linspace(0, 2 * np.pi, 120)), np.sin(t)))
            pair = gaussian[1][[column, row]]
            root = np.linalg.cholesky((pair @ pair.mT).numpy())
            ring = gaussian[0][[column, row]].numpy()[:, None] + np.sqrt(-2 * np.log(0.1)) * root @ around
            ax.plot(*ring, color=ROLE["baseline"], lw=1.4)
        ax.set_ylim(low[row], high[row])
    if truth is not None:
        ax.axvline(float(truth[column]), color=ROLE["truth"], lw=1.2, label="truth" if row == column else None)
        if row != column:
            ax.axhline(float(truth[row]), color=ROLE["truth"], lw=1.2)


def narrowing(widths: Mapping[str, Mapping[str, Tensor]], *, ylabel: str, roles: Mapping[str, str]) -> Figure:
    """State of knowledge -> who says it -> half width (C,) for each clip, logarithmic: dots, medians as bars."""
    labels = list(next(iter(widths.values())))
    paint = paints(labels, roles)
    fig, (ax,) = canvas(size=(7.6, 3.1))
    for index, group in enumerate(widths.values()):
        for k, (label, values) in enumerate(group.items()):
            x = index + 0.3 * (k - (len(labels) - 1) / 2)
            y = values.numpy(force=True)
            jitter = 0.1 * (np.arange(len(y)) / max(len(y) - 1, 1) - 0.5)
            ax.plot(x + jitter, y, ".", ms=4, color=paint[label], alpha=0.5, mew=0)
            ax.plot(
                [x - 0.13, x + 0.13], [np.median(y)] * 2, color=paint[label], lw=2.4, label=label if not index else None
            )
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_xticks(
        range(len(widths)), [name.replace(" and ", "\nand ", 1).replace("height", "height\n") for name in widths]
    )
    ax.grid(visible=False, axis="x")
    ax.set_ylabel(ylabel)
    ax.legend(frameon=False)
    return fig


def reliability(
    found: Mapping[str, Tensor], *, roles: Mapping[str, str], size: tuple[float, float] = (4.6, 4.2)
) -> Figure:
    """Share of clips whose region holds the truth, by the region's level, from u (C,); the grey band is where 95 % of
    right posteriors would lie with as many clips."""
    paint = paints(list(found), roles)
    fig, (ax,) = canvas(size=size)
    level, count = np.linspace(0, 1, 101), max(len(u) for u in found.values())
    ax.fill_between(
        100 * level, *(100 * binom.ppf(q, count, level) / count for q in (0.025, 0.975)), color=LINE, alpha=0.5, lw=0
    )
    ax.plot([0, 100], [0, 100], color=INK, lw=1, ls=":")
    for label, u in found.items():
        ends = np.append(np.sort(u.numpy(force=True)), 1.0)
        ax.step(
            100 * ends,
            100 * np.append(np.arange(1, len(u) + 1), len(u)) / len(u),
            where="post",
            color=paint[label],
            lw=1.9,
            label=label,
        )
    ax.set(
        xlabel="level of the region (%)",
        ylabel="clips whose truth lies inside (%)",
        xlim=(0, 101),
        ylim=(-1, 101),
        aspect="equal",
    )
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return fig


def rank_bars(found: Mapping[str, Tensor], *, roles: Mapping[str, str], bins: int = 6) -> Figure:
    """Ranks (C, n) of the truth among the draws, a panel per posterior: flat where it is right, a U where too narrow.

    The band holds 95 % of the bars of a right posterior whose ranks are independent.
    """
    fig, axes = canvas(1, len(found), size=(2.6 * len(found) + 0.4, 2.6), sharey=True)
    paint = paints(list(found), roles)
    for ax, (label, ranks) in zip(axes, found.items(), strict=True):
        values = ranks.flatten().numpy(force=True)
        edges = np.linspace(0, 1, bins + 1)
        share = 100 * np.histogram(values, edges)[0] / len(values)
        ax.stairs(share, edges, color=(*paint[label], 0.55), fill=True)
        low, high = (100 * binom.ppf(q, len(values), 1 / bins) / len(values) for q in (0.025, 0.975))
        ax.axhspan(low, high, color=LINE, alpha=0.5, lw=0, zorder=0)
        ax.axhline(100 / bins, color=INK, lw=1, ls=":")
        ax.set(title=label, xlabel="rank of the truth")
    axes[0].set_ylabel("share (%)")
    return fig


def fans(
    clips: Mapping[str, tuple[Tensor, Tensor, Tensor, Tensor]], labels: Sequence[str], fps: float, *, ylabel: str, roles
) -> Figure:
    """A number over time, a column per clip and a row per posterior: truth (T,), fit (T,), hidden (T,) and draws
    (P, N, T) of P posteriors; bands of 50 and 90 %, a few draws as lines."""
    fig, axes = canvas(
        len(labels), len(clips), size=(2.9 * len(clips) + 0.3, 2.2 * len(labels) + 0.2), sharex=True, sharey=True
    )
    grid = axes.reshape(len(labels), len(clips))
    for column, (name, (truth, fit, hidden, draws)) in enumerate(clips.items()):
        t = np.arange(len(truth)) / fps
        for row, label in enumerate(labels):
            ax, paint = grid[row, column], colour(roles[label])
            values = draws[row].numpy(force=True)
            for low, high, alpha in ((5, 95, 0.2), (25, 75, 0.3)):
                ax.fill_between(t, *np.percentile(values, (low, high), axis=0), color=paint, alpha=alpha, lw=0)
            ax.plot(t, fit, color=ROLE["stage3"], lw=1.5, label="fit")
            ax.plot(t, truth, color=ROLE["truth"], lw=1.5, label="truth")
            first = int(np.argmax(hidden.numpy()))
            ax.axvspan(t[first], t[-1], color=LINE, alpha=0.25, lw=0, zorder=0)
            ax.set_title(f"{name}\n{label}" if not row else label)
            if row == len(labels) - 1:
                ax.set_xlabel("time (s)")
            if not column:
                ax.set_ylabel(ylabel)
    grid[0, 0].legend(loc="best", frameon=False)
    return fig


def fan_film(
    panels: Mapping[str, Motion], path: str | Path, *, roles: Mapping[str, str], fps: float = 10.0, speed: float = 0.5
) -> movie.Film:
    """A film with a panel per posterior: all draws (N, T) of the panel at once, one strong and the others pale."""
    shown = dict(panels)
    length = min(motion.frames for motion in shown.values())
    seconds = (length - 1) / next(iter(shown.values())).fps
    with Scene((300 * len(shown), 340), panels=tuple(shown)) as scene:
        for panel, (label, motions) in enumerate(shown.items()):
            many = motions.rot.ndim == 5
            for index in range(len(motions.root) if many else 1):
                pale = min(0.62, 0.62 * index)
                tone = blend(colour(roles[label]), PAPER, pale)
                scene.skeleton(
                    motions.clip(index) if many else motions, tone, shadow=0.0 if index else 0.4, panel=panel
                )
        scene.floor()
        clock, pictures = scene.caption(), []
        for now in movie.drawn(np.arange(0.0, seconds + 1e-6, speed / fps)):
            clock(f"{now:.1f} s  ({speed:g} x life)")
            pictures.append(scene.image(float(now)))
    frames, rate, size = movie.write_film(pictures, path, len(pictures) * speed / seconds, budget=600_000)
    return movie.Film(Path(path), frames, rate, seconds, speed, size)


def ridge_line(share: Tensor, energies: Mapping[str, Tensor], *, ylabel: str) -> Figure:
    """Energy along straight ways from one mode (0) to another (1), a curve (S,) per clip, above the lower end."""
    fig, (ax,) = canvas(size=(6.4, 2.9))
    for label, values in energies.items():
        y = values.numpy(force=True)
        ax.plot(share, y - min(y[0], y[-1]), lw=1.6, label=label)
    ax.set(xlabel="way from the fit (0) to the other foot forward (1)", ylabel=ylabel)
    ax.set_yscale("symlog", linthresh=100.0)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return fig
