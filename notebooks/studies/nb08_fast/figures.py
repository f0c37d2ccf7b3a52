"""Solvers against each other: energy over time, time to a tolerance clip by clip, and what a step costs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from torch import Tensor

from motionlab.viz.palette import INK, LINE, colour
from studies.shared.plots import canvas, paints

#: Colours of the contenders.
ROLES = {
    "single shooting": "baseline", "shooting": "ours", "multiple shooting": "quaternion", "windows": "6d",
    "shooting, no leaps": "stage3",
    "linearisation": "stage3", "closed-loop closure": "ours", "single-shooting closure": "baseline",
}  # fmt: skip
_FLOOR = 1e-4


def energy_over_time(
    panels: Mapping[str, Mapping[str, tuple[Tensor, Tensor]]], *, size: tuple[float, float] = (11.0, 3.6)
) -> Figure:
    """How far above the best energy each contender is after so many seconds: median over clips, quartiles as a band.

    panels: task -> contender -> (seconds (N,), gaps (N, B): (energy - best) / |best|, infinite before the first
    energy); one point: a dot.
    """
    fig, axes = canvas(1, len(panels), size=size, sharey=True)
    for ax, (task, contenders) in zip(axes, panels.items(), strict=True):
        paint = paints(list(contenders), ROLES)
        for name, (seconds, gaps) in contenders.items():
            low, middle, high = np.nanpercentile(np.clip(gaps.numpy(), _FLOOR, 1e3), (25, 50, 75), axis=1)
            if len(seconds) == 1:
                where = (seconds.numpy(), middle, [middle - low, high - middle])
                ax.errorbar(*where, fmt="o", color=paint[name], label=name, capsize=3)
                continue
            ax.fill_between(seconds, low, high, color=paint[name], alpha=0.18, lw=0, step="post")
            ax.step(seconds, middle, where="post", color=paint[name], lw=1.8, label=name)
        for share in (0.05, 0.01):
            ax.axhline(share, color=INK, lw=0.8, ls=(0, (4, 3)))
            ax.annotate(f"{100 * share:g} %", (1.0, share), xycoords=("axes fraction", "data"), ha="right", va="bottom")
        ax.set(title=task, xlabel="processor time (s)", xscale="log", yscale="log", ylim=(_FLOOR, 30))
        ax.xaxis.set_minor_formatter(NullFormatter())  # their labels overlap where there is less than a decade
    axes[0].set_ylabel("energy above the best, of |best|")
    axes[-1].legend(loc="lower left")
    return fig


def promises(tasks: Mapping[str, tuple[Tensor, Tensor]], *, size: tuple[float, float] = (8.0, 3.6)) -> Figure:
    """A panel per task, a dot per valley: by how much it was said to be lower, and by how much it is; only those of
    which both are numbers."""
    fig, axes = canvas(1, len(tasks), size=size)
    for ax, (name, pair) in zip(axes, tasks.items(), strict=True):
        whole = torch.stack([x.flatten() for x in pair])
        promised, found = whole[:, whole.isfinite().all(0)]
        if not len(found):
            continue
        low = min(0.0, promised.min().item(), found.min().item())
        high = max(promised.max().item(), found.max().item(), 1e-3)
        room = 0.08 * (high - low)
        ax.plot((low, high), (low, high), color=LINE, lw=1.2, zorder=0)
        ax.scatter(promised, found, s=26, color=colour("ours"), alpha=0.7, lw=0)
        ax.set(xlim=(low - room, high + room), ylim=(low - room, high + room), title=name)
        ax.set(xlabel="energy lower by, promised", ylabel="found" if ax is axes[0] else "")
    return fig


def shares(parts: Mapping[str, Mapping[str, float]], *, size: tuple[float, float] = (8.0, 2.4)) -> Figure:
    """Shares of the parts of whole fits, side by side in one bar each: fit -> part -> seconds."""
    fig, (ax,) = canvas(size=size)
    names = list(dict.fromkeys(part for fit in parts.values() for part in fit))
    paint = paints(names)
    left = np.zeros(len(parts))
    for name in names:
        width = np.array([100 * fit.get(name, 0.0) / sum(fit.values()) for fit in parts.values()])
        ax.barh(range(len(parts)), width, 0.65, left, color=paint[name], label=name)
        left += width
    ax.set_yticks(range(len(parts)), [f"{name} ({sum(fit.values()):.1f} s)" for name, fit in parts.items()])
    ax.set(xlabel="share of a whole stage 3 (%)", xlim=(0, 100))
    ax.invert_yaxis()
    ax.grid(visible=False, axis="y")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


def scaling(
    panels: Mapping[str, Mapping[str, Mapping[int, Tensor]]], *, size: tuple[float, float] = (9.5, 3.4)
) -> Figure:
    """Milliseconds of each step against its size, logarithmic: x label -> step -> size -> measurements (n,) in s."""
    fig, axes = canvas(1, len(panels), size=size, sharey=True)
    for ax, (xlabel, steps) in zip(axes, panels.items(), strict=True):
        paint = paints(list(steps), ROLES)
        for name, found in steps.items():
            sizes = sorted(found)
            ax.plot(sizes, [1e3 * found[k].quantile(0.5).item() for k in sizes], color=paint[name], lw=1.6, label=name)
            for k in sizes:
                ax.plot([k] * len(found[k]), 1e3 * found[k], "o", color=paint[name], ms=4, mec="white", mew=0.5)
        ax.set(xscale="log", yscale="log", xlabel=xlabel)
        ax.set_xticks(sizes, [str(k) for k in sizes])
        ax.minorticks_off()
    axes[0].set_ylabel("processor time (ms)")
    axes[0].legend(loc="upper left")
    return fig


def newton(found: Mapping[str, Tensor], limit: float, *, size: tuple[float, float] = (6.0, 3.0)) -> Figure:
    """Distance to the exact roll-out in metres after each iteration, one line per clip: label -> (B, n)."""
    fig, (ax,) = canvas(size=size)
    paint = paints(list(found))
    for name, errors in found.items():
        for k, row in enumerate(errors):
            ax.plot(range(len(row)), row.clamp(min=1e-7), color=paint[name], lw=1.4, label=None if k else name)
    ax.axhline(limit, color=colour("truth"), lw=0.8, ls=(0, (4, 3)))
    ax.set(yscale="log", xlabel="Newton iterations", ylabel="largest joint error (m)")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig
