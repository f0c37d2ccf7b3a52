"""The figures of notebook 13: quality over steps, cures of the seam, and what is predicted while it is denoised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from motionlab.viz import movie
from motionlab.viz.palette import INK, LINE, ROLE, colour
from studies.nb13_steps.samplers import Point, contributions
from studies.nb13_steps.seams import Line
from studies.nb13_steps.settling import Path
from studies.shared import plots
from studies.shared.plots import canvas, paints

_ENDS = {"left": ("o", "observation"), "pasted": ("s", "axis-angle"), "faded": ("D", "ours")}
_SURE = 1.96


def against_steps(points: Sequence[Point], data: Point, floor: Point) -> Figure:
    """A panel per measure over the number of steps: distance to held-out motion, acceleration, sliding.

    data: the held-out windows. floor: other real windows, measured as samples are: the dashed line. Bars: 95 %.
    """
    fig, axes = canvas(1, 3, size=(11.0, 3.4))
    names = list(dict.fromkeys(p.sampler for p in points))
    paint = paints(names, {"DDPM": "baseline", "whitened flow": "ours", "DDIM": "stage2"})
    measures = {
        "kernel distance to held-out motion": lambda p: contributions(p.features, data.features),
        "acceleration / the data's": lambda p: p.acceleration / data.acceleration.mean(),
        "frames with a sliding foot, %": lambda p: 100 * p.skate,
    }
    for ax, (title, measure) in zip(axes, measures.items(), strict=True):
        for k, name in enumerate(names):
            mine = sorted((p for p in points if p.sampler == name), key=lambda p: p.steps)
            mean, bar = zip(*(_mean(measure(p)) for p in mine), strict=True)
            at = [p.steps * 1.04 ** (k - (len(names) - 1) / 2) for p in mine]
            ax.errorbar(at, mean, bar, fmt="o-", ms=3.5, lw=1.5, elinewidth=0.9, color=paint[name], label=name)
        level, bar = _mean(measure(floor))
        ax.axhline(level, color=ROLE["truth"], lw=1.2, ls=(0, (4, 2)), label="other real motion")
        ax.axhspan(level - bar, level + bar, color=ROLE["truth"], alpha=0.08, lw=0)
        steps = sorted({p.steps for p in points})
        ax.set(xscale="log", xlabel="steps", title=title)
        ax.set_xticks(steps, [str(n) for n in steps])
        ax.minorticks_off()
    axes[0].set_yscale("symlog", linthresh=0.1)
    axes[0].yaxis.set_major_formatter("{x:g}")
    axes[1].set_ylim(bottom=0)
    axes[2].set_ylim(bottom=0)
    axes[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return fig


def _mean(x: Tensor) -> tuple[float, float]:
    return x.mean().item(), _SURE * x.std().item() / len(x) ** 0.5


def cures(lines: Sequence[Line]) -> Figure:
    """Every cure with its ends: the jump at the seam over what is natural, how far known frames are off, the gap."""
    names = list(dict.fromkeys(line.cure for line in lines))
    fig, axes = canvas(1, 3, size=(10.5, 0.9 + 0.36 * len(names)), sharey=True)
    panels = {
        "jump / natural": ("velocity jump at the seam\n/ natural changes, 95th percentile", 1.0),
        "known off": ("known frames off by, mm\n(worst joint)", 1000.0),
        "gap error": ("error in the gap, mm\n(all joints)", 1.0),
    }
    for ax, (key, (title, scale)) in zip(axes, panels.items(), strict=True):
        for end, (mark, role) in _ENDS.items():
            mine = [line for line in lines if line.end == end and (line.cure != "truth" or key != "known off")]
            shown = [line for line in mine if key != "known off" or line.found[key].max() > 1e-6]
            rows = [names.index(line.cure) + {"left": -0.2, "pasted": 0.0, "faded": 0.2}[end] for line in shown]
            found = [_mean(scale * line.found[key]) for line in shown]
            if found:
                mean, bar = zip(*found, strict=True)
                style = {"ms": 5, "color": colour(role), "elinewidth": 1.2}
                ax.errorbar(mean, rows, xerr=bar, fmt=mark, label=end, **style)
        ax.set_title(title, fontsize=9.5)
        ax.grid(visible=False, axis="y")
        for row in range(1, len(names)):
            ax.axhline(row - 0.5, color=LINE, lw=0.5)
    axes[0].set_xscale("log")
    axes[0].axvline(1, color=INK, lw=1.2, ls=(0, (4, 2)))
    axes[0].set_yticks(range(len(names)), names)
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    axes[0].xaxis.set_major_formatter("{x:g}")
    axes[0].xaxis.set_minor_formatter("")
    axes[1].set_xlim(left=0)
    axes[2].set_xlim(left=0)
    axes[2].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return fig


def around(change: Mapping[str, Mapping[str, Tensor]], known: Tensor, roles: Mapping[str, str], fps: float) -> Figure:
    """How much velocities change from frame to frame: a panel per source, label -> (B, T - 1) m/s; the gap is grey."""
    hidden, how = dict.fromkeys(change, ~known[1:]), {"fps": fps, "roles": roles, "log_from": 0.01}
    fig = plots.over_time(change, ylabel="change of velocity (m/s)", hidden=hidden, **how)
    fig.axes[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return fig


def settling(
    left: Tensor, bands: Mapping[str, Mapping[str, Tensor]], whole: Mapping[str, tuple[Tensor, Tensor]]
) -> Figure:
    """What is still to change in the estimate of x_0, over the share of steps left: by group and band, and as a whole.

    bands: group -> band -> (S,). whole: label -> (share left (S,), distance of the joints (S, N)). 1: another motion.
    """
    fig, axes = canvas(1, len(bands) + 1, size=(2.75 * (len(bands) + 1), 3.1), sharey=True)
    for ax, (group, found) in zip(axes, bands.items(), strict=False):
        paint = paints(list(found), dict(zip(found, ("truth", "ours", "6d", "axis-angle"), strict=False)))
        for band, values in found.items():
            ax.plot(100 * left, values, color=paint[band], lw=1.8, label=band)
        ax.set_title(group)
    paint = paints(list(whole))
    for label, (at, values) in whole.items():
        middle = values.mean(1)
        low, high = np.percentile(values.numpy(), (10, 90), axis=1)
        axes[-1].fill_between(100 * at, low, high, color=paint[label], alpha=0.13, lw=0)
        axes[-1].plot(100 * at, middle, color=paint[label], lw=1.8, label=label)
    axes[-1].set_title("all joints, in space")
    for ax in axes:
        ax.axvline(10, color=INK, lw=0.9, ls=(0, (4, 2)))
        ax.axhline(0.25, color=LINE, lw=0.9)
        ax.set(xlabel="steps left (%)", xlim=(100, 0), ylim=(0, 1.6))
    axes[0].set_ylabel("change still to come\n/ another motion")
    axes[len(bands) - 1].legend(loc="upper right", frameon=False, fontsize=8)
    axes[-1].legend(loc="upper right", frameon=False, fontsize=8)
    return fig


def lines_of(panels: Mapping[str, Mapping[str, Tensor]], known: Tensor, fps: float, *, ylabel: str, roles) -> Figure:
    """One number over time (T,) by label, a panel per case; the gap is shaded."""
    fig, axes = canvas(1, len(panels), size=(3.5 * len(panels), 2.9), sharey=False)
    t, gap = np.arange(len(known)) / fps, (~known).numpy()
    for ax, (title, series) in zip(axes, panels.items(), strict=True):
        paint = paints(list(series), roles)
        ax.fill_between(t, 0, 1, where=gap, color=LINE, alpha=0.35, lw=0, transform=ax.get_xaxis_transform())
        for label, values in series.items():
            style = (0, (4, 2)) if roles.get(label) == "truth" else "-"
            ax.plot(t, values.numpy(), color=paint[label], lw=1.7, label=label, ls=style)
        ax.set(title=title, xlabel="time (s)")
    axes[0].set_ylabel(ylabel)
    axes[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return fig


def predicted(path: Path, index: int, left: Sequence[float], *, poses: int = 9, size=(1000, 210)) -> np.ndarray:
    """One motion as it is predicted with these shares of the steps left, a strip of poses each, below each other."""
    rows = []
    for share in left:
        at = path.at(share)
        row = movie.strip(path.motion(at).clip(index), poses, "ours", size=size, azimuth=0.0)
        rows.append(
            _labelled(
                row, f"{100 * float(path.left[at]):.0f} % of the steps left" if at < len(path.left) - 1 else "result"
            )
        )
    return np.concatenate(rows)


def _labelled(picture: np.ndarray, text: str) -> np.ndarray:
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((10, 6), text, fill=INK, font=ImageFont.load_default(15))
    return np.asarray(image)
