"""The scoreboard's picture: how far every finding that decides lies from its bound."""

import math
from collections.abc import Mapping, Sequence
from textwrap import shorten
from typing import NamedTuple

from matplotlib.figure import Figure

from motionlab.viz.palette import INK, LINE, TILE, colour
from studies.shared.plots import canvas
from suite.findings import Criterion, Finding

FAR = 300.0  # half widths; what lies further, or has no interval, is drawn there
LONG = 64  # letters of a claim


class Dot(NamedTuple):
    """A finding: halves of its interval on the good side of its bound, whether it is of recordings, and judged."""

    margin: float
    real: bool
    judged: bool


def margin(test: Criterion, finding: Finding) -> float:
    """How far a value lies on the good side of its bound, in halves of its interval, at most ``FAR``; NaN: no value."""
    way = min(finding.value - test.ends[0], test.ends[1] - finding.value)  # from the nearer end
    half = (finding.high - finding.low) / 2
    if not math.isfinite(way):
        return math.nan
    far = way / half if half > 0 else (FAR if way >= 0 else -FAR)
    return max(-FAR, min(FAR, far))


def forest(groups: Mapping[str, Mapping[str, Sequence[Dot]]]) -> Figure:
    """Draws a line per claim and a dot per finding, an empty one where it cannot be judged; verdict -> claim -> dots.

    Right of the band it holds, left of it it does not; where nothing was measured (NaN) there is no dot. The band is
    drawn to scale, what lies beyond it on a logarithmic axis.
    """
    heads = {verdict: verdict.split(":")[0].removesuffix(" ...") for verdict in groups}
    lines = [(name, dots) for v, rows in groups.items() for name, dots in [(heads[v], None), *rows.items()]]
    figure, (axis,) = canvas(size=(11.0, 0.24 * len(lines) + 1.2))
    axis.axvspan(-1, 1, color=TILE, zorder=0)
    axis.axvline(0, color=LINE, linewidth=1)
    for line, (_, dots) in enumerate(lines):
        axis.axhline(line + 0.5, color=TILE, linewidth=0.6, zorder=0)
        for real, shift in ((False, -0.17), (True, 0.17)):
            tone = colour("real" if real else "synthetic")
            some = sorted((d for d in dots or () if d.real == real and math.isfinite(d.margin)), key=lambda d: d.judged)
            faces = [tone if dot.judged else "white" for dot in some]
            at = [dot.margin for dot in some], [line + shift] * len(some)
            axis.scatter(*at, s=22, clip_on=False, edgecolors=[tone], facecolors=faces)
    for real, label in ((False, "synthetic"), (True, "recordings")):
        axis.scatter([], [], s=22, color=[colour("real" if real else "synthetic")], label=label)
    axis.scatter([], [], s=22, edgecolors=[INK], facecolors="white", label="cannot be judged")
    axis.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    axis.set_yticks(range(len(lines)), [shorten(name, LONG, placeholder=" ...") for name, _ in lines], fontsize=8)
    for label, (_, dots) in zip(axis.get_yticklabels(), lines, strict=True):
        label.set_fontweight("normal" if dots else "bold")
    axis.set_xscale("symlog", linthresh=1.0)
    axis.set(xlim=(-1.2 * FAR, 1.2 * FAR), ylim=(len(lines) - 0.5, -0.5))
    axis.set_xticks([-100, -10, -1, 0, 1, 10, 100], ["-100", "-10", "-1", "0", "1", "10", "100"])
    far = "distance from the bound, in halves of the 95 % interval"
    axis.set_xlabel(f"{far}\nleft: does not hold; grey: open; right: holds")
    axis.grid(visible=False)
    return figure
