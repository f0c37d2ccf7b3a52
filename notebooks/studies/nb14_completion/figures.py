"""Single poses in a row: figures over a floor, their handles as balls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.viz.palette import colour
from studies.shared.plots import canvas, paints


def errors(
    panels: Mapping[str, Mapping[str, Tensor]], roles: Mapping[str, str], *, xlabel: str, log: bool = False
) -> Figure:
    """A panel per source, a line per way: every pose (B,) a dot, the middle half a bar, the mean a stroke."""
    ways = list(next(iter(panels.values())))
    fig, axes = canvas(1, len(panels), size=(3.6 * len(panels) + 1.2, 0.36 * len(ways) + 1.0), sharex=True, sharey=True)
    spread = np.random.default_rng(0)
    for ax, (name, found) in zip(axes, panels.items(), strict=True):
        for k, way in enumerate(ways):
            values, paint = found[way].numpy(), colour(roles.get(way, "ours"))
            ax.scatter(values, k + spread.uniform(-0.28, 0.28, len(values)), s=4, color=paint, alpha=0.35, lw=0)
            low, high = np.percentile(values, (25, 75))
            ax.plot((low, high), (k, k), color=paint, lw=5, alpha=0.6, solid_capstyle="butt")
            ax.plot([values.mean()] * 2, (k - 0.36, k + 0.36), color=paint, lw=2.5)
        ax.set(title=f"{name} (n = {len(values)})", xlabel=xlabel)
        ax.grid(axis="y", visible=False)
    axes[0].set_yticks(range(len(ways)), ways)
    axes[0].invert_yaxis()
    axes[0].set_xscale("log" if log else "linear")
    return fig


def over_steps(panels: Mapping[str, Mapping[str, Tensor]], steps: Sequence[int], roles: Mapping[str, str]) -> Figure:
    """A panel per measure, a line per source: means over poses (B, S) at every number of steps, quartiles shaded."""
    fig, axes = canvas(1, len(panels), size=(4.3 * len(panels), 3.0))
    for ax, (name, series) in zip(axes, panels.items(), strict=True):
        for source, paint in paints(list(series), roles).items():
            values = series[source].numpy()
            ax.fill_between(steps, *np.percentile(values, (25, 75), axis=0), color=paint, alpha=0.15, lw=0)
            ax.plot(steps, values.mean(0), "o-", ms=4, color=paint, lw=1.8, label=source)
        ax.set(xscale="log", xlabel="steps", ylabel=f"{name} (cm)")
        ax.set_xticks(list(steps), [str(n) for n in steps])
        ax.minorticks_off()
        ax.set_ylim(bottom=0)
    axes[0].legend()
    return fig
