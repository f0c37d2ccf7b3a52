"""The figures of notebook 04: samples, parity, what a prior reaches, and how decoded motion drifts."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.viz.palette import LINE, ROLE
from motionlab.viz.scene import Scene
from studies.nb04_prior.gates import GATES
from studies.nb04_prior.parity import Row
from studies.shared.plots import canvas, median_band, paints
from suite.findings import Criterion

#: Of two seconds that are chained (:func:`drift.ways_of_two_seconds`).
WAYS = {
    "the person": "truth", "z known, closed loop": "ours", "z known, open loop": "axis-angle",
    "prior's mean alone": "quaternion",
}  # fmt: skip
#: Gates in centimetres, in the order of the chains that they judge.
_IN_CM = ("closed_loop", "open_loop", "foresight")
#: Of how decoded motion drifts.
DRIFT_ROLES = {
    "one step, z": "6d", "chain, z": "axis-angle", "single errors added": "axis-angle", "closed loop": "ours",
    "chain, prior's mean": "quaternion", "held pose": "observation",
}  # fmt: skip
#: Ways of decoding a sit, and their colours.
KNEE_ROLES = {
    "the sequence itself": "stage2", "one by one, z": "6d", "one by one, prior's mean": "ours",
    "rolled out, z": "axis-angle", "rolled out, prior's mean": "quaternion",
}  # fmt: skip


def parity(rows: Sequence[Row]) -> Figure:
    """Error of every array, sorted, over its tolerance; the official formulas apart from the lean ones."""
    forms = ("official", "lean")
    fig, axes = canvas(1, 2, size=(8.4, 3.2), sharey=True)
    for ax, form in zip(axes, forms, strict=True):
        mine = sorted((row for row in rows if row.form == form), key=lambda row: row.error)
        x = np.arange(len(mine))
        for kind, holds in (("ours", True), ("observation", False)):
            shown = [(i, max(row.error, 1e-17)) for i, row in enumerate(mine) if row.holds == holds]
            label = "within its tolerance" if holds else "misses it, cause known"
            ax.scatter(*np.array(shown).reshape(-1, 2).T, s=16, color=ROLE[kind], label=label, zorder=3)
        ax.scatter(x, [row.tolerance for row in mine], marker="_", s=60, color=ROLE["axis-angle"], label="tolerance")
        ax.set(yscale="log", title=f"{form} form: {len(mine)} arrays", xlabel="arrays, by error", xticks=[])
    axes[0].set_ylabel("difference from the official code")
    axes[0].legend(loc="upper left", frameon=False)
    return fig


def continuation(samples: Motion, person: Motion, body: BodyModel) -> np.ndarray:
    """Draws where samples (S, T) of a motion have got to after a third, two thirds and all of their time.

    Translucent: the samples. Dark: the person. Grey: the pose that all of them left.
    """
    frames = [round((samples.frames - 1) * k / 3) for k in (1, 2, 3)]
    with Scene((1200, 400), panels=tuple(f"after {frame / samples.fps:.1f} s" for frame in frames)) as scene:
        for panel, frame in enumerate(frames):
            scene.body(body, person, "observation", frame=0, opacity=0.35, panel=panel)
            scene.body(body, person, "truth", frame=min(frame, person.frames - 1), panel=panel)
            for way in range(len(samples.root)):
                scene.body(body, samples.clip(way), "ours", frame=frame, opacity=0.25, shadow=0, panel=panel)
        return scene.floor().image()


def gates(
    found: Mapping[str, Mapping[str, tuple[float, float, float]]], criterion: Callable[[str], Criterion],
    ways: Mapping[str, Motion], body: BodyModel,
) -> Figure:  # fmt: skip
    """Draws a panel per gate, in its own unit: what each prior reaches, with its interval; green where it is passed.

    found: by prior and source, by test: the value and the ends of its interval. ways: the person, and the chains that
    the gates in centimetres judge; they stand above them as they end, the person's end in grey behind them.
    """
    fig, axes = canvas(4, 4, size=(11.0, 9.6))
    axes[0].get_gridspec().set_height_ratios((2.6, 1.0, 1.0, 1.0))
    for ax, picture in zip(axes[:4], _ends(ways, body), strict=True):
        ax.imshow(picture)
        ax.axis("off")
    order = (*_IN_CM, *(name for name in GATES if name not in _IN_CM))
    for ax, name in zip(axes[5:], order, strict=True):
        _gate(ax, name, criterion(f"H01.{name}"), {who: each.get(name) for who, each in found.items()})
        if name in _IN_CM:
            ax.set(xlim=(0, 110), xlabel="cm after 2 s")
    axes[4].axis("off")
    axes[4].legend(*axes[5].get_legend_handles_labels(), loc="center left", frameon=False)
    return fig


def _gate(ax: Axes, name: str, test: Criterion, reached: Mapping[str, tuple[float, float, float] | None]) -> None:
    most = 1.1 * max(x for each in reached.values() if each for x in (*each, test.bound))
    ends = sorted((test.bound, {None: 0.0 if test.relation == "<=" else most}.get(test.other, test.other)))
    ax.axvspan(*ends, color=ROLE["6d"], alpha=0.15, lw=0)
    for line, (who, each) in enumerate(reached.items()):
        tone = ROLE["observation" if who.startswith("transition,") else "ours"]
        look = {"ms": 6, "color": tone, "mfc": "white" if "synthetic" in who else tone, "label": who}
        value, low, high = each or (np.nan,) * 3
        ax.plot((low, high), (line, line), color=tone, lw=1.6)
        ax.plot(value, line, "o", clip_on=False, **look)
    ax.set(xlim=(0, most), ylim=(len(reached) - 0.4, -0.6), yticks=[], xlabel=test.unit)
    ax.set_title(GATES[name].label, fontsize=9)
    ax.grid(visible=False, axis="y")


def _ends(ways: Mapping[str, Motion], body: BodyModel) -> list[np.ndarray]:
    """The last pose of each motion, the first one's in grey behind the others."""
    person = next(iter(ways.values()))
    with Scene((300 * len(ways), 420), panels=tuple(ways)) as scene:
        for panel, (name, motion) in enumerate(ways.items()):
            scene.body(body, motion, WAYS[name], frame=-1, panel=panel)
            if motion is not person:
                scene.body(body, person, "observation", frame=-1, opacity=0.35, shadow=0, panel=panel)
        return np.split(scene.floor().image(), len(ways), axis=1)


def drift(panels: Mapping[str, Mapping[str, Tensor]]) -> Figure:
    """Draws joint error in cm (N, T) over time, a panel per source: medians over clips and quartiles, logarithmic."""
    rows, columns = -(-len(panels) // 3), min(3, len(panels))
    fig, axes = canvas(rows, columns, size=(3.1 * columns + 1.8, 2.6 * rows), sharey=True, sharex=True)
    for ax, (name, series) in zip(axes, panels.items(), strict=False):
        paint = paints(list(series), DRIFT_ROLES)
        for label, values in series.items():
            dotted, t = label == "single errors added", np.arange(1, values.shape[1] + 1) / 30
            how = {"alpha": 0.0, "ls": ":"} if dotted else {"alpha": 0.13, "ls": "-"}
            median_band(ax, t, values.numpy(force=True), paint[label], label, **how)
        ax.set(title=f"{name.replace(', ', chr(10), 1)} ({len(values)})", yscale="log", ylim=(0.05, 200))
        ax.yaxis.set_major_formatter("{x:g}")
    for ax in axes[-columns:]:
        ax.set_xlabel("time (s)")
    fig.supylabel("joint error (cm, log)", fontsize=10)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    return fig


def knees(groups: Mapping[str, Mapping[str, Tensor]]) -> Figure:
    """Draws what share of a person's own knee bend each way of decoding makes: a dot per person, a bar at the mean."""
    fig, axes = canvas(1, len(groups), size=(3.1 * len(groups) + 2.0, 3.1), sharey=True, sharex=True)
    for ax, (title, ways) in zip(axes, groups.items(), strict=True):
        for line, (name, share) in enumerate(ways.items()):
            tone = ROLE[KNEE_ROLES[name]]
            values = 100 * share.numpy(force=True)
            ax.scatter(values.clip(-100, 250), [line] * len(values), s=18, color=tone, alpha=0.6, lw=0)
            ax.plot((np.clip(values.mean(), -100, 250),) * 2, (line - 0.3, line + 0.3), color=tone, lw=3)
        ax.axvline(0, color=LINE, lw=1)
        ax.axvline(100, color=ROLE["truth"], lw=1, ls=":")
        ax.set(title=f"{title}: {len(values)} people", xlabel="share of the person's bend (%)", xlim=(-110, 260))
        ax.set_yticks(range(len(ways)), list(ways))
        ax.set_ylim(len(ways) - 0.5, -0.5)
        ax.grid(visible=False, axis="y")
    return fig
