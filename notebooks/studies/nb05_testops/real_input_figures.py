"""The figures of notebook 05c: methods beside each other, person by person, with what their mean is sure to."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.metrics.intervals import interval
from motionlab.viz.palette import ROLE
from studies.shared.plots import canvas

#: Method -> role, and whether its mark is filled: the plain stage 2 has the colour of the tuned one, and a hollow mark.
METHODS = {"best filter": ("baseline", True), "stage 2": ("stage2", False), "tuned stage 2": ("stage2", True),
           "stage 3": ("stage3", True)}  # fmt: skip
Values = Mapping[str, Tensor]  # method -> one number (P,) a person or clip


def dots(ax: Axes, found: Values, generator: torch.Generator) -> None:
    """Draws a method per column: a faint dot for each value, the mean and its 95 % interval."""
    for x, (method, values) in enumerate(found.items()):
        role, filled = METHODS[method]
        paint, values = ROLE[role], values[values.isfinite()].double()
        spread = np.linspace(-0.16, 0.16, len(values)) if len(values) > 1 else np.zeros(1)
        ax.scatter(x + spread, values, s=9, color=paint, alpha=0.35, lw=0)
        mean, low, high = interval(values, "mean", generator)
        face = paint if filled else "white"
        ax.errorbar(x, mean, [[mean - low], [high - mean]], fmt="o", ms=7, color=paint, mfc=face, lw=2, zorder=3)
        ax.annotate(f"{mean:.1f}", (x, mean), (8, 3), textcoords="offset points", fontsize=9, zorder=4)
    ax.set_xticks(
        range(len(found)), [name.replace(" stage", "\nstage").replace(" filter", "\nfilter") for name in found]
    )
    ax.set_xlim(-0.5, len(found) - 0.3)
    ax.grid(axis="x", visible=False)


def methods(
    rows: Sequence[Mapping[str, Values]], ylabels: Sequence[str], generator: torch.Generator, *, width: float = 2.9
) -> Figure:
    """Draws rows of panels (title -> method -> values); the panels of one row share their axis."""
    columns = max(len(row) for row in rows)
    fig, axes = canvas(len(rows), columns, size=(width * columns, 2.6 * len(rows)), sharey="row")
    for row, label, some in zip(rows, ylabels, axes.reshape(len(rows), columns), strict=True):
        for ax, (title, found) in zip(some, row.items(), strict=False):
            dots(ax, found, generator)
            ax.set_title(title)
        for ax in some[len(row) :]:
            ax.set_axis_off()
        some[0].set_ylim(0, 1.08 * max(float(x[x.isfinite()].max()) for found in row.values() for x in found.values()))
        some[0].set_ylabel(label)
    return fig


def errors_over_time(moments: Mapping[str, Mapping[str, Tensor]], fps: float) -> Figure:
    """Draws the error (V, T) of methods over time, a panel per moment: a thin line a view, a thick one their mean."""
    fig, axes = canvas(1, len(moments), size=(2.7 * len(moments), 2.9), sharey=True)
    for ax, (title, found) in zip(axes, moments.items(), strict=True):
        for method, curves in found.items():
            time, paint = np.arange(curves.shape[-1]) / fps, ROLE[METHODS[method][0]]
            ax.plot(time, curves.T, color=paint, lw=0.9, alpha=0.4)
            ax.plot(time, curves.mean(0), color=paint, lw=2.4, label=method)
        ax.set(title=title, xlabel="time (s)")
    axes[0].set_ylabel("joint error (cm)")
    axes[0].set_ylim(0, 1.05 * max(float(x.max()) for found in moments.values() for x in found.values()))
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig
