"""The figures of notebook 03: weights by size and reach, who moves whom, and what a threshold buys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.body import BodyModel
from motionlab.skinning import FAR, SMALL, WeightReport
from motionlab.viz.palette import ROLE
from studies.shared.plots import canvas


def sizes(reports: Mapping[str, WeightReport]) -> Figure:
    """Histogram of the non-zero weights of each body on a logarithmic axis."""
    fig, axes = canvas(1, len(reports), size=(3.4 * len(reports), 2.9), sharey=True)
    for ax, (name, report) in zip(axes, reports.items(), strict=True):
        edges, share = report.edges.numpy(), 100 * report.counts.numpy() / report.nonzero
        low = edges[1:] <= report.threshold * 1.001
        for mask, role in ((low, "axis-angle"), (~low, "ours")):
            ax.bar(edges[:-1][mask], share[mask], np.diff(edges)[mask], align="edge", color=ROLE[role], lw=0)
        ax.set(title=name, xscale="log", xlabel="weight")
        ax.axvline(report.threshold, color=ROLE["truth"], lw=1, ls=":")
    axes[0].set_ylabel("% of non-zero weights")
    return fig


def reach(weights: Tensor, distance: Tensor, marked: Tensor | None = None) -> Figure:
    """Every non-zero weight (V, J) over its distance (V, J) in metres from the joint's region."""
    fig, (ax,) = canvas(1, 1, size=(7.5, 3.4))
    present = (weights > 0) & distance.isfinite()
    ax.scatter(distance[present], weights[present], s=3, lw=0, alpha=0.25, color=ROLE["ours"], label="weights")
    if marked is not None:
        ax.scatter(distance[marked], weights[marked], s=5, lw=0, color=ROLE["axis-angle"], label="planted")
    ax.axvspan(FAR, float(distance[present].max()) * 1.03, 0, 1, color=ROLE["baseline"], alpha=0.08, lw=0)
    ax.axhline(SMALL, color=ROLE["truth"], lw=1, ls=":")
    ax.axvline(FAR, color=ROLE["truth"], lw=1, ls=":")
    ax.set(yscale="log", xlabel="distance along the surface to the joint's own region, m", ylabel="weight")
    ax.legend(loc="upper right", markerscale=3)
    return fig


def who_moves_whom(panels: Mapping[str, Tensor], body: BodyModel, keypoints: Sequence[str]) -> Figure:
    """Heat map of influence (K, J), metres per radian, one panel per body; empty squares are exact zeros."""
    fig, axes = canvas(1, len(panels), size=(5.0 * len(panels), 3.2), sharey=True)
    image = None
    for ax, (name, influence) in zip(axes, panels.items(), strict=True):
        shown = np.ma.masked_equal(influence.numpy(), 0)
        image = ax.imshow(shown, norm=LogNorm(1e-5, 1), cmap="viridis", aspect="auto")
        ax.set_xticks(range(len(body.skeleton)), body.skeleton.names, rotation=90, fontsize=9)
        ax.set_yticks(range(len(keypoints)), keypoints, fontsize=9.5)
        ax.set_title(name)
        ax.grid(visible=False)
    fig.colorbar(image, ax=axes, label="m per rad", fraction=0.03, pad=0.015)
    return fig


def trade(rows: Sequence[Mapping[str, float]]) -> Figure:
    """Leakage against displacement over the pruning threshold, rows as of :func:`motionlab.skinning.pruning_sweep`."""
    fig, (left,) = canvas(1, 1, size=(7.5, 3.2))
    at = [row["threshold"] for row in rows]
    left.plot(at, [100 * row["leakage"] for row in rows], "o-", color=ROLE["axis-angle"], label="leaked gradient")
    left.set(xscale="log", xlabel="weights below this are pruned", ylabel="leaked share of gradient norm, %")
    right = left.twinx()
    right.plot(at, [row["max_mm"] for row in rows], "s-", color=ROLE["ours"], label="largest displacement")
    right.plot(at, [row["mean_mm"] for row in rows], "s:", color=ROLE["ours"], label="mean displacement")
    right.set(ylabel="vertices move by, mm", yscale="symlog")
    right.spines["right"].set_visible(True)
    left.axvline(SMALL, color=ROLE["truth"], lw=1, ls=":")
    handles = [*left.get_lines()[:1], *right.get_lines()]
    left.legend(handles, [h.get_label() for h in handles], loc="center left")
    return fig


def legs_moved(before: Sequence[float], after: Sequence[float], name: str) -> Figure:
    """Leg displacement of every clip, before and after pruning, joined by a line."""
    fig, (ax,) = canvas(1, 1, size=(5.0, 3.0))
    for b, a in zip(before, after, strict=True):
        ax.plot([0, 1], [max(b, 1e-3), max(a, 1e-3)], "o-", color=ROLE["ours"], alpha=0.6, lw=1)
    ax.set_xticks([0, 1], ["with all weights", "pruned"])
    ax.set(yscale="log", ylabel="legs moved by, mm", title=f"{name}, n = {len(before)} clips")
    return fig
