"""The figures of notebook 02: one gap, distance from the cut, gaps, flips, consistency."""

from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from motionlab import rotation
from motionlab.motion import FPS
from motionlab.viz.palette import INK, LINE, ROLE
from studies.nb02_rotations import representations as rep
from studies.nb02_rotations.representations import Representation
from studies.nb02_rotations.trials import ARMS, Consistency, Gaps
from studies.shared.plots import canvas

#: Which colour a representation has.
ROLE_OF = {
    "axis-angle": "axis-angle", "axis-angle, unrolled": "baseline", "axis-angle, nearest vector": "baseline",
    "quaternion, w ≥ 0": "quaternion", "6D, lengths free": "observation", "6D": "6d",
}  # fmt: skip
_DASHES = {"x": "-", "y": "--", "z": ":"}


def one_gap(truth: Tensor, thetas: Mapping[Representation, Tensor], gap: int) -> Figure:
    """Draws how far the body has turned, true (T, 3, 3) and filled (T, P), and the axis-angle vector that did it."""
    fig, axes = canvas(1, 2, size=(11.0, 3.6))
    time = np.arange(len(truth)) / FPS
    paths = {"truth": truth} | {how.name: how.decode(theta) for how, theta in thetas.items()}
    for label, path in paths.items():
        steps = torch.rad2deg(rotation.geodesic(path[:-1], path[1:])).cumsum(0).numpy()
        paint, dash = ROLE[ROLE_OF.get(label, label)], {"truth": (0, (4, 2))}.get(label, "-")
        axes[0].plot(time, [0, *steps], lw=2.2, color=paint, ls=dash, label=label, zorder=3 if label == "truth" else 2)
    vectors = {"true vector": rotation.matrix_to_axis_angle(truth), "axis-angle": thetas[rep.AXIS_ANGLE]}
    for (label, vector), role in zip(vectors.items(), ("truth", "axis-angle"), strict=True):
        for i, part in enumerate("xyz"):
            name = f"{label}, {part}"
            axes[1].plot(time, vector[:, i], ls=_DASHES[part], lw=1.6, color=ROLE[role], label=name)
    axes[0].set(xlabel="time, s", ylabel="degrees turned so far")
    axes[1].set(xlabel="time, s", ylabel="rotation vector, rad")
    first = (len(truth) - gap) // 2 - 0.5
    for ax, columns in zip(axes, (3, 2), strict=True):
        ax.axvspan(first / FPS, (first + gap) / FPS, color=LINE, alpha=0.35, lw=0)
        ax.text((first + gap / 2) / FPS, 1.01, "hidden", transform=ax.get_xaxis_transform(), ha="center", fontsize=9)
        ax.legend(ncol=columns, loc="upper center", bbox_to_anchor=(0.5, -0.17), frameon=False)
    return fig


def from_the_cut(degrees: Mapping[str, Tensor]) -> Figure:
    """Draws the share of frames within some degrees of the branch cut, one curve per source; (N,) degrees."""
    fig, (ax,) = canvas(1, 1, size=(8.5, 3.4))
    away = np.linspace(0, 60, 241)
    for source, values in degrees.items():
        share = np.searchsorted(np.sort(values.numpy()), away, side="right") / len(values)
        role = "synthetic" if source == "synthetic" else "real"
        ax.plot(away, 100 * share, lw=2.2, color=ROLE[role], label=f"{source}, n = {len(values):,} frames")
    ax.axvline(0, color=ROLE["axis-angle"], lw=4)
    ax.text(0.9, 4, "the cut", color=ROLE["axis-angle"], fontsize=10, fontweight="bold")
    ax.set(xlabel="degrees from the cut", ylabel="frames at most so far, %", xlim=(-0.5, 60), ylim=(0, 102))
    ax.legend(loc="center right", frameon=False)
    return fig


def excess(gaps: Mapping[str, Gaps], filled: Mapping[tuple[str, str], Tensor]) -> Figure:
    """Draws the excess rotation of every filled gap by representation; gaps across the cut on the left."""
    names = list(dict.fromkeys(name for _, name in filled))
    fig, axes = canvas(1, 2, size=(11.5, 3.5), sharex=True, sharey=True)
    for ax, across, title in zip(axes, (True, False), ("gaps across the cut", "all other gaps"), strict=True):
        count = sum(int((g.crossing == across).sum()) for g in gaps.values())
        jitter = np.random.default_rng(0).uniform(-0.28, 0.28, count)
        for row, name in enumerate(names):
            found = [rep.excess_rotation(filled[s, name], g.gap)[g.crossing == across] for s, g in gaps.items()]
            ax.scatter(torch.cat(found), row + jitter, s=9, alpha=0.35, lw=0, color=ROLE[ROLE_OF[name]])
        ax.axvspan(180, 400, color=ROLE["axis-angle"], alpha=0.06, lw=0)
        ax.axvline(360, color=INK, lw=0.8, ls=":")
        ax.set(xlabel="degrees beyond the shortest way (one dot: one gap)", xlim=(-15, 400))
        ax.set_title(f"{title}, n = {count:,}", pad=16, loc="left")
        for at, words in ((180, "the long way"), (360, "full circle")):
            ax.text(at, 1.01, words, transform=ax.get_xaxis_transform(), ha="center", fontsize=8)
        ax.set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    return fig


def carried_and_decoded(root: Tensor) -> Figure:
    """Draws the two vectors of one root (T, 3, 3), and how far their midpoint is off, over the 12 s in which they
    change sides most often."""
    mask, length = rep.flipped(*rep.carried_and_decoded(root)), min(round(12 * FPS), len(root))
    start = int((mask[1:] != mask[:-1]).float().unfold(0, length - 1, 1).sum(-1).argmax())
    root = root[start : start + length]
    carried, decoded = rep.carried_and_decoded(root)
    time = torch.arange(len(root)) / FPS
    fig, axes = canvas(2, 1, size=(11.0, 5.0), sharex=True)
    for name, vector, role in (("carried", carried, "ours"), ("decoded", decoded, "axis-angle")):
        for i, part in enumerate("xyz"):
            style = {"lw": 1.6, "ls": _DASHES[part], "color": ROLE[role]}
            axes[0].plot(time, vector[:, i], label=f"{name} {part}", **style)
    axes[0].set_ylabel("rotation vector, rad")
    axes[0].legend(ncol=6, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    off = rep.off_by(rep.AXIS_ANGLE, (carried + decoded) / 2, root)
    axes[1].fill_between(time, off, color=ROLE["axis-angle"], alpha=0.7, lw=0)
    axes[1].set(xlabel="time, s", ylabel="their average\nis off by, degrees", ylim=(0, 190), yticks=(0, 90, 180))
    return fig


def consistency(outcome: Mapping[str, Consistency]) -> Figure:
    """Draws the worst error of every clip after the consistency fit, sorted, per arm and kind of clip."""
    fig, axes = canvas(1, 2, size=(11.0, 3.8), sharey=True)
    for ax, flipped, title in zip(axes, (True, False), ("clips with a flip", "all other clips"), strict=True):
        count = sum(int((o.flipped == flipped).sum()) for o in outcome.values())
        share = torch.linspace(0, 100, max(count, 1))[:count]
        for name in ARMS:
            values = torch.cat([o.worst_deg[name][o.flipped == flipped] for o in outcome.values()]).sort().values
            dash = {"axis-angle, nearest vector": (0, (4, 2))}.get(name, "-")
            ax.plot(share, values, lw=2.2, color=ROLE[ROLE_OF[name]], ls=dash, label=name)
        ax.set(xlabel="clips, sorted, %", yscale="log", ylim=(1, 220))
        ax.set_title(f"{title}, n = {count:,}", loc="left")
        ax.set_yticks([1, 3, 10, 30, 90, 180], ["1", "3", "10", "30", "90", "180"])
        ax.minorticks_off()
        ax.axhline(30, color=ROLE["truth"], lw=0.8, ls=":")
        ax.text(50, 28, "above: ruined", fontsize=8, ha="center", va="top")
    axes[0].set_ylabel("worst frame off by, degrees")
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncol=3, frameon=False)
    return fig
