"""What accuracy costs: errors over seconds."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.figure import Figure
from torch import Generator, Tensor

from motionlab.findings import interval
from motionlab.viz.palette import INK, LINE, colour
from motionlab.viz.plots import canvas


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
