"""The figures of notebook 12."""

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
import torch
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.bench import energy_score
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from motionlab.viz.palette import INK, LINE, colour
from studies.nb12_filling_in.flaws import step_changes
from studies.shared.fill_contenders import GAUSSIAN, GUIDED, NEAREST, P, R, T
from studies.shared.plots import canvas, over_time

#: A colour for everybody, the same in all figures and films of the notebook.
ROLES = {
    "truth": "truth", "curves": "baseline", "slerp": "baseline", "Gaussian": "quaternion", GAUSSIAN: "quaternion",
    "nearest": "6d", NEAREST: "6d", R: "ours", T: "stage2", P: "axis-angle", GUIDED: "axis-angle",
    "P, not written back": "stage3", "best cut": "baseline",
}  # fmt: skip
COLUMNS = ("slerp", "curves", "nearest", "filter", "Gaussian", R, T, P, GUIDED)
DRAWN = ("curves", "Gaussian", NEAREST, GAUSSIAN, R, T, P, GUIDED)
_BONES = [(j, parent) for j, parent in enumerate(STANDARD.parents) if parent >= 0]


def heat(errors: Mapping, scores: Mapping, spread: Mapping) -> Figure:
    """Left: error by case and contender, over the best rival's; right: energy scores, with spread over error."""
    several = [case for case in scores if T in scores[case] and GAUSSIAN in scores[case]]
    fig, axes = canvas(1, 2, size=(15.5, 5.4))
    axes[0].get_gridspec().set_width_ratios([len(COLUMNS), len(DRAWN)])
    _cells(axes[0], errors, list(errors), COLUMNS, {})
    _cells(axes[1], scores, several, DRAWN, spread)
    axes[0].set_title("error of one answer: cm; colour: over the best rival's", fontsize=10)
    axes[1].set_title("energy score: cm (spread / error of draws)", fontsize=10)
    return fig


def spoken(errors: Mapping, scores: Mapping) -> str:
    """What hidden legs cost, in words; of one case."""
    asked = (errors, (R, "Gaussian")), (scores, (T, R, GAUSSIAN, P, GUIDED))
    one, drawn = (", ".join(f"{n} {some[n][0]:.1f}" for n in names) for some, names in asked)
    return f"Hidden legs, cm. Error of one answer: {one}. Energy score: {drawn}."


def _cells(ax, table: Mapping, cases: Sequence[str], names: Sequence[str], spread: Mapping) -> None:
    ratio = np.array([[np.log2(table[c][n][1]) if n in table[c] else np.nan for n in names] for c in cases])
    ax.imshow(ratio, cmap="RdBu_r", norm=TwoSlopeNorm(0.0, -1.2, 1.6), aspect="auto")
    for (row, case), (column, name) in product(enumerate(cases), enumerate(names)):
        if name in table[case]:
            cm, over = table[case][name]
            best, dark = abs(over - 1) < 1e-9, abs(np.log2(over)) > 1.05
            more = f"\n({spread[case, name]:.2f})" if (case, name) in spread else ""
            look = {"color": "white" if dark else INK, "weight": "bold" if best else None, "fontsize": 8.5}
            ax.text(column, row, f"{cm:.1f}{'*' if best else ''}{more}", ha="center", va="center", **look)
    ax.set_xticks(range(len(names)), [n.replace(", ", ",\n") for n in names], fontsize=8.5)
    ax.set_yticks(range(len(cases)), cases, fontsize=8.5)
    ax.xaxis.tick_top()
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)


def one_pose(draws: Mapping[str, Sequence[Motion]], truth: Motion, known: Tensor, joints, frame: int) -> Figure:
    """One frame of one window from the side, once for everybody: the true pose and all draws of it, with their mean
    error, how far they are apart, and the energy score of that frame's window."""
    fig, axes = canvas(1, len(draws), size=(2.7 * len(draws), 3.3), sharey=True)
    here = truth.positions[0, frame]
    left = here[STANDARD.index("left_hip")] - here[STANDARD.index("right_hip")]
    ahead = torch.stack((left[1], -left[0])) / left[:2].norm()

    def side(motion: Motion) -> np.ndarray:
        p = motion.positions[0, frame]
        return torch.stack(((p[:, :2] - here[0, :2]) @ ahead, p[:, 2]), -1).numpy()

    for ax, (name, some) in zip(axes, draws.items(), strict=True):
        for motion, tint, width in [*((m, colour(ROLES[name]), 1.1) for m in some), (truth, colour("truth"), 2.2)]:
            p = side(motion)
            for a, b in _BONES:
                ax.plot(p[[a, b], 0], p[[a, b], 1], color=tint, lw=width)
        score = float(energy_score(some, truth, known, joints))
        error = sum(float(energy_score([m], truth, known, joints)) for m in some) / len(some)
        ax.set_title(f"{name}\nerror {error:.1f}, apart {2 * (error - score):.1f}\nscore {score:.1f} cm", fontsize=9)
        ax.set_aspect("equal")
        ax.axhline(0, color=LINE, lw=1)
        ax.grid(visible=False)
        ax.set_xticks([])
    axes[0].set_ylabel("height (m)")
    return fig


def changes(made: Mapping[str, Motion], known: Tensor, level: float) -> Figure:
    """The change of velocity at every step of windows with a gap (shaded): medians and quartiles; dotted: a large
    natural one."""
    steps = {name: step_changes(motion.positions, 30.0) for name, motion in made.items()}
    how = {"fps": 30, "roles": ROLES, "size": (8.5, 3.2), "hidden": {"": ~known}, "log_from": 0.01}
    fig = over_time({"": steps}, ylabel="change of velocity (m/s)", **how)
    fig.axes[0].axhline(level, color=INK, lw=1.2, ls=":")
    return fig
