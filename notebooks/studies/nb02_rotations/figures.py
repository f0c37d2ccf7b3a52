"""The figures of notebook 02: parameters along a turn, distance from the cut, gaps, flips, consistency."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from motionlab import rotation
from motionlab.skeleton import UPRIGHT
from motionlab.viz.palette import ROLE
from studies.nb02_rotations import representations as rep
from studies.nb02_rotations.representations import Representation
from studies.nb02_rotations.trials import FPS, Consistency
from studies.shared.plots import canvas, paints

#: Which colour a representation has.
ROLE_OF = {
    "axis-angle": "axis-angle",
    "axis-angle, unrolled": "baseline",
    "quaternion": "quaternion",
    "6D, lengths free": "observation",
    "6D": "6d",
}


def leaning_turn(turns: float, frames: int) -> Tensor:
    """A body (frames, 3, 3) that turns about the vertical while it leans 15 degrees to its left and back."""
    angle = torch.linspace(0, 2 * math.pi * turns, frames, dtype=torch.float64)
    lean = rotation.rotation_about("z", math.radians(15) * (0.5 * angle).sin())
    return rotation.rotation_about("z", angle) @ UPRIGHT.double() @ lean


def components(path: Tensor, choices: Sequence[Representation]) -> Figure:
    """Every parameter of a path (T, 3, 3) over the turned angle, one panel per representation."""
    fig, axes = canvas(1, len(choices), size=(12.5, 2.9))
    degrees = torch.rad2deg(rotation.geodesic(path[:-1], path[1:]).cumsum(0))
    for ax, r in zip(axes, choices, strict=True):
        theta = r.encode(path).numpy()[1:]
        for i, column in enumerate(theta.T):
            ax.plot(degrees, column, lw=1.4, color=ROLE[ROLE_OF.get(r.name, "baseline")], alpha=1 - 0.12 * i)
        ax.set(title=r.name, xlabel="degrees turned")
    axes[0].set_ylabel("parameters (rad, or unitless)")
    return fig


def angles_from_the_cut(angles: Mapping[str, Tensor]) -> Figure:
    """Share of frames within some degrees of the branch cut, one curve per source; (N,) angles in degrees."""
    fig, (ax,) = canvas(1, 1, size=(8.5, 3.2))
    away = np.linspace(0, 60, 241)
    for (source, values), paint in zip(angles.items(), paints(list(angles), {}).values(), strict=True):
        share = np.searchsorted(np.sort(180 - values.numpy()), away, side="right") / len(values)
        ax.plot(away, 100 * share, lw=2.4 if source == "synthetic" else 1.5, color=paint, label=source)
    ax.axvline(0, color=ROLE["axis-angle"], lw=3)
    ax.set(xlabel="degrees from the branch cut", ylabel="% of frames at most so far", xlim=(-0.5, 60), ylim=(0, 102))
    ax.legend(loc="lower right", ncol=2)
    return fig


def excess(found: Mapping[tuple[str, str], Tensor], crossing: Mapping[str, Tensor]) -> Figure:
    """Excess rotation of every filled gap, by representation; gaps across the cut on the left."""
    names = list(dict.fromkeys(name for _, name in found))
    fig, axes = canvas(1, 2, size=(12.0, 3.2))
    for ax, across, title in zip(axes, (True, False), ("gaps across the cut", "all other gaps"), strict=True):
        count = 0
        for row, name in enumerate(names):
            values = torch.cat([v[crossing[s] == across] for (s, n), v in found.items() if n == name])
            count = len(values)
            jitter = np.random.default_rng(0).uniform(-0.28, 0.28, count)
            ax.scatter(values, row + jitter, s=9, alpha=0.35, lw=0, color=ROLE[ROLE_OF.get(name, "baseline")])
        ax.axvline(180, color=ROLE["truth"], lw=0.8, ls=":")
        ax.axvline(360, color=ROLE["truth"], lw=0.8, ls=":")
        ax.set(title=f"{title}, n = {count}", xlabel="rotation beyond the shortest way, degrees", xlim=(-15, 400))
        ax.set_yticks(range(len(names)), names)
        ax.invert_yaxis()
    return fig


def carried_and_decoded(root: Tensor, seconds: float = 20.0) -> Figure:
    """The two vectors of one root (T, 3, 3) over time, and how far their midpoint is off."""
    root = root[: round(seconds * FPS)]
    carried, decoded = rep.carried_and_decoded(root)
    time = torch.arange(len(root)) / FPS
    fig, axes = canvas(2, 1, size=(11.0, 4.4), sharex=True)
    for i, name in enumerate("xyz"):
        tone = 1 - 0.28 * i
        axes[0].plot(time, carried[:, i], lw=1.6, color=ROLE["ours"], alpha=tone, label=f"carried {name}")
        axes[0].plot(time, decoded[:, i], lw=1.6, ls=":", color=ROLE["axis-angle"], alpha=tone, label=f"decoded {name}")
    axes[0].set_ylabel("rotation vector, rad")
    axes[0].legend(ncol=3, fontsize=8, loc="upper right")
    off = rep.midpoint_error(rep.AXIS_ANGLE, carried, decoded, root)
    axes[1].fill_between(time, off, color=ROLE["axis-angle"], alpha=0.7, lw=0)
    axes[1].set(xlabel="time, s", ylabel="midpoint off by, degrees", ylim=(0, 190))
    return fig


def consistency(outcome: Mapping[str, Consistency]) -> Figure:
    """Worst error of every clip after the consistency fit, sorted, per representation and kind of clip."""
    fig, axes = canvas(1, 2, size=(11.0, 3.2), sharey=True)
    for ax, flipped, title in zip(axes, (True, False), ("clips with a flip", "all other clips"), strict=True):
        count = 0
        for name in ("axis-angle", "6D"):
            values = torch.cat([o.worst_deg[name][o.flipped == flipped] for o in outcome.values()]).sort().values
            count = len(values)
            share = torch.linspace(0, 100, max(count, 1))[:count]
            ax.plot(share, values.clamp_min(1e-3), lw=2, color=ROLE[ROLE_OF[name]], label=name)
        ax.set(title=f"{title}, n = {count}", xlabel="clips, sorted, %", yscale="log", ylim=(6e-4, 360))
        ax.axhline(30, color=ROLE["truth"], lw=0.8, ls=":")
    axes[0].set_ylabel("worst frame off by, degrees")
    axes[0].legend(loc="center left")
    return fig
