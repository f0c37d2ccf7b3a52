"""The figures of notebook 11: who stands where, by source of motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, ScalarFormatter
from torch import Tensor

from motionlab.metrics import intervals
from motionlab.viz.palette import INK, LINE, colour
from studies.shared.plots import canvas, paints

Found = Mapping[str, Mapping[str, Tensor]]  # source -> method -> (N,)
#: A colour for each method, the same in all figures of the test cases.
ROLES = {
    "truth": "truth", "noisy": "observation", "mean": "observation", "hold": "observation",
    "nearest": "6d", "linear": "6d", "ridge": "quaternion", "slerp": "baseline", "Kalman smoother": "baseline",
    "Savitzky-Golay": "axis-angle", "one euro": "quaternion", "Eq. 4.10": "axis-angle", "not told": "stage2",
    "told": "ours", "told, planted": "ours", "ridge, planted": "quaternion", "nearest, planted": "6d",
    "mean, planted": "observation", "not told, planted": "stage2", "start alone": "stage3",
    "start alone, planted": "stage3",
    "curves": "real", "diffusion": "ours", "no last overwrite": "stage3",
}  # fmt: skip


def standings(panels: Found, *, xlabel: str, log: bool = False, truth: float | None = None) -> Figure:
    """A panel per source, a line per method: the windows' middle half, and their mean with its 95 % interval.

    truth: a value to draw a line at.
    """
    methods = list(dict.fromkeys(name for found in panels.values() for name in found))
    fig, axes = canvas(1, len(panels), size=(2.0 + 2.6 * len(panels), 0.9 + 0.3 * len(methods)), sharey=True)
    paint = paints(methods, {name: ROLES[name] for name in methods if name in ROLES})
    generator = torch.Generator().manual_seed(0)
    for ax, (source, found) in zip(axes, panels.items(), strict=True):
        count = 0
        for row, name in enumerate(methods):
            values = found[name][found[name].isfinite()] if name in found else torch.empty(0)
            if not len(values):
                continue
            count = max(count, len(values))
            value, low, high = intervals.interval(values, "mean", generator)
            quarter, three = np.percentile(values.numpy(), (25, 75))
            ax.plot((quarter, three), (row, row), color=paint[name], lw=6, alpha=0.25, solid_capstyle="butt")
            ax.plot((low, high), (row, row), color=paint[name], lw=2)
            ax.plot(value, row, "o", color=paint[name], ms=5)
        if truth is not None:
            ax.axvline(truth, color=INK, lw=0.9, ls=(0, (4, 2)))
        ax.set_xscale("log" if log else "linear")
        ax.set_title(f"{source}  (n = {count})", fontsize=9)
        ax.set_xlabel(xlabel)
        ax.grid(visible=False, axis="y")
    axes[0].set_yticks(range(len(methods)), methods)
    axes[0].set_ylim(len(methods) - 0.5, -0.5)
    if not log:
        for ax in axes:
            ax.set_xlim(left=0)
    return fig


def by_setting(
    panels: Mapping[str, Mapping[str, Mapping[str, Tensor]]], *, xlabel: str, ylabel: str, log: bool = False
) -> Figure:
    """A panel per source, a curve per method over its settings: means (method -> setting -> (N,)), 95 % intervals."""
    fig, axes = canvas(1, len(panels), size=(1.6 + 2.9 * len(panels), 3.3), sharey=True)
    generator = torch.Generator().manual_seed(0)
    for ax, (source, methods) in zip(axes, panels.items(), strict=True):
        paint = paints(list(methods), {name: ROLES[name] for name in methods if name in ROLES})
        for k, (name, settings) in enumerate(methods.items()):
            value, low, high = np.array([intervals.interval(v, "mean", generator) for v in settings.values()]).T
            x = np.arange(len(settings)) + 0.05 * (k - (len(methods) - 1) / 2)
            ax.plot(x, value, "o-", ms=4, lw=1.4, color=paint[name], label=name)
            ax.vlines(x, low, high, color=paint[name], lw=1.4)
        ax.set_xticks(range(len(settings)), [str(setting).replace(", ", "\n") for setting in settings])
        ax.set_title(source, fontsize=9)
        ax.set_xlabel(xlabel)
        ax.set_yscale("log" if log else "linear")
        ax.set_xlim(-0.4, len(settings) - 0.6)
        if log:
            ax.yaxis.set_major_formatter(ScalarFormatter())
            ax.yaxis.set_minor_formatter(FuncFormatter(lambda y, _: f"{y:g}" if f"{y:e}"[0] in "25" else ""))
        else:
            ax.set_ylim(bottom=0)
    axes[0].set_ylabel(ylabel)
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig


def power(panels: Mapping[str, Mapping[str, Tensor]], edges: Sequence[float]) -> Figure:
    """Power over the true power by band of frequency, a panel per case: medians of (N, bands) and quartiles."""
    fig, axes = canvas(1, len(panels), size=(1.6 + 2.7 * len(panels), 3.1), sharey=True)
    labels = [f"{a:g}-{b:g}" for a, b in pairwise(edges)]
    for ax, (name, series) in zip(axes, panels.items(), strict=True):
        paint = paints(list(series), {label: ROLES[label] for label in series if label in ROLES})
        for k, (label, values) in enumerate(series.items()):
            x = np.arange(len(labels)) + 0.13 * (k - (len(series) - 1) / 2)
            low, mid, high = np.nanpercentile(values.numpy(), (25, 50, 75), axis=0)
            ax.vlines(x, low, high, color=paint[label], lw=1.6)
            ax.plot(x, mid, "o", ms=4, color=paint[label], label=label)
        ax.axhline(1, color=INK, lw=0.9, ls=(0, (4, 2)))
        ax.set_xticks(range(len(labels)), labels)
        ax.set_title(name, fontsize=9)
        ax.set(xlabel="frequency (Hz)", yscale="log")
    axes[0].set_ylabel("power / true power")
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig


def seams(
    panels: Mapping[str, Mapping[str, Tensor]],
    known: Tensor,
    *,
    fps: float,
    natural: Mapping[str, float],
    ylabel: str,
) -> Figure:
    """How much the velocity changes at every step (method -> (N, T - 1)) of windows with a gap: median and quartiles.

    known (T,): the frames that were given; the rest is shaded. natural: by source, what real
    motion stays below in 95 % of steps.
    """
    fig, axes = canvas(1, len(panels), size=(1.6 + 2.9 * len(panels), 3.0), sharey=True)
    gap = (~known).nonzero()[:, 0]
    for ax, (source, series) in zip(axes, panels.items(), strict=True):
        paint = paints(list(series), {name: ROLES[name] for name in series if name in ROLES})
        ax.axvspan(float(gap[0] - 0.5) / fps, float(gap[-1] + 0.5) / fps, color=LINE, alpha=0.35, lw=0)
        for name, values in series.items():
            time = (np.arange(values.shape[1]) + 0.5) / fps
            low, mid, high = np.nanpercentile(values.numpy(), (25, 50, 75), axis=0)
            ax.fill_between(time, low, high, color=paint[name], alpha=0.12, lw=0)
            ax.plot(time, mid, color=paint[name], lw=1.5, label=name)
        ax.axhline(natural[source], color=colour("truth"), lw=0.9, ls=(0, (4, 2)))
        ax.set_title(source, fontsize=9)
        ax.set(xlabel="time (s)", yscale="log")
    axes[0].set_ylabel(ylabel)
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig
