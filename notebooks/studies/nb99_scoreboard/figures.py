"""The scoreboard's picture: how far every finding that decides lies from its bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.figure import Figure

from motionlab.findings import Criterion, Finding
from motionlab.viz.palette import INK, LINE, TILE, colour
from studies.shared.plots import canvas

FAR = 10.0  # half widths; what lies further, or has no interval, is drawn there


class Dot(NamedTuple):
    """A finding: halves of its interval on the good side of its bound, and whether it is of recordings."""

    margin: float
    real: bool


def margin(test: Criterion, finding: Finding) -> float:
    """How far a value lies on the good side of its bound, in halves of its interval; at most ``FAR``."""
    way = finding.value - test.bound if test.relation == ">=" else test.bound - finding.value
    half = (finding.high - finding.low) / 2
    far = way / half if half > 0 else (FAR if way >= 0 else -FAR)
    return max(-FAR, min(FAR, far))


def forest(rows: Mapping[str, Sequence[Dot]]) -> Figure:
    """Draws a line per claim and a dot per finding: right of the band it holds, left of it it does not."""
    figure, (axis,) = canvas(size=(9.0, 0.24 * len(rows) + 1.2))
    axis.axvspan(-1, 1, color=TILE, zorder=0)
    axis.axvline(0, color=LINE, linewidth=1)
    for line, dots in enumerate(rows.values()):
        axis.axhline(line + 0.5, color=TILE, linewidth=0.6, zorder=0)
        for real, shift in ((False, -0.17), (True, 0.17)):
            some = [dot.margin for dot in dots if dot.real == real]
            shown = {"color": colour("real" if real else "synthetic"), "alpha": 0.85, "s": 22, "clip_on": False}
            axis.scatter(some, [line + shift] * len(some), label="recordings" if real else "synthetic", **shown)
    handles, labels = axis.get_legend_handles_labels()
    axis.legend(handles[:2], labels[:2], loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    axis.set_yticks(range(len(rows)), list(rows), fontsize=8, color=INK)
    axis.set(xlim=(-FAR - 0.4, FAR + 0.4), ylim=(len(rows) - 0.5, -0.5))
    axis.set_xlabel(
        "distance from the bound, in halves of the 95 % interval\nleft: does not hold; grey: open; right: holds"
    )
    axis.grid(visible=False)
    return figure
