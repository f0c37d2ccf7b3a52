"""The figures of notebook 10: schedules, noise on a motion, learning curves, errors by noise level, ablations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from motionlab.diffusion.model import Trained
from motionlab.diffusion.sampling import NoiseSchedule
from motionlab.motion import Motion
from motionlab.viz import movie
from motionlab.viz.palette import INK, LINE, ROLE
from studies.shared.plots import canvas, paints

Interval = tuple[float, float, float]  # value, low, high
_LOSSES = {"simple": "ours", "velocity": "6d", "fk": "axis-angle", "contact": "quaternion", "known": "baseline"}


def schedules(
    named: Mapping[str, NoiseSchedule], errors: Mapping[str, Mapping[int, Tensor]], *, roles: Mapping[str, str]
) -> Figure:
    """What is left of the signal over the noising, its ratio to the noise, and what that does: the error of the sampled
    covariance, label -> steps -> (data sets,), median and range."""
    fig, (left, middle, right) = canvas(1, 3, size=(10.2, 3.0))
    for label, paint in paints(list(named), roles).items():
        a, u = named[label].alpha_bar.numpy(), (np.arange(len(named[label])) + 1) / len(named[label])
        left.plot(u, a, color=paint, lw=2, label=label)
        middle.semilogy(u, a / (1 - a), color=paint, lw=2)
        steps = sorted(errors[label])
        low, mid, high = np.array([np.percentile(errors[label][n].numpy(), (0, 50, 100)) for n in steps]).T
        right.fill_between(steps, low, high, color=paint, alpha=0.15, lw=0)
        right.loglog(steps, mid, "o-", ms=4, color=paint, lw=1.8)
    left.set(xlabel="share of the steps", ylabel="signal left, alpha-bar", title="Eq. 4.4")
    middle.set(xlabel="share of the steps", ylabel="signal / noise, power", title="its end, logarithmic")
    right.set(xlabel="sampling steps", ylabel="error of the covariance", title="DDPM with the exact denoiser")
    for axis in (right.xaxis, right.yaxis):
        axis.set_minor_formatter("")
    left.legend(loc="lower left")
    return fig


def noising(model: Trained, motion: Motion, levels: Sequence[float], generator: torch.Generator) -> np.ndarray:
    """One window (1, T) on its way to noise: rows of key poses, one per share of the steps; (H, W, 3) uint8.

    What is noised are the model's numbers: rotations stay rotations, as 6-D numbers are made orthonormal.
    """
    x0, last, rows = model.encode(motion), len(model.schedule) - 1, []
    noise = torch.randn(x0.shape, generator=generator)
    for share in levels:
        t = round(share * last)
        shown = model.decode(model.schedule.noised(x0, t, noise) if share else x0)
        role = "ours" if share else "truth"
        picture = Image.fromarray(movie.strip(shown.clip(0), 7, role, size=(900, 210), azimuth=20))
        text = f"{100 * share:.0f} % of the steps, signal left {model.schedule.alpha_bar[t] if share else 1:.2f}"
        ImageDraw.Draw(picture).text((10, 6), text, fill=INK, font=ImageFont.load_default(14))
        rows.append(np.asarray(picture))
    return np.concatenate(rows)


def training(curves: Mapping[str, Sequence[Mapping[str, float]]], chosen: Mapping[str, int]) -> Figure:
    """How runs went: a row per run with its losses, the held-out error of x_0 per step of noise, and the held-out KID
    with the step that was chosen; rows as a training run writes them."""
    fig, axes = canvas(len(curves), 3, size=(10.2, 0.5 + 2.05 * len(curves)))
    for row, (name, curve) in enumerate(curves.items()):
        losses, errors, kid = axes[3 * row : 3 * row + 3]
        for part, role in _LOSSES.items():
            _trace(losses, curve, part, ROLE[role], part)
        keys = list(dict.fromkeys(k for entry in curve for k in entry if k.startswith("x0 error")))
        for k, key in enumerate(keys):
            tone = 0.25 + 0.65 * k / max(len(keys) - 1, 1)
            _trace(errors, curve, key, (1 - tone, 0.75 - 0.5 * tone, 0.85), key.removeprefix("x0 error at "))
        if any("kid" in entry for entry in curve):
            _trace(kid, curve, "kid", ROLE["ours"], "", marker=".")
            kid.axvline(chosen.get(name, np.nan), color=ROLE["axis-angle"], lw=1.2, ls=":")
        else:
            kid.set_axis_off()
            kid.text(0.5, 0.5, "not judged by KID", ha="center", fontsize=8.5, transform=kid.transAxes)
        losses.set(ylabel=name, yscale="log")
        errors.set(yscale="log")
        kid.set_ylim(bottom=0)
        if row == 0:
            losses.set_title("parts of the loss, training")
            errors.set_title("error of x0, held out")
            kid.set_title("KID of samples, held out; dotted: chosen")
            for ax, columns in ((losses, 2), (errors, 3)):
                ax.set_ylim(top=6 * ax.get_ylim()[1])  # room for the legend
                ax.legend(fontsize=7.5, ncols=columns, loc="upper right")
    for ax in axes[-3:]:
        ax.set_xlabel("step")
    return fig


TINY = 1e-9  # what a loss of known numbers leaves that come out exactly: not drawn


def _trace(ax: Axes, curve: Sequence[Mapping[str, float]], key: str, paint, label: str, marker: str = "") -> None:
    points = [(row["step"], row[key]) for row in curve if row.get(key, 0.0) > TINY]
    if points:
        ax.plot(*np.array(points).T, color=paint, lw=1.4, label=label or None, marker=marker)


def by_level(
    panels: Mapping[str, Mapping[str, Tensor]],
    levels: Sequence[float],
    *,
    ylabel: str,
    roles: Mapping[str, str],
    log: bool = True,
) -> Figure:
    """Errors over the level of noise, a panel per source: label -> (B, L), mean over windows and its 95 % interval."""
    fig, axes = canvas(1, len(panels), size=(4.2 * len(panels) + 0.8, 3.1), sharey=True)
    for ax, (name, series) in zip(axes, panels.items(), strict=True):
        for label, paint in paints(list(series), roles).items():
            y = series[label].double().numpy()
            middle, half = y.mean(0), 1.96 * y.std(0) / len(y) ** 0.5
            low = np.maximum(middle - half, 1e-9) if log else middle - half
            ax.fill_between(levels, low, middle + half, color=paint, alpha=0.18, lw=0)
            ax.plot(levels, middle, "o-", ms=4, lw=1.7, color=paint, label=label)
        count = len(next(iter(series.values())))
        ax.set(title=f"{name}, {count} windows", xlabel="level of noise (share of the steps)")
        ax.set_yscale("log" if log else "linear")
    axes[0].set_ylabel(ylabel)
    axes[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


def ablation(
    table: Mapping[str, Mapping[str, float]], *, seeds: Sequence[str], truth: Mapping[str, float] | None = None
) -> Figure:
    """One panel per measure, one line per model: name -> measure -> value. The band spans ``seeds``, models that differ
    only in their seed; ``truth``: the data's own value."""
    measures = list(dict.fromkeys(m for row in table.values() for m in row))
    columns = min(4, len(measures))
    rows = -(-len(measures) // columns)
    size = (1.4 + 2.1 * columns, rows * (0.8 + 0.24 * len(table)))
    fig, axes = canvas(rows, columns, size=size, sharey=True)
    for ax in axes[len(measures) :]:
        ax.set_axis_off()
    for ax, measure in zip(axes[: len(measures)], measures, strict=True):
        value = [row.get(measure, np.nan) for row in table.values()]
        spread = [table[name][measure] for name in seeds if name in table]
        if spread:
            ax.axvspan(min(spread), max(spread), color=ROLE["ours"], alpha=0.15, lw=0)
        if truth and measure in truth:
            ax.axvline(truth[measure], color=ROLE["truth"], lw=1.2, ls=":")
        paint = [ROLE["ours"] if name in seeds else ROLE["axis-angle"] for name in table]
        ax.scatter(value, range(len(table)), c=paint, s=34, zorder=3)
        ax.set_title(measure, fontsize=9)
        ax.margins(x=0.15)
        ax.tick_params(axis="x", labelsize=8)
    axes[0].set_yticks(range(len(table)), list(table))
    axes[0].set_ylim(len(table) - 0.5, -0.5)
    return fig


def by_minutes(
    series: Mapping[str, Mapping[float, Interval]], *, ylabel: str, roles: Mapping[str, str] | None = None
) -> Figure:
    """Held-out error over minutes of training motion: label -> minutes -> (value, low, high)."""
    fig, (ax,) = canvas(size=(6.4, 3.2))
    ticks = sorted({minutes for points in series.values() for minutes in points})
    for label, paint in paints(list(series), roles).items():
        x = np.array(sorted(series[label]))
        value, low, high = np.array([series[label][minutes] for minutes in x]).T
        ax.errorbar(x, value, (value - low, high - value), fmt="o-", ms=5, capsize=3, lw=1.7, color=paint, label=label)
    ax.set_xscale("log")
    ax.set_xticks(ticks, [f"{t:.0f}" for t in ticks])
    ax.xaxis.set_minor_formatter("")
    ax.set(xlabel="minutes of training motion, before mirroring", ylabel=ylabel)
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))  # beside the curves
    return fig


def kinds(
    table: Mapping[str, Mapping[str, Interval]],
    *,
    ylabel: str,
    reference: float | None = None,
    roles: Mapping[str, str],
) -> Figure:
    """Estimates by kind of mask: kind -> label -> (value, low, high), dots with intervals; a line at ``reference``."""
    labels = list(dict.fromkeys(label for row in table.values() for label in row))
    fig, (ax,) = canvas(size=(1.9 * len(table) + 1.2, 3.0))
    for k, (label, paint) in enumerate(paints(labels, roles).items()):
        at = np.array([i for i, row in enumerate(table.values()) if label in row], float)
        value, low, high = np.array([row[label] for row in table.values() if label in row]).T
        at = at + 0.14 * (k - (len(labels) - 1) / 2)
        ax.errorbar(at, value, (value - low, high - value), fmt="o", ms=6, capsize=3, color=paint, label=label, lw=1.6)
    if reference is not None:
        ax.axhline(reference, color=LINE, lw=1.2)
    ax.set_xticks(range(len(table)), list(table))
    ax.grid(visible=False, axis="x")
    ax.set(ylabel=ylabel, ylim=(0, None))
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig
