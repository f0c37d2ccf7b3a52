"""The figures of notebook 15: curves with intervals, and bars."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from matplotlib.figure import Figure
from torch import Generator, Tensor

from motionlab.metrics import interval
from studies.shared.fill_contenders import GAUSSIAN, R, T
from studies.shared.plots import canvas, paints

ROLES = {
    "network": "ours", "ridge regression": "baseline", "the thesis's, small": "axis-angle", R: "ours", T: "stage2",
    GAUSSIAN: "quaternion", "one draw of T": "observation", "latent diffusion": "ours", "Gaussian": "quaternion",
    "stage 3": "stage3", "stage 2": "stage2", "P": "axis-angle", "recorded people": "truth", "R, true body": "ours",
}  # fmt: skip


@dataclass(frozen=True)
class Panel:
    """lines: label -> x -> samples (n,), drawn as their mean and its interval. levels: label -> samples of a level."""

    lines: Mapping[str, Mapping[float, Tensor]]
    xlabel: str
    ylabel: str
    levels: Mapping[str, Tensor] = field(default_factory=dict)


def spoken(panel: Panel) -> str:
    """The means of a panel."""
    lines = {n: ", ".join(f"{x:g}: {y.mean():.3g}" for x, y in some.items()) for n, some in panel.lines.items()}
    lines |= {name: f"{x.mean():.3g}" for name, x in panel.levels.items()}
    return "; ".join(f"{name} {text}" for name, text in lines.items())


def curves(panels: Mapping[str, Panel], generator: Generator) -> Figure:
    """A panel each: means and 95 % intervals over x, which is drawn by its logarithm."""
    fig, axes = canvas(1, len(panels), size=(1.0 + 3.6 * len(panels), 3.2))
    for ax, (title, panel) in zip(axes, panels.items(), strict=True):
        paint = paints([*panel.lines, *panel.levels], ROLES)
        for label, points in panel.lines.items():
            some = {x: y for x, y in sorted(points.items()) if len(y)}
            value, low, high = np.array([interval(y, "mean", generator) for y in some.values()]).reshape(-1, 3).T
            ax.fill_between(list(some), low, high, color=paint[label], alpha=0.16, lw=0)
            ax.plot(list(some), value, "o-", ms=4, lw=1.8, color=paint[label], label=label)
        for label, samples in panel.levels.items():
            ax.axhline(float(samples.mean()), color=paint[label], lw=1.4, ls=(0, (4, 2)), label=label)
        ax.set(xscale="log", xlabel=panel.xlabel, ylabel=panel.ylabel, title=title)
        ax.set_xticks(list(some), [f"{x:g}" for x in some])
        ax.minorticks_off()
        ax.set_ylim(0, (1.1 + 0.1 * len(paint)) * ax.get_ylim()[1])  # the legend lies above the lines
        ax.legend(loc="upper right", fontsize=8)
    return fig


def bars(panels: Mapping[str, Mapping[str, Tensor]], roles: Mapping[str, str], generator: Generator) -> Figure:
    """A panel a measure, a line each: people or seeds, their mean and its interval."""
    names = list(next(iter(panels.values())))
    fig, axes = canvas(1, len(panels), size=(1.4 + 3.3 * len(panels), 0.9 + 0.34 * len(names)), sharey=True)
    paint = paints(names, ROLES | dict(roles))
    for ax, (title, rows) in zip(axes, panels.items(), strict=True):
        for at, (label, values) in enumerate(rows.items()):
            value, low, high = interval(values, "mean", generator)
            ax.plot(values, [at] * len(values), ".", color=paint[label], alpha=0.35)
            ax.plot((low, high), (at, at), color=paint[label], lw=2.5)
            ax.plot(value, at, "o", color=paint[label], ms=6)
        ax.set(xlim=(0, None), xlabel=title)
    axes[0].set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.5, -0.5))
    return fig
