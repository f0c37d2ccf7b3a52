"""Where time and memory go: phases of a program, shares against a claim, how a cost grows, a ladder of savings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.viz.palette import INK, LINE, blend, colour
from studies.nb06_profile.scaling import PowerLaw
from studies.shared.plots import canvas, paints

#: Colours of the parts of a closure, in the order in which they happen.
_PARTS = {"first state": "stage2", "chain": "baseline", "body": "observation", "terms": "6d", "backward": "stage3"}
GIB = 2**30


def _middle(x: Tensor) -> tuple[float, float, float]:
    """Median, and how far the quartiles are below and above it."""
    low, median, high = x.double().quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist()
    return median, median - low, high - median


def phases(
    minutes: Mapping[str, Mapping[str, Mapping[str, float]]], *, size: tuple[float, float] = (9.0, 3.4)
) -> Figure:
    """Minutes of each phase, stacked by part; one panel per program: program -> phase -> part -> minutes.

    Every panel has an axis of its own: the sum is in its title.
    """
    figure, axes = canvas(1, len(minutes), size=size, sharey=True)
    known = {p for program in minutes.values() for phase in program.values() for p in phase}
    parts = [part for part in _PARTS if part in known]
    for ax, (program, table) in zip(axes, minutes.items(), strict=True):
        left = np.zeros(len(table))
        for part in parts:
            width = np.array([phase.get(part, 0.0) for phase in table.values()])
            ax.barh(range(len(table)), width, 0.72, left, color=colour(_PARTS[part]), label=part)
            left += width
        for row, total in enumerate(left):
            ax.annotate(f" {total:.1f}", (total, row), va="center", fontsize=9, color=INK)
        ax.set_yticks(range(len(table)), list(table))
        ax.set_xlim(0, 1.15 * left.max())
        ax.grid(visible=False, axis="y")
        ax.set_title(f"{program}: {left.sum():.1f} min")
        ax.set_xlabel("minutes")
    axes[0].invert_yaxis()
    axes[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def shares(
    claimed: Mapping[str, float],
    measured: Mapping[str, Mapping[str, Tensor]],
    *,
    size: tuple[float, float] = (7.0, 2.6),
) -> Figure:
    """Shares in %: what is claimed as a line with its band of 10 points, what was measured (label -> share -> (n,))."""
    figure, (ax,) = canvas(size=size)
    paint, rows = paints(list(measured), {"faithful": "baseline", "lean": "ours"}), list(claimed)
    for row, name in enumerate(rows):
        ax.fill_betweenx([row - 0.42, row + 0.42], claimed[name] - 10, claimed[name] + 10, color=LINE, alpha=0.45, lw=0)
        ax.plot([claimed[name]] * 2, [row - 0.42, row + 0.42], color=INK, lw=2, label="thesis" if not row else None)
    for k, (label, found) in enumerate(measured.items()):
        height = 0.4 * ((k + 0.5) / len(measured) - 0.5)
        for row, name in enumerate(rows):
            middle, below, above = _middle(found[name])
            style = {"color": paint[label], "ms": 7, "capsize": 3, "label": None if row else label}
            ax.errorbar(middle, row + height, xerr=[[below], [above]], fmt="o", **style)
    ax.set_yticks(range(len(rows)), rows)
    ax.invert_yaxis()
    ax.set_xlim(0, 100)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("share of the program's time (%)")
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    return figure


Measured = Mapping[str, tuple[Sequence[float], Tensor, PowerLaw]]


def _law(ax: Axes, label: str, paint: tuple, x: Sequence[float], y: Tensor, law: PowerLaw) -> None:
    grid = np.geomspace(min(x) / 1.2, 1.2 * max(x), 60)
    low, middle, high = law.at(grid).quantile(torch.tensor([0.025, 0.5, 0.975]).double(), dim=0)
    ax.fill_between(grid, low, high, color=paint, alpha=0.2, lw=0)
    ax.plot(grid, middle, color=paint, lw=1.6, label=f"{label}: exponent {law.text()}")
    for each, at in zip(y, x, strict=True):
        ax.plot([at] * len(each), each, "o", color=paint, ms=4, mec="white", mew=0.5)


def growth(
    panels: Mapping[str, Measured], ylabels: Sequence[str], *, size: tuple[float, float] = (10.5, 3.6)
) -> Figure:
    """Costs against their size, both logarithmic, each with the posterior of its power law (median, 95 % band).

    panels: label of the x axis -> series -> (x (k,), measurements (k, n), law).
    """
    figure, axes = canvas(1, len(panels), size=size)
    for ax, (xlabel, series), ylabel in zip(axes, panels.items(), ylabels, strict=True):
        paint = paints(list(series), {"faithful": "baseline", "lean": "ours"})
        for label, (x, y, law) in series.items():
            _law(ax, label, paint[label], x, y, law)
        ax.set(xscale="log", yscale="log", xlabel=xlabel.split("\n")[0], ylabel=ylabel)
        low, high = ax.get_ylim()
        ax.set_ylim(low, high * (high / low) ** 0.3)  # room for the legend
        places = sorted({float(at) for x, _, _ in series.values() for at in x})
        ax.set_xticks(places, [f"{at:g}" for at in places])
        ax.minorticks_off()
        ax.legend(loc="upper left", frameon=False)
    return figure


def memory(
    found: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    limit: float,
    *,
    claimed: float,
    size: tuple[float, float] = (7.0, 3.4),
) -> Figure:
    """Peak memory in GiB against clips in a batch, both logarithmic, and where straight lines reach a limit in GiB.

    found: series -> (clips, bytes). claimed: clips that are said to fit.
    """
    figure, (ax,) = canvas(size=size)
    paint = paints(list(found), {"faithful": "baseline", "lean": "ours"})
    for label, (clips, held) in found.items():
        y = np.asarray(held) / GIB
        slope, level = np.polyfit(clips, y, 1)
        x = np.geomspace(min(clips), (limit - level) / slope, 40)
        ax.plot(x, level + slope * x, color=paint[label], lw=1.4, ls="--")
        ax.plot(x[-1], limit, "|", color=paint[label], ms=14, mew=2)
        ax.annotate(f"{x[-1]:,.0f} clips", (x[-1], limit), (0, 10), textcoords="offset points", ha="center", fontsize=9)
        ax.plot(clips, y, "o", color=paint[label], ms=6, label=f"{label}: {1024 * slope:.0f} MiB a clip")
    ax.axhline(limit, color=INK, lw=1.2)
    ax.plot(claimed, limit, "v", color=INK, ms=8)
    ax.annotate("thesis", (claimed, limit), (0, 10), textcoords="offset points", ha="center", fontsize=9, color=INK)
    ax.set(xscale="log", yscale="log", xlabel="clips in the batch", ylabel="peak memory of a closure (GiB)")
    ax.set_ylim(top=3 * limit)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.legend(loc="lower right", frameon=False)
    return figure


def ladder(seconds: Mapping[str, Tensor], *, size: tuple[float, float] | None = None) -> Figure:
    """Milliseconds of a closure on each rung, median and quartiles, with the gain over the rung above and the first."""
    figure, (ax,) = canvas(size=size or (8.0, 0.9 + 0.36 * len(seconds)))
    first = before = None
    for row, values in enumerate(seconds.values()):
        middle, below, above = _middle(1e3 * values)
        first = first or middle
        tone = blend(colour("baseline"), colour("ours"), row / max(len(seconds) - 1, 1))
        ax.barh(row, middle, 0.72, color=tone)
        ax.errorbar(middle, row, xerr=[[below], [above]], fmt="none", ecolor=INK, elinewidth=1.2, capsize=3)
        gain = "" if before is None else f"   x {before / middle:.2f}   (in all x {first / middle:.1f})"
        ax.annotate(f"{middle:.0f} ms{gain}", (middle + above, row), (6, 0), textcoords="offset points", va="center",
                    fontsize=9, color=INK)  # fmt: skip
        before = middle
    ax.set_yticks(range(len(seconds)), list(seconds))
    ax.invert_yaxis()
    ax.set_xlim(0, 1.4 * first)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("processor time of one closure (ms)")
    return figure
