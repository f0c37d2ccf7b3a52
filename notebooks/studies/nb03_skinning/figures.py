"""The figures of notebook 03: how weights fall off, how far the legs go, what a threshold buys."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.skinning import SMALL
from motionlab.viz.palette import ROLE
from studies.shared.plots import canvas

_LEAK, _KEPT = ROLE["axis-angle"], ROLE["ours"]


def falls_off(weights: Tensor, distance: Tensor, rate: Tensor, joints: Mapping[str, int]) -> Figure:
    """Weights (V, J) over distance (V, J), one panel per joint, with the fall-off (J,) that was measured above 1e-2."""
    fig, axes = canvas(1, len(joints), size=(3.2 * len(joints), 3.1), sharey=True, sharex=True)
    for ax, (name, joint) in zip(axes, joints.items(), strict=True):
        w, d = weights[:, joint].double().numpy(), distance[:, joint].numpy()
        shown = (w > 0) & (d > 0)
        far = shown & (w < SMALL) & (d > float(rate[joint]) * np.log10(0.5 / np.maximum(w, 1e-9)))
        for mask, colour, label in ((shown & ~far, _KEPT, "ordinary"), (far, _LEAK, "long-range")):
            ax.scatter(d[mask], w[mask], s=9 if colour == _KEPT else 26, lw=0, alpha=0.6, color=colour, label=label)
        line = np.geomspace(1e-4, 0.5, 50)
        ax.plot(float(rate[joint]) * np.log10(0.5 / line), line, color=ROLE["truth"], lw=1.4, label="measured reach")
        ax.axhline(SMALL, color=ROLE["truth"], lw=1, ls=":")
        ax.set(title=f"{name}, n = {shown.sum()}", yscale="log", ylim=(1e-4, 1), xlabel="distance to its region, m")
        ax.set_xscale("function", functions=(np.sqrt, np.square))
        ax.set(xlim=(0, 2.1), xticks=[0.02, 0.1, 0.3, 0.6, 1, 2])
    axes[0].set_ylabel("weight")
    axes[-1].legend(loc="upper right", markerscale=2)
    return fig


def legs_moved(groups: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> Figure:
    """Leg displacement of every clip with all weights and after pruning; an exact zero stands at zero."""
    fig, (ax,) = canvas(1, 1, size=(7.2, 3.2))
    for place, pair in enumerate(groups.values()):
        aside = np.linspace(-0.12, 0.12, len(pair[0]))
        for shift, values, colour, label in ((-0.2, pair[0], _LEAK, "all weights"), (0.2, pair[1], _KEPT, "pruned")):
            look = {"color": colour, "ms": 6, "alpha": 0.75, "mew": 0, "clip_on": False}
            ax.plot(place + shift + aside, values, "o", label=label if place == 0 else None, **look)
    ax.set_xticks(range(len(groups)), [f"{name}\nn = {len(pair[0])} clips" for name, pair in groups.items()])
    ax.set(ylabel="a leg joint moved by at most, mm")
    ax.set_yscale("symlog", linthresh=1, linscale=0.5)  # even up to 1 mm, logarithmic above
    ax.set_ylim(0, 5000)
    ax.set_yticks([0, 1, 10, 100, 1000], ["0", "1", "10", "100", "1000"])
    ax.legend(loc="upper right")
    return fig


def trade(rows: Sequence[Mapping[str, float]]) -> Figure:
    """What a pruning threshold leaves of the leak and of the planted entries, and how far it moves the skin.

    rows as of :func:`studies.nb03_skinning.pruning.sweep`.
    """
    fig, axes = canvas(1, 3, size=(11.5, 3.3), sharex=True)
    for ax, key, times, look, colour, label in (
        (axes[0], "leak", 1, "o-", _LEAK, ""), (axes[1], "left", 100, "o-", _LEAK, ""),
        (axes[2], "max_mm", 1, "o-", _LEAK, "planted, worst vertex"),
        (axes[2], "clean_max_mm", 1, "s-", _KEPT, "anny itself, worst vertex"),
        (axes[2], "clean_mean_mm", 1, "s:", _KEPT, "anny itself, mean"),
    ):  # fmt: skip
        at = [row["threshold"] for row in rows]
        ax.plot(at, [times * row[key] for row in rows], look, color=colour, label=label, ms=4.5)
    axes[0].set(title="leak from the face to the legs", ylabel="% of the gradient's norm", ylim=(0, None))
    axes[1].set(title="planted entries that are left", ylabel="%", ylim=(0, 104))
    axes[2].set(title="skin moved by pruning", ylabel="mm", yscale="log", ylim=(1e-4, 1e5))
    axes[2].legend(loc="upper left")
    for ax in axes:
        ax.set(xscale="log", xlabel="weights below this are pruned")
        for mark in (1e-3, SMALL):
            ax.axvline(mark, color=ROLE["truth"], lw=1, ls=":")
    return fig
