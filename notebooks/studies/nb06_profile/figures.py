"""Where time goes: parts of a closure, phases of a program, shares against a claim, a ladder of savings."""

from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.viz.palette import INK, LINE, blend, colour
from studies.nb06_profile.official_profile import LABEL
from studies.shared.plots import canvas

#: Colours of the forms of a closure, and of the official code itself.
FORMS = {"faithful": "baseline", "lean": "ours", LABEL: "truth"}
#: Parts of a closure, in the order in which they happen: the chain's family, the body's, and what goes backwards.
_CHAIN, _BODY = colour("quaternion"), colour("observation")
_PARTS = {
    "first state": blend(_CHAIN, "white", 0.45), "chain": _CHAIN, "roll-out function": _CHAIN, "body": _BODY,
    "terms": blend(_BODY, "white", 0.5), "body and energies": _BODY, "backward": blend(INK, "white", 0.15),
}  # fmt: skip


def _stack(ax: Axes, table: Mapping[str, Mapping[str, float]], digits: int) -> float:
    """Bars of parts, one row after the other, each with its sum; the longest sum."""
    left = np.zeros(len(table))
    for part in (part for part in _PARTS if any(part in row for row in table.values())):
        width = np.array([row.get(part, 0.0) for row in table.values()])
        ax.barh(range(len(table)), width, 0.72, left, color=_PARTS[part], label=part)
        left += width
    for row, total in enumerate(left):
        ax.annotate(f" {total:,.{digits}f}", (total, row), va="center", fontsize=9, color=INK)
    ax.set_yticks(range(len(table)), list(table))
    ax.set_ylim(len(table) - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    return left.max()


def bars(seconds: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draws closures as bars on one axis, in milliseconds, stacked by part: label -> part -> seconds."""
    figure, (ax,) = canvas(size=(9.0, 1.1 + 0.36 * len(seconds)))
    table = {label: {part: 1e3 * x for part, x in row.items()} for label, row in seconds.items()}
    ax.set_xlim(0, 1.12 * _stack(ax, table, 0))
    ax.set_xlabel("processor time of one closure (ms)")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def phases(minutes: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Figure:
    """Draws minutes of each phase, stacked by part; one panel per program, all on one axis.

    minutes: program -> phase -> part -> minutes. The sum of a program is in its title.
    """
    figure, axes = canvas(1, len(minutes), size=(10.5, 3.2), sharex=True, sharey=True)
    longest = 0.0
    for ax, (program, table) in zip(axes, minutes.items(), strict=True):
        longest = max(longest, _stack(ax, dict(enumerate(table.values())), 1))
        ax.set_title(f"{program}:\n{sum(sum(row.values()) for row in table.values()):.1f} min in all")
        ax.set_xlabel("minutes")
    names = list(next(iter(minutes.values())))
    axes[0].set_yticks(range(len(names)), names)
    axes[0].set_xlim(0, 1.2 * longest)
    axes[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def shares(
    claimed: Mapping[str, float], least: Mapping[str, float],
    measured: Mapping[str, Mapping[str, tuple[float, float, float]]],
) -> Figure:  # fmt: skip
    """Draws shares in %: what is claimed with its band of 10 points, and what was measured.

    claimed: share -> the thesis's %. least: share -> the least that its conclusion asks for. measured: label -> share
    -> (value, low, high).
    """
    figure, (ax,) = canvas(size=(9.0, 3.0))
    rows = [*claimed, *least]
    for row, name in enumerate(rows):
        low, high = (claimed[name] - 10, claimed[name] + 10) if name in claimed else (least[name], 100.0)
        ax.fill_betweenx([row - 0.42, row + 0.42], low, min(high, 100), color=LINE, alpha=0.45, lw=0,
                         label=None if row else "our bounds")  # fmt: skip
        if name in claimed:
            ax.plot([claimed[name]] * 2, [row - 0.42, row + 0.42], color=INK, lw=2, label=None if row else "thesis")
    for k, (label, found) in enumerate(measured.items()):
        height, first = 0.56 * ((k + 0.5) / len(measured) - 0.5), next(iter(found))
        for row, name in enumerate(rows):
            if name in found:
                value, low, high = found[name]
                style = {"color": colour(FORMS[label.split(",")[0] if label not in FORMS else label]), "ms": 7}
                style |= {"capsize": 3, "label": label if name == first else None}
                ax.errorbar(value, row + height, xerr=[[value - low], [high - value]], fmt="o", **style)
    ax.set_yticks(range(len(rows)), rows)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(0, 100)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("share of the program's time (%); last row: share of one closure of stage 3")
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    return figure


def ladder(seconds: Mapping[str, Tensor]) -> Figure:
    """Draws milliseconds of a closure on each rung, median and quartiles, with the gain over the rung above and over
    the first."""
    figure, (ax,) = canvas(size=(8.0, 0.9 + 0.36 * len(seconds)))
    first = before = None
    for row, values in enumerate(seconds.values()):
        low, middle, high = (1e3 * values).double().quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist()
        first = first or middle
        tone = blend(colour("baseline"), colour("ours"), row / max(len(seconds) - 1, 1))
        ax.barh(row, middle, 0.72, color=tone)
        ends = {"xerr": [[middle - low], [high - middle]], "ecolor": INK, "elinewidth": 1.2, "capsize": 3}
        ax.errorbar(middle, row, fmt="none", **ends)
        gain = "" if before is None else f"   x {before / middle:.2f}   (in all x {first / middle:.1f})"
        beside = {"textcoords": "offset points", "va": "center", "fontsize": 9, "color": INK}
        ax.annotate(f"{middle:.0f} ms{gain}", (high, row), (6, 0), **beside)
        before = middle
    ax.set_yticks(range(len(seconds)), list(seconds))
    ax.invert_yaxis()
    ax.set_xlim(0, 1.4 * first)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("processor time of one closure (ms)")
    return figure
