"""Single poses in a row: figures over a floor, their handles as balls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.motion import Motion
from motionlab.viz.palette import colour
from motionlab.viz.plots import canvas, paints
from motionlab.viz.scene import Scene

HANDLE = (0.835, 0.369, 0.0)  # vermillion: seen beside every role


def row(
    poses: Mapping[str, Motion | Sequence[Motion]],
    targets: Tensor,
    which: Tensor,
    roles: Mapping[str, str],
    *,
    width: int = 190,
    height: int = 300,
    labels: bool = True,
    azimuth: float = 35.0,
) -> np.ndarray:
    """A panel per label: one pose (1,), or several on one spot, and the handles (22,) at targets (22, 3): (H, W, 3)."""
    names = tuple(poses) if labels else tuple("" for _ in poses)
    with Scene((width * len(poses), height), panels=names, azimuth=azimuth, elevation=8.0) as scene:
        scene.floor()
        for panel, (label, some) in enumerate(poses.items()):
            for pose in [some] if isinstance(some, Motion) else some:
                scene.skeleton(pose, roles.get(label, "ours"), shadow=0.3, panel=panel)
            if which.any():
                scene.points(targets[which].numpy(), HANDLE, radius=0.055, panel=panel)
        return scene.image()


def stacked(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Rows of one width below each other."""
    return np.concatenate(list(rows))


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
