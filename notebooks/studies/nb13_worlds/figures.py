"""The figures of notebook 13."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.viz.palette import INK, colour
from studies.shared.plots import canvas

#: Arms in the order they are drawn, with their colours.
ROLES = {"stuck": "ours", "world": "axis-angle", "world, 8 cm": "6d"}
#: Of the pelvis's nine numbers: the name of each, or of the first of several, and its colour.
_NAMES = {0: "x", 1: "y", 2: "height", 3: "six numbers of the rotation"}
_TINTS = ("ours", "axis-angle", "6d", "stage2")


def two_layouts(here: Mapping[str, Tensor], there: Mapping[str, Tensor], fps: float) -> Figure:
    """The pelvis's numbers (T, 9) over time, by layout, of a clip (lines) and of the same clip moved (dashes).

    Left of each pair its place, right the six numbers of its rotation.
    """
    fig, axes = canvas(1, 2 * len(here), size=(12.0, 2.9))
    for k, (name, rows) in enumerate(here.items()):
        time = np.arange(len(rows)) / fps
        for ax, columns in zip(axes[2 * k : 2 * k + 2], (range(3), range(3, 9)), strict=True):
            for j in columns:
                ax.plot(time, rows[:, j], color=colour(_TINTS[min(j, 3)]), lw=2.6, label=_NAMES.get(j))
                ax.plot(time, there[name][:, j], color=INK, lw=1.0, ls=(0, (2, 2)))
            ax.set_xlabel("time (s)")
        axes[2 * k].set_title(f"{name}: place (m)")
        axes[2 * k + 1].set_title(f"{name}: rotation")
        axes[2 * k + 1].set_ylim(-1.1, 1.1)
    labels = [ax.get_legend_handles_labels() for ax in axes[:2]]
    fig.legend(*(a + b for a, b in zip(*labels, strict=True)), loc="outside lower center", ncols=4, fontsize=9)
    return fig


def by_arm(
    panels: Mapping[str, Mapping[str, Tensor]],
    lines: Mapping[str, Mapping[str, float]],
    longer: Mapping[str, Mapping[str, Tensor]],
) -> Figure:
    """A panel a measure, a column an arm, a dot a seed, dots of one seed joined.

    lines: what stands beside, by name. longer: the same of arms that were trained for longer, as diamonds.
    """
    fig, axes = canvas(1, len(panels), size=(5.0 * len(panels), 3.4))
    for ax, (measure, arms) in zip(axes, panels.items(), strict=True):
        values = np.stack([x.numpy() for x in arms.values()], 1)
        ax.plot(range(len(arms)), values.T, color=INK, lw=0.6, alpha=0.35)
        for k, (name, x) in enumerate(arms.items()):
            ax.plot([k] * len(x), x, "o", color=colour(ROLES[name]), ms=6, alpha=0.8)
        for name, x in longer[measure].items():
            ax.plot([list(arms).index(name)] * len(x), x, "D", color=colour(ROLES[name]), ms=8, mfc="white", mew=2)
        for name, y in lines[measure].items():
            ax.axhline(y, color=INK, lw=0.9, ls=(0, (4, 3)))
            ax.annotate(name, (len(arms) - 0.55, y), va="center", fontsize=8, color=INK, annotation_clip=False)
        ax.set_xticks(range(len(arms)), list(arms))
        ax.set_xlim(-0.5, len(arms) - 0.6)
        ax.set_ylim(0, None)
        ax.set_title(measure)
        ax.grid(axis="x", visible=False)
    return fig


def why(units: Mapping[str, float], hides: Mapping[str, tuple], left: Mapping[str, tuple]) -> Figure:
    """Left: centimetres of the root's place that the noise hides over the share of the noising, by arm. Then a panel a
    measure: what the estimates leave, by arm (S, levels), mean and range over seeds.

    hides: arm -> (shares, cm). left: measure -> (levels, by arm).
    """
    fig, axes = canvas(1, 1 + len(left), size=(4.0 * (1 + len(left)), 3.2))
    for name, (share, cm) in hides.items():
        axes[0].plot(share, cm, color=colour(ROLES[name]), lw=1.8, label=f"{name}: unit {100 * units[name]:.0f} cm")
    axes[0].set(yscale="log", title="noise on the root (cm)", xlabel="share of the noising")
    axes[0].legend(fontsize=8, loc="lower right")
    for ax, (measure, (levels, arms)) in zip(axes[1:], left.items(), strict=True):
        for name, x in arms.items():
            tint, rows = colour(ROLES[name]), x.numpy()
            ax.fill_between(levels, rows.min(0), rows.max(0), color=tint, alpha=0.2, lw=0)
            ax.plot(levels, rows.mean(0), "o-", color=tint, lw=1.8, ms=4)
        ax.set(title=measure, xlabel="share of the noising", ylim=(0, None))
    return fig
