"""The figures of notebook 07: what cutting the chain costs, how far news travels, and what the variants find."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.motion import Motion
from motionlab.viz import movie
from motionlab.viz.palette import INK, LINE, colour
from studies.shared.plots import canvas, paints

Cost = Mapping[tuple[str, int, int | None], Tensor]


def costs(seconds: Cost, *, size: tuple[float, float] | None = None) -> Figure:
    """Milliseconds of an evaluation, a panel per form and batch: the roll-out and K steps, median and quartiles, and
    how many times faster than the roll-out. seconds: (form, clips, K or None) -> (n,)."""
    panels = list(dict.fromkeys((form, clips) for form, clips, _ in seconds))
    figure, axes = canvas(1, len(panels), size=size or (2.7 * len(panels) + 0.5, 2.7))
    for ax, (form, clips) in zip(axes, panels, strict=True):
        rows = {k: 1e3 * x for (f, b, k), x in seconds.items() if (f, b) == (form, clips)}
        whole = rows[None].median().item()
        for at, (steps, x) in enumerate(rows.items()):
            low, middle, high = x.quantile(torch.tensor([0.25, 0.5, 0.75]).to(x)).tolist()
            ax.barh(at, middle, 0.7, color=colour("baseline" if steps is None else "ours"))
            ax.errorbar(middle, at, xerr=[[middle - low], [high - middle]], fmt="none", ecolor=INK, capsize=2, lw=1)
            gain = "" if steps is None else f"  x {whole / middle:.1f}"
            ax.annotate(f" {middle:.0f}{gain}", (high, at), (3, 0), textcoords="offset points", va="center", fontsize=8)
        ax.set_yticks(range(len(rows)), ["roll-out" if k is None else f"K = {k}" for k in rows])
        ax.invert_yaxis()
        ax.set_xlim(0, 1.75 * max(x.median().item() for x in rows.values()))
        ax.grid(visible=False, axis="y")
        ax.set_title(f"{form}, {clips} clip{'s' * (clips > 1)}")
        ax.set_xlabel("ms")
    return figure


def news(panels: Mapping[str, Tensor], fps: float, *, size: tuple[float, float] | None = None) -> Figure:
    """How far a nudge of the first frame has come: size of the change (n + 1, T) by iteration and frame, a panel each;
    white where exactly nothing has arrived."""
    figure, axes = canvas(1, len(panels), size=size or (3.1 * len(panels) + 0.9, 2.8), sharey=True)
    high = max(float(x.max()) for x in panels.values())
    for ax, (name, change) in zip(axes, panels.items(), strict=True):
        found = np.ma.masked_less_equal(change.numpy(force=True), 0.0)
        picture = ax.imshow(
            np.ma.log10(found), origin="lower", aspect="auto", cmap="viridis", vmin=np.log10(high) - 6,
            vmax=np.log10(high), extent=(-0.5 / fps, (change.shape[1] - 0.5) / fps, -0.5, len(change) - 0.5),
        )  # fmt: skip
        ax.grid(visible=False)
        ax.set(title=name, xlabel="time in the clip (s)")
    axes[0].set_ylabel("iteration")
    bar = figure.colorbar(picture, ax=list(axes))
    bar.set_label("change, log10 of metres")
    return figure


def variants(
    panels: Mapping[str, Mapping[str, Tensor]],
    roles: Mapping[str, str],
    *,
    straight: Mapping[str, float] | None = None,
    size: tuple[float, float] | None = None,
) -> Figure:
    """A panel per measure, a row per variant: a dot for every clip (B,) and the median as a bar.

    straight: measure -> up to where its axis is linear; beyond, and where nothing is said, see matplotlib's symlog.
    """
    names = list(next(iter(panels.values())))
    figure, axes = canvas(1, len(panels), size=size or (2.6 * len(panels) + 1.6, 0.7 + 0.29 * len(names)), sharey=True)
    paint = paints(names, roles)
    for ax, (measure, found) in zip(axes, panels.items(), strict=True):
        for at, name in enumerate(names):
            x = found[name].numpy(force=True)
            ax.scatter(x, np.full(len(x), at), s=16, color=paint[name], alpha=0.75, lw=0)
            ax.plot([np.median(x)] * 2, [at - 0.33, at + 0.33], color=paint[name], lw=3)
        if straight and measure in straight:
            ax.set_xscale("symlog", linthresh=straight[measure])
            low, high = ax.get_xlim()
            ticks = [t * straight[measure] for t in (-1, 0, 1, 4, 20, 100) if low <= t * straight[measure] <= high]
            ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
            ax.minorticks_off()
        ax.axvline(0, color=LINE, lw=1)
        ax.set_xlabel(measure)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    return figure


Series = Mapping[str, tuple[Sequence[float], Tensor]]


def over_evaluations(
    panels: Mapping[str, Series],
    ylabels: Sequence[str],
    roles: Mapping[str, str],
    *,
    lines: Mapping[str, Mapping[str, float]] | None = None,
    between: Mapping[str, tuple[float, float]] | None = None,
    xlabel: str = "evaluations",
    size: tuple[float, float] | None = None,
) -> Figure:
    """Median over clips and quartiles of series (evaluations (n,), values (n, B)), a panel each.

    lines: panel -> label -> a level to compare with. between: panel -> where its axis ends, whatever lies beyond.
    """
    figure, axes = canvas(1, len(panels), size=size or (4.2 * len(panels), 3.6))
    names = list(dict.fromkeys(name for series in panels.values() for name in series))
    paint = paints(names, roles)
    for ax, (title, series), ylabel in zip(axes, panels.items(), ylabels, strict=True):
        for name, (x, y) in series.items():
            low, middle, high = np.nanpercentile(y.numpy(force=True), (25, 50, 75), axis=1)
            ax.fill_between(x, low, high, color=paint[name], alpha=0.18, lw=0)
            ax.plot(x, middle, color=paint[name], lw=1.8, label=name)
        for k, (label, level) in enumerate(((lines or {}).get(title) or {}).items()):
            ax.axhline(level, color=INK, lw=1.2, ls=((0, (4, 2)), (0, (1, 1.5)))[k % 2], label=label)
        if between and title in between:
            ax.set_ylim(*between[title])
        ax.set(title=title, xlabel=xlabel, ylabel=ylabel)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.24), fontsize=8)  # below: it would lie on curves
    return figure


def by_steps(panels: Mapping[str, Mapping[int, Tensor]], *, size: tuple[float, float] | None = None) -> Figure:
    """A panel per measure over the decoding steps K: a dot for every clip or round (n,), medians joined."""
    figure, axes = canvas(1, len(panels), size=size or (2.9 * len(panels), 2.7))
    for ax, (measure, found) in zip(axes, panels.items(), strict=True):
        places = range(len(found))
        for at, x in zip(places, found.values(), strict=True):
            ax.scatter([at] * len(x), x.numpy(force=True), s=13, color=colour("ours"), alpha=0.6, lw=0)
        ax.plot(places, [np.median(x.numpy(force=True)) for x in found.values()], color=colour("ours"), lw=1.8)
        ax.set_xticks(places, [str(k) for k in found])
        ax.set(xlabel="decoding steps K", ylabel=measure)
    return figure


def last_poses(motions: Mapping[str, Motion], roles: Mapping[str, str], *, columns: int = 4) -> np.ndarray:
    """The last pose of one clip in every motion, seen from one side, all pelves over one spot: (H, W, 3) uint8."""
    first = next(iter(motions.values()))
    where = first.root[-1, :2]
    shown = {}
    for label, motion in motions.items():
        end = motion.cut(-1)
        shift = torch.cat((where - end.root[0, :2], end.root.new_zeros(1)))
        shown[label] = replace(end, root=end.root + shift, contacts=None)
    labels = list(shown)
    nothing, nowhere = torch.zeros(22, 3), torch.zeros(22, dtype=torch.bool)
    rows = []
    for at in range(0, len(labels), columns):
        part = {label: shown[label] for label in labels[at : at + columns]}
        for k in range(columns - len(part)):  # an empty place keeps the size of a row
            part[" " * (k + 1)] = None
        rows.append(movie.pose_row(part, nothing, nowhere, roles, width=230, height=290))
    return movie.stack_pictures(rows)


def placed(motion: Motion, like: Motion) -> Motion:
    """A clip moved on the floor so that its first root stands where the other's does: for panels that compare poses."""
    shift = (like.root[:1] - motion.root[:1]) * motion.root.new_tensor([1.0, 1.0, 0.0])
    return replace(motion, root=motion.root + shift)
