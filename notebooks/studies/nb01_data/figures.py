"""The figures of notebook 01: what windows of motion look like, source by source, person by person, kind by kind."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.corpus import Take
from motionlab.viz.palette import INK, PAPER, ROLE
from studies.nb01_data.sources_compared import DESCRIPTION_UNITS, Windows
from studies.shared.plots import canvas

_PARTS = {"train": "observation", "val": "baseline", "test": "ours"}


def descriptions(found: Mapping[str, Windows], clip: Tensor, name: str) -> Figure:
    """Draws the twelve descriptions of windows by source, and where a clip (12,) lies as a line.

    Thick: quartiles; thin: 5th to 95th percentile; dot: median.
    """
    fig, axes = canvas(3, 4, size=(13.0, 1.8 + 0.85 * len(found)), sharey=True)
    for k, (ax, (what, unit)) in enumerate(zip(axes, DESCRIPTION_UNITS.items(), strict=True)):
        for row, (source, some) in enumerate(found.items()):
            paint = ROLE["synthetic" if source.startswith("synthetic") else "real"]
            low, first, middle, third, high = np.quantile(some.table[:, k], [0.05, 0.25, 0.5, 0.75, 0.95])
            ax.plot([low, high], [row, row], color=paint, lw=1.5)
            ax.plot([first, third], [row, row], color=paint, lw=9, solid_capstyle="butt")
            ax.plot(middle, row, "o", ms=5, color=PAPER)
        ax.axvline(float(clip[k]), color=ROLE["ours"], lw=2.5, label=name)
        ax.set(xlabel=f"{what}, {unit}", ylim=(len(found) - 0.4, -0.6))
        ax.set_yticks(range(len(found)), list(found))
        ax.set_xlim(left=0)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", frameon=False)
    return fig


def people(rows: Mapping[str, Tensor], halves: Sequence[float], crowds: Mapping[str, float]) -> Figure:
    """Draws how far each person is from the other people and from synthetic motion, and the same of crowds.

    rows: source -> squared distances (P, 2): from the other people, from the source. halves: of random halves of the
    people from each other; crowds: of other sources from all of them.
    """
    fig, (left, right) = canvas(1, 2, size=(11.0, 4.4))
    paint = dict(zip(rows, (ROLE["synthetic"], ROLE["baseline"]), strict=False))
    most = 1.05 * max(float(r.max()) for r in rows.values())
    left.plot([0, most], [0, most], color=INK, lw=1)
    left.text(0.74 * most, 0.66 * most, "equally far", ha="left", va="top")
    for name, row in rows.items():
        left.plot(row[:, 0], row[:, 1], "o", ms=5, alpha=0.75, color=paint[name], label=name)
    left.set(xlabel="squared distance of a person from the other people", ylabel="from the source", xlim=(0, most))
    left.set(ylim=(0, most), title=f"one person at a time, n = {len(next(iter(rows.values())))}")
    left.legend(loc="upper left", frameon=False)
    right.hist(halves, bins=24, color=ROLE["real"], label="one half of the people from the other")
    for name, far in crowds.items():
        look = {"color": ROLE["synthetic"]} if name == "synthetic" else {"color": ROLE["real"], "ls": "--"}
        right.axvline(far, lw=3, label=f"{name} from all people", **look)
    right.set(xlabel="energy distance", ylabel="random splits of the people", title="crowds", xlim=(0, None))
    right.set_ylim(top=1.5 * right.get_ylim()[1])
    right.legend(loc="upper left", frameon=False)
    return fig


def gaps(by_kind: Mapping[str, Tensor]) -> Figure:
    """Draws by how many deviations synthetic motion differs in each description (12,), a row for each kind."""
    fig, (ax,) = canvas(1, 1, size=(11.5, 1.6 + 0.42 * len(by_kind)))
    table = np.stack([np.asarray(row) for row in by_kind.values()])
    image = ax.imshow(table, cmap="PuOr_r", vmin=-2, vmax=2, aspect="auto")
    for (row, column), value in np.ndenumerate(table):
        ax.text(column, row, f"{value:+.1f}", ha="center", va="center", color="white" if abs(value) > 1.1 else INK)
    ax.set_xticks(range(len(DESCRIPTION_UNITS)), list(DESCRIPTION_UNITS), rotation=30, ha="right")
    ax.set_yticks(range(len(by_kind)), list(by_kind))
    ax.grid(False)
    fig.colorbar(image, ax=ax, label="synthetic minus recorded, SD", extend="both")
    return fig


def kinds(by_kind: Mapping[str, Sequence[Take]]) -> Figure:
    """Draws the minutes of each kind of motion in a corpus, stacked by part."""
    fig, (ax,) = canvas(1, 1, size=(8.5, 0.9 + 0.32 * len(by_kind)))
    left = np.zeros(len(by_kind))
    for part, role in _PARTS.items():
        minutes = [sum(t.motion.seconds for t in takes if t.part == part) / 60 for takes in by_kind.values()]
        ax.barh(range(len(by_kind)), minutes, left=left, color=ROLE[role], height=0.65, label=part, lw=0)
        left += np.array(minutes)
    ax.set_yticks(range(len(by_kind)), list(by_kind))
    ax.invert_yaxis()
    ax.set(xlabel="minutes", xlim=(0, None))
    ax.legend(loc="lower right", frameon=False)
    return fig
