"""The figures of notebook 01: what windows of motion look like, source by source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.corpus import Take
from motionlab.metrics.distribution import DESCRIPTION_UNITS
from motionlab.viz.palette import PAPER, ROLE
from studies.shared.plots import canvas


def descriptions(found: Mapping[str, Mapping[str, Tensor]]) -> Figure:
    """Boxes of every description of :func:`motionlab.metrics.distribution.describe`, one row per source.

    Box: quartiles; whiskers: 5th and 95th percentile.
    """
    fig, axes = canvas(3, 4, size=(14.0, 1.6 + 1.0 * len(found)), sharey=True)
    for ax, (name, unit) in zip(axes, DESCRIPTION_UNITS.items(), strict=True):
        parts = ax.boxplot(
            [np.asarray(source[name]) for source in found.values()],
            orientation="horizontal",
            whis=(5, 95),
            showfliers=False,
            widths=0.6,
            patch_artist=True,
            medianprops={"color": PAPER, "lw": 2.0},
        )
        for box, source in zip(parts["boxes"], found, strict=True):
            box.set(facecolor=ROLE["synthetic" if source.startswith("synthetic") else "real"], edgecolor="none")
        ax.set(xlabel=f"{name}, {unit}")
        ax.set_yticks(range(1, len(found) + 1), list(found))
        ax.set_xlim(left=0)
    axes[0].invert_yaxis()
    return fig


def distances(rows: Mapping[str, tuple[float, np.ndarray]]) -> Figure:
    """Distance of each source to the recordings as a dot, beside its floor (draws of random halves) as a band."""
    fig, (ax,) = canvas(1, 1, size=(8.5, 1.0 + 0.42 * len(rows)))
    for row, (distance, floor) in enumerate(rows.values()):
        low, high = np.quantile(floor, [0.05, 0.95])
        ax.barh(row, high - low, left=low, height=0.5, color=ROLE["observation"], alpha=0.5, lw=0)
        ax.plot(distance, row, "o", ms=8, color=ROLE["ours"])
    ax.set_yticks(range(len(rows)), list(rows))
    ax.invert_yaxis()
    ax.set(xlabel="energy distance of standardised descriptions", xlim=(0, None))
    return fig


def kinds(by_kind: Mapping[str, Sequence[Take]]) -> Figure:
    """Minutes of each kind of motion in a corpus, stacked by part."""
    fig, (ax,) = canvas(1, 1, size=(8.5, 0.9 + 0.32 * len(by_kind)))
    paint = {"train": ROLE["observation"], "choose": ROLE["synthetic"], "report": ROLE["ours"]}
    left = np.zeros(len(by_kind))
    for part, colour in paint.items():
        minutes = [sum(t.motion.seconds for t in takes if t.part == part) / 60 for takes in by_kind.values()]
        ax.barh(range(len(by_kind)), minutes, left=left, color=colour, height=0.65, label=part, lw=0)
        left += np.array(minutes)
    ax.set_yticks(range(len(by_kind)), list(by_kind))
    ax.invert_yaxis()
    ax.set(xlabel="minutes", xlim=(0, None))
    ax.legend(loc="lower right", frameon=False)
    return fig
