"""The figures of notebook 07: the toy, costs, how long a gap takes, what the variants find."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.viz.palette import INK, LINE, colour
from studies.shared.plots import canvas, median_band, paints

#: A method's role in every figure.
ROLES = {
    "one chain": "stage3", "whole roll-outs": "stage3", "cut": "ours", "cut, springs 100": "ours",
    "cut, springs 10,000": "6d",
    "K = 1": "ours", "K = 2": "quaternion", "K = 10": "axis-angle",
}  # fmt: skip
#: Measures of a search, by what an axis says.
MEASURES = {"energy (nats)": "energy", "legs of the roll-out (cm)": "legs", "from x to roll-out (cm)": "gap"}


def lines(panels: Mapping[str, Mapping[str, Sequence[float]]], x: Sequence[float], xlabel: str, ylabel: str) -> Figure:
    """A panel per case, a line per method over x; both axes logarithmic where x grows by factors."""
    figure, axes = canvas(1, len(panels), size=(3.9 * len(panels), 2.9), sharey=True)
    for ax, (title, found) in zip(axes, panels.items(), strict=True):
        for name, tint in paints(list(found), ROLES).items():
            ax.plot(x, found[name], "o-", color=tint, label=name, ms=4)
        ax.set(title=title, xlabel=xlabel, xscale="log", yscale="log")
        ax.set_xticks(x, [f"{t:g}" for t in x])
        ax.minorticks_off()
    axes[0].set_ylabel(ylabel)
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def walkers(
    y: np.ndarray, seen: np.ndarray, found: Mapping[str, tuple[np.ndarray, np.ndarray, int]], done: int
) -> Figure:
    """The toy: where it was seen to be, and each way's estimate after ``done`` iterations and at its end."""
    figure, axes = canvas(1, len(found), size=(4.3 * len(found), 2.6), sharey=True)
    for ax, (name, (early, end, count)) in zip(axes, found.items(), strict=True):
        ax.plot(end, color=INK, lw=1.2, label="at the end")
        ax.plot(early, color=colour(ROLES[name]), lw=2.2, label=f"after {done}")
        ax.plot(np.flatnonzero(seen), y[seen > 0], "o", ms=3, color=colour("observation"), label="measured")
        ax.set(title=f"{name}: {count} iterations", xlabel="frame")
    axes[0].set_ylabel("place")
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def costs(seconds: Mapping[tuple[str, int, int | None], Tensor]) -> Figure:
    """Milliseconds of an evaluation, a panel per form and batch: the roll-out and K steps, median and quartiles, and
    the roll-out's time over each. seconds: (form, clips, K or None) -> (n,)."""
    panels = list(dict.fromkeys((form, clips) for form, clips, _ in seconds))
    figure, axes = canvas(1, len(panels), size=(2.7 * len(panels) + 0.5, 2.2))
    for ax, (form, clips) in zip(axes, panels, strict=True):
        rows = {k: 1e3 * x for (f, b, k), x in seconds.items() if (f, b) == (form, clips)}
        whole = rows[None].median().item()
        for at, (steps, x) in enumerate(rows.items()):
            low, middle, high = x.quantile(torch.tensor([0.25, 0.5, 0.75]).to(x)).tolist()
            ax.barh(at, middle, 0.7, color=colour("stage3" if steps is None else "ours"))
            ax.errorbar(middle, at, xerr=[[middle - low], [high - middle]], fmt="none", ecolor=INK, capsize=2, lw=1)
            said = f" {middle:.0f}" + ("" if steps is None else f", 1/{whole / middle:.1f}")
            ax.annotate(said, (high, at), (3, 0), textcoords="offset points", va="center", fontsize=8)
        ax.axvline(whole, color=LINE, lw=1, zorder=0)
        ax.set_yticks(range(len(rows)), ["roll-out" if k is None else f"K = {k}" for k in rows])
        ax.invert_yaxis()
        ax.set_xlim(0, 1.55 * max(x.median().item() for x in rows.values()))
        ax.grid(visible=False, axis="y")
        ax.set(title=f"{form}, {clips} clip{'s' * (clips > 1)}", xlabel="ms")
    return figure


def across_gaps(panels: Mapping[str, Mapping[str, Mapping[int, Tensor]]]) -> Figure:
    """A panel per measure, a colour per method: a dot for every clip (B,) and medians over the hidden frames; what
    never came is drawn open, above all others."""
    figure, axes = canvas(1, len(panels), size=(4.3 * len(panels), 3.2))
    for ax, (ylabel, methods) in zip(axes, panels.items(), strict=True):
        every = torch.cat([x for by in methods.values() for x in by.values()])
        top = 1.2 * float(every[every.isfinite()].max())
        for at, (name, tint) in enumerate(paints(list(methods), ROLES).items()):
            shift = 1.6 * (at - (len(methods) - 1) / 2)
            for gap, x in methods[name].items():
                side, x = gap + shift + np.linspace(-0.5, 0.5, len(x)), x.clamp(max=top).numpy()
                face = [tint if value < top else "none" for value in x]
                ax.scatter(side, x, s=14, facecolors=face, edgecolors=[tint], lw=0.8, alpha=0.7)
            middle = [min(float(x.median()), top) for x in methods[name].values()]
            ax.plot([gap + shift for gap in methods[name]], middle, color=tint, lw=1.8, label=name)
        if not every.isfinite().all():
            ax.text(0.01, 1.02 * top, "never", transform=ax.get_yaxis_transform(), fontsize=8)
        ax.set_xticks(list(methods[name]), [f"{gap}" for gap in methods[name]])
        ax.set(xlabel="hidden frames in the middle", ylabel=ylabel, ylim=(0, 1.1 * top))
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def variants(score: Mapping[str, Mapping[str, Tensor]], roles: Mapping[str, str]) -> Figure:
    """A panel per measure, a row for each of ``roles``: a dot for every clip (B,), the median as a bar."""
    figure, axes = canvas(1, len(MEASURES), size=(2.7 * len(MEASURES) + 1.6, 0.7 + 0.29 * len(roles)), sharey=True)
    paint = paints(list(roles), roles)
    for ax, (title, measure) in zip(axes, MEASURES.items(), strict=True):
        for at, name in enumerate(roles):
            x = score[name][measure].numpy(force=True)
            ax.scatter(x, np.full(len(x), at), s=16, color=paint[name], alpha=0.6, lw=0)
            ax.plot([np.median(x)] * 2, [at - 0.33, at + 0.33], color=paint[name], lw=3)
        ax.set_xlabel(title)
    axes[0].set_yticks(range(len(roles)), list(roles))
    axes[0].invert_yaxis()
    return figure


def falls(apart: Mapping[str, Tensor], free: Mapping[str, Tensor], at: Sequence[int]) -> Figure:
    """How far z is from that of its clip's whole fit: medians and quartiles over clips, after ``at`` evaluations
    (n, B, B), and as levels what needs no search (B, B)."""
    figure, (ax,) = canvas(size=(7.5, 3.0))
    for (name, y), tint in zip(apart.items(), (colour("ours"), colour("6d")), strict=True):
        own = y.diagonal(dim1=1, dim2=2).T.numpy(force=True)
        median_band(ax, np.asarray(at), own, tint, name, alpha=0.18, ls="-")
    for k, (name, level) in enumerate(free.items()):
        middle = level.diagonal().median().item()
        ax.axhline(middle, color=INK, lw=1.2, ls=((0, (4, 2)), (0, (1, 1.5)))[k], label=f"{name} of the fixed x")
    ax.set(xlabel="evaluations", ylabel="distance from its own z", ylim=(0, None))
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
