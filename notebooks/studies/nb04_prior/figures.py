"""The figures of notebook 04: what a state holds, one step, what a prior reaches, and how decoded motion drifts."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import NullLocator
from torch import Tensor

from motionlab.body import BodyModel
from motionlab.humor.state import OFFICIAL_SLICES, STATE, unpack
from motionlab.motion import Motion
from motionlab.skeleton import Skeleton
from motionlab.viz.palette import INK, LINE, ROLE
from motionlab.viz.scene import Scene
from studies.nb04_prior.gates import GATES
from studies.nb04_prior.parity import Row
from studies.shared.plots import canvas, median_band, paints
from suite.findings import Criterion

#: One colour per part of the state, positions strong and their velocities pale.
PARTS = {
    "trans": "#0072b2", "trans_vel": "#7fb8d8", "root_orient": "#d55e00", "root_orient_vel": "#eaae7f",
    "pose_body": "#009e73", "joints": "#332288", "joints_vel": "#9990c3",
}  # fmt: skip
_MEANING = {
    "trans": "where the pelvis is", "trans_vel": "its velocity", "root_orient": "how the body is turned",
    "root_orient_vel": "how fast, about which axis", "pose_body": "21 joint angles, as matrices",
    "joints": "where 22 joints are", "joints_vel": "their velocities",
}  # fmt: skip
_VELOCITY = 0.15  # seconds that an arrow shows


def anatomy(state: Tensor, skeleton: Skeleton) -> Figure:
    """One state (339,) drawn on the body it describes, and its parts in their order."""
    fig, (body, band) = canvas(2, 1, size=(9.0, 5.0))
    fig.get_layout_engine().set(hspace=0.02)
    body.get_gridspec().set_height_ratios((6.5, 1.0))
    parts = {name: value.double().numpy(force=True) for name, value in unpack(state).items()}
    flat = _oblique(azimuth=28.0)
    points = flat(parts["joints"])
    for j, parent in enumerate(skeleton.parents[1:], start=1):
        body.plot(*points[[parent, j]].T, color=LINE, lw=5, solid_capstyle="round", zorder=1)
    turn = {0: parts["root_orient"]}
    for j, parent in enumerate(skeleton.parents[1:], start=1):
        turn[j] = turn[parent] @ parts["pose_body"][j - 1]
        for axis in range(3):  # the bone's own axes stand for its angle
            end = flat(parts["joints"][j] + 0.055 * turn[j][:, axis])
            body.plot(*np.stack((points[j], end)).T, color=PARTS["pose_body"], lw=1.3, zorder=2)
    body.scatter(*points.T, s=22, color=PARTS["joints"], zorder=4)
    _arrows(body, points, flat(parts["joints"] + _VELOCITY * parts["joints_vel"]), PARTS["joints_vel"], 1.4)
    root = flat(parts["trans"])
    for axis in range(3):
        end = flat(parts["trans"] + 0.2 * turn[0][:, axis])
        body.plot(*np.stack((root, end)).T, color=PARTS["root_orient"], lw=2.6, zorder=5)
    _arrows(body, root[None], flat(parts["trans"] + 1.6 * _VELOCITY * parts["trans_vel"])[None], PARTS["trans_vel"], 3)
    spin = flat(parts["trans"] + 0.35 * parts["root_orient_vel"])
    _arrows(body, root[None], spin[None], PARTS["root_orient_vel"], 3)
    body.scatter(*root, s=75, color=PARTS["trans"], zorder=6)
    origin = flat(np.zeros(3))
    for axis, name in enumerate(("x: to the right", "y: where the body faces")):
        end = flat(0.55 * np.eye(3)[axis])
        _arrows(body, origin[None], end[None], INK, 1.2)
        body.annotate(name, end, fontsize=8.5, xytext=(4, -3), textcoords="offset points")
    body.plot(*np.stack((root, origin)).T, color=INK, lw=0.8, ls=":")
    for k, (name, meaning) in enumerate(_MEANING.items()):
        size = OFFICIAL_SLICES[name].stop - OFFICIAL_SLICES[name].start
        body.text(0.60, 0.9 - 0.085 * k, f"{name}  {size}", color=PARTS[name], transform=body.transAxes, weight="bold")
        body.text(0.83, 0.9 - 0.085 * k, meaning, fontsize=9.5, transform=body.transAxes)
    middle = points[:, 0].mean()
    body.set(aspect="equal", xlim=(middle - 1.0, middle + 2.2), ylim=(-0.25, points[:, 1].max() + 0.15))
    body.axis("off")
    _band(band)
    return fig


def _band(ax) -> None:
    for name, part in OFFICIAL_SLICES.items():
        size = part.stop - part.start
        ax.add_patch(Rectangle((part.start, 0), size, 1, color=PARTS[name], lw=0))
        if size > 20:
            middle = (part.start + part.stop) / 2
            ax.text(middle, 0.45, name, fontsize=9, color="white", ha="center", va="center")
    ax.text(0, 1.15, "trans, trans_vel, root_orient, root_orient_vel", fontsize=9)
    ends = sorted({0, STATE, *(OFFICIAL_SLICES[name].start for name in ("pose_body", "joints", "joints_vel"))})
    ax.set(xlim=(-2, STATE + 2), ylim=(0, 2.1), yticks=[], xticks=ends)
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)


def _oblique(azimuth: float, elevation: float = 14.0):
    """Orthographic projection (..., 3) -> (..., 2) of an eye at these angles, degrees."""
    a, e = np.radians((azimuth, elevation))
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
    return lambda x: np.asarray(x) @ np.stack((right, up), -1)


def _arrows(ax, start: np.ndarray, end: np.ndarray, paint: str, width: float) -> None:
    for a, b in zip(start, end, strict=True):
        if np.hypot(*(b - a)) > 0.02:
            ax.annotate("", b, a, arrowprops={"arrowstyle": "-|>", "color": paint, "lw": width, "shrinkA": 0,
                                              "shrinkB": 0, "mutation_scale": 6 + 3 * width}, zorder=3)  # fmt: skip


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


def one_step(
    before: Tensor, after: Mapping[str, Tensor], samples: Tensor, skeleton: Skeleton, *, larger: float
) -> Figure:
    """Draws the body (22, 3) before a step and where every joint goes, (22, 3) by label, its way drawn ``larger``.

    samples (S, 22, 3): where the joints went when z was drawn.
    """
    fig, axes = canvas(1, 2, size=(9.6, 4.6))
    turn = _oblique(azimuth=20.0, elevation=8.0)
    start = before.double().numpy(force=True)
    paint = paints(list(after), STEP_ROLES)
    for ax, names in zip(axes, (list(after)[:2], list(after)[2:]), strict=True):
        points = turn(start)
        for j, parent in enumerate(skeleton.parents[1:], start=1):
            ax.plot(*points[[parent, j]].T, color=LINE, lw=6, solid_capstyle="round", zorder=1)
        if names == list(after)[2:]:
            cloud = turn(start + larger * (samples.double().numpy(force=True) - start)).reshape(-1, 2)
            ax.scatter(*cloud.T, s=5, color=ROLE["stage2"], alpha=0.5, lw=0, zorder=2, label="samples of the prior")
        for name in names:
            end = turn(start + larger * (after[name].double().numpy(force=True) - start))
            for a, b in zip(points, end, strict=True):
                ax.plot(*np.stack((a, b)).T, color=paint[name], lw=1.6, zorder=3)
            ax.scatter(*end.T, s=9, color=paint[name], zorder=4, label=name)
        ax.set(aspect="equal")
        ax.axis("off")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3, frameon=False, markerscale=1.6)
    return fig


#: Whose step it is, and its colour.
STEP_ROLES = {
    "the person": "truth", "constant velocity": "baseline", "the prior's mean": "ours", "shown the answer": "6d",
    "held pose": "observation",
}  # fmt: skip


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


#: Of two seconds that are chained (:func:`drift.ways_of_two_seconds`).
WAYS = {
    "the person": "truth", "z known, closed loop": "ours", "z known, open loop": "axis-angle",
    "prior's mean alone": "quaternion",
}  # fmt: skip
#: Gates in centimetres, in the order of the chains that they judge.
_IN_CM = ("closed_loop", "open_loop", "foresight")


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


def steps_by_person(panels: Mapping[str, Mapping[str, Tensor]]) -> Figure:
    """Draws the error of one step of every person (P,) in cm, a column per way of making it, a panel per source."""
    fig, axes = canvas(1, len(panels), size=(4.9 * len(panels), 3.3), sharey=True)
    for ax, (title, ways) in zip(np.atleast_1d(axes), panels.items(), strict=True):
        paint = paints(list(ways), STEP_ROLES)
        rows = torch.stack(list(ways.values())).numpy(force=True)
        ax.plot(range(len(ways)), rows, color=LINE, lw=0.7, zorder=1)
        for k, (name, values) in enumerate(ways.items()):
            ax.scatter([k] * len(values), values.numpy(force=True), s=16, color=paint[name], zorder=3, lw=0)
            ax.plot((k - 0.25, k + 0.25), (values.mean(),) * 2, color=paint[name], lw=3, zorder=4)
        ax.set(title=f"{title}: {rows.shape[1]} people", yscale="log")
        ax.set_xticks(range(len(ways)), [name.replace(" ", "\n", 1) for name in ways])
        ax.set_yticks((0.1, 0.2, 0.5, 1, 2, 5), ("0.1", "0.2", "0.5", "1", "2", "5"))
        ax.yaxis.set_minor_locator(NullLocator())
    np.atleast_1d(axes)[0].set_ylabel("joint error after 1/30 s (cm, log)")
    return fig


#: Of how decoded motion drifts.
DRIFT_ROLES = {
    "one step, z": "6d", "chain, z": "axis-angle", "single errors added": "axis-angle", "closed loop": "ours",
    "chain, prior's mean": "quaternion", "held pose": "observation",
}  # fmt: skip


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


#: Ways of decoding a sit, and their colours.
KNEE_ROLES = {
    "the sequence itself": "stage2", "one by one, z": "6d", "one by one, prior's mean": "ours",
    "rolled out, z": "axis-angle", "rolled out, prior's mean": "quaternion",
}  # fmt: skip


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
