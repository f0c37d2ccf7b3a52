"""The figures of notebook 11: a wall of bodies, measures of generators, quality over steps, what is still to come."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from torch import Generator, Tensor

from motionlab import viz
from motionlab.body import BodyModel
from motionlab.metrics import interval
from motionlab.motion import Motion
from motionlab.viz.movie import Film, drawn, stage, write_film
from motionlab.viz.palette import INK, LINE, colour
from studies.shared.plots import canvas, paints

Interval = tuple[float, float, float]  # value, low, high


def wall(people: Motion, made: Motion, across: int, path: Path, body: BodyModel) -> Film:
    """A film of a row of people (N, T), evenly through them, over two rows of the first samples (N, T): each in its own
    panel that follows it."""
    evenly = [round(k * (len(people.root) - 1) / max(across - 1, 1)) for k in range(across)]
    rows = [({f"person {n + 1}": people.clip(k) for n, k in enumerate(evenly)}, "truth")]
    rows += [({f"P {k + 1}": made.clip(k) for k in range(at, at + across)}, "ours") for at in (0, across)]
    fine, scenes = 1 if viz.draft else 2, []
    for panels, role in rows:
        size = (fine * 216 * across, fine * 270)
        scenes.append(stage(panels, dict.fromkeys(panels, role), body, size, follow=True)[0])
        scenes[-1].smooth(False)
    pictures = []
    for now in drawn(np.arange(made.frames) / made.fps):
        whole = np.concatenate([scene.image(float(now)) for scene in scenes])
        pictures.append(np.asarray(Image.fromarray(whole).reduce(fine)))
    for scene in scenes:
        scene.close()
    return write_film(pictures, path, made.fps * len(pictures) / made.frames, made.seconds)


def measures(
    rows: Mapping[str, Mapping[str, Interval]], roles: Mapping[str, str], bands: Mapping[str, tuple[float, float]]
) -> Figure:
    """A panel per measure, a line per generator: value and interval. bands: where a good one lies, shaded."""
    names = list(next(iter(rows.values())))
    fig, axes = canvas(2, -(-len(names) // 2), size=(11.0, 1.2 + 0.5 * len(rows)), sharey=True)
    paint = paints(list(rows), roles)
    for ax, name in zip(axes, names, strict=False):
        for line, (who, found) in enumerate(rows.items()):
            value, low, high = found[name]
            bar = [[max(value - low, 0)], [max(high - value, 0)]]
            ax.errorbar(value, line, xerr=bar, fmt="o", ms=6, lw=1.6, color=paint[who])
        if name in bands:
            ax.axvspan(*bands[name], color=LINE, alpha=0.4, lw=0)
        ax.set_title(name, fontsize=9.5)
        ax.grid(visible=False, axis="y")
        ax.set_xlim(left=0)
    axes[0].set_yticks(range(len(rows)), list(rows))
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    return fig


def over_steps(
    found: Mapping[str, Mapping[int, Mapping[str, Tensor]]], level: Mapping[str, float], roles: Mapping[str, str],
    generator: Generator,
) -> Figure:  # fmt: skip
    """A panel per measure over the number of steps, a line per sampler; level: training people, dashed. Of ratios
    (all but coverage), within a tenth is shaded."""
    names = list(level)
    fig, axes = canvas(1, len(names), size=(2.6 * len(names), 3.0))
    paint = paints(list(found), roles)
    for ax, name in zip(axes, names, strict=True):
        for sampler, by_steps in found.items():
            steps = sorted(by_steps)
            value, low, high = np.array([interval(by_steps[n][name], "mean", generator) for n in steps]).T
            ax.fill_between(steps, low, high, color=paint[sampler], alpha=0.18, lw=0)
            ax.plot(steps, value, "o-", ms=4, lw=1.8, color=paint[sampler], label=sampler)
        ax.axhline(level[name], color=INK, lw=1.2, ls=(0, (4, 2)), label="training people")
        if name != "coverage":
            ax.axhspan(0.9, 1.1, color=LINE, alpha=0.4, lw=0)
        ax.set(xscale="log", xlabel="steps", title=name)
        ax.set_xticks(ticks := sorted({n for some in found.values() for n in some}), [str(n) for n in ticks])
        ax.tick_params(axis="x", labelsize=7.5)
        ax.minorticks_off()
        ax.set_ylim(bottom=0)
    axes[0].legend(loc="lower right", frameon=False, fontsize=8)
    return fig


def to_come(left: Sequence[float], whole: Tensor, bands: Mapping[str, Sequence[float]]) -> Figure:
    """What of the predicted motion is still to change over the share of steps left: in all (S, N), and by frequency."""
    fig, axes = canvas(1, 2, size=(9.0, 3.1), sharey=True)
    x, y = 100 * np.array(left), whole.numpy()
    axes[0].fill_between(x, *np.percentile(y, (2.5, 97.5), axis=1), color=colour("ours"), alpha=0.15, lw=0)
    axes[0].plot(x, y.mean(1), "o-", ms=4, color=colour("ours"), lw=1.8)
    axes[0].set_title("all joints: mean, and 95 % of samples")
    paint = paints(list(bands), dict(zip(bands, ("truth", "6d", "axis-angle"), strict=False)))
    for band, values in bands.items():
        axes[1].plot(x, values, "o-", ms=4, lw=1.8, color=paint[band], label=band)
    axes[1].set_title("by frequency")
    axes[1].legend(frameon=False, fontsize=8.5)
    for ax in axes:
        ax.axvline(10, color=INK, lw=0.9, ls=(0, (4, 2)))
        ax.axhline(0.25, color=LINE, lw=1.2)
        ax.set(xlabel="steps left (%)", xlim=(100, -2), ylim=(0, 1.6))
    axes[0].set_ylabel("change to come\n/ distance of two samples")
    return fig


def nearest(distances: Mapping[str, Tensor], limit: float, roles: Mapping[str, str]) -> Figure:
    """Share of each set (N,) of windows whose nearest training window is nearer than x, to 60 cm. limit: of copies."""
    _, (ax,) = canvas(size=(7.0, 3.0))
    paint = paints(list(distances), roles)
    for label, values in distances.items():
        x = 100 * np.sort(values.numpy())
        ax.step(x, 100 * np.arange(1, len(x) + 1) / len(x), where="post", color=paint[label], lw=1.8, label=label)
    ax.axvline(100 * limit, color=INK, lw=1.0, ls=(0, (4, 2)), label="copies lie left of it")
    ax.set(xlabel="distance to the nearest training window (cm)", ylabel="share that is nearer (%)", ylim=(0, 101))
    ax.set_xlim(0, 60)
    ax.legend(frameon=False, fontsize=8.5, loc="lower right")
    return ax.figure
