"""The figures of notebook 04: what a state holds, what the latents know, and how decoded motion drifts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from motionlab.humor.state import OFFICIAL_SLICES, STATE, unpack
from motionlab.motion import Motion
from motionlab.skeleton import Skeleton
from motionlab.viz.palette import INK, LINE, ROLE, blend
from motionlab.viz.scene import Scene
from studies.nb04_prior.parity import Row
from studies.shared.plots import canvas, paints

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


def learning(curve: Sequence[Mapping[str, float]]) -> Figure:
    """Held-out errors over the steps of a training run, a panel per measure; rows as ``train`` writes them."""
    measures = {"one step": "one step (cm)", "2 s": "after 2 s, rolled out (cm)", "kl": "KL (nats)"}
    fig, axes = canvas(1, 3, size=(9.6, 3.0))
    step = [row["step"] for row in curve]
    for ax, (key, title) in zip(axes, measures.items(), strict=True):
        names = [name.split(":")[0] for name in curve[-1] if name.endswith(f": {key}")]
        for name, paint in paints(names, {"recordings": "real"}).items():
            y = [row.get(f"{name}: {key}", np.nan) for row in curve]
            ax.plot(step, y, ".-", ms=3, color=paint, lw=1.5, label=name)
        ax.set(title=title, xlabel="step", yscale="linear" if key == "kl" else "log")
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("{x:g}")
    axes[-1].legend(loc="best", frameon=False, fontsize=8)
    return fig


def latents(kl: Tensor, scores: Tensor, labels: Sequence[str], active: float) -> Figure:
    """Nats that every latent dimension (D,) carries, sorted; posterior means (N, 2) in their two main directions."""
    fig, (left, right) = canvas(1, 2, size=(9.6, 3.7))
    values = np.sort(kl.numpy(force=True))[::-1]
    paint = [ROLE["ours"] if value > active else LINE for value in values]
    left.bar(np.arange(1, len(values) + 1), values, color=paint, width=0.8, lw=0)
    left.axhline(active, color=ROLE["truth"], lw=1, ls=":")
    left.set(xlabel="latent dimension, sorted", ylabel="KL from the prior (nats)")
    left.grid(visible=False, axis="x")
    points, names = scores.numpy(force=True), list(dict.fromkeys(labels))
    colours = paints(names)
    for name in names:
        mine = np.array([label == name for label in labels])
        right.scatter(*points[mine].T, s=7, color=colours[name], alpha=0.55, lw=0, label=name)
    right.set(xlabel="first main direction", ylabel="second")
    right.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), markerscale=2.2, handletextpad=0.1, frameon=False)
    return fig


def drift(panels: Mapping[str, Mapping[str, Tensor]], roles: Mapping[str, str], fps: float = 30.0) -> Figure:
    """Joint error in cm (B, T) over time, a panel per source: medians over clips and quartiles, logarithmic."""
    fig, axes = canvas(1, len(panels), size=(2.2 + 2.1 * len(panels), 3.3), sharey=True)
    for ax, (name, series) in zip(axes, panels.items(), strict=True):
        paint = paints(list(series), roles)
        for label, values in series.items():
            y = values.numpy(force=True)
            low, middle, high = np.percentile(y, (25, 50, 75), axis=0)
            t = np.arange(1, y.shape[1] + 1) / fps
            dotted = label.startswith("errors")
            if not dotted:
                ax.fill_between(t, low, high, color=paint[label], alpha=0.14, lw=0)
            ax.plot(t, middle, color=paint[label], lw=1.3 if dotted else 1.9, ls=":" if dotted else "-", label=label)
        ax.set(title=f"{name}\n{len(y)} clips", xlabel="time (s)", yscale="log")
    axes[0].set(ylabel="joint error (cm)", ylim=(0.05, None))
    axes[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return fig


def paths(cases: Mapping[str, tuple[Motion, Motion]]) -> Figure:
    """Seen from above: how the pelvis of one clip (T,) went on, and where samples (N, T) from its first pose went."""
    fig, axes = canvas(1, len(cases), size=(2.9 * len(cases), 3.1))
    for ax, (name, (truth, samples)) in zip(axes, cases.items(), strict=True):
        for way in samples.root.numpy(force=True):
            ax.plot(way[:, 0], way[:, 1], color=ROLE["ours"], lw=1.0, alpha=0.45)
        way = truth.root.numpy(force=True)
        ax.plot(way[:, 0], way[:, 1], color=ROLE["truth"], lw=2.2)
        ax.plot(*way[0, :2], "o", color="white", mec=INK, ms=6, zorder=4)
        both = np.concatenate((samples.root.numpy(force=True).reshape(-1, 3), way))[:, :2]
        middle, half = (both.max(0) + both.min(0)) / 2, max(0.55 * np.ptp(both, axis=0).max(), 0.35)
        ax.set(title=name, xlabel="x (m)", xlim=middle[0] + np.array((-half, half)))
        ax.set(ylim=middle[1] + np.array((-half, half)), aspect="equal")
    axes[0].set_ylabel("y (m)")
    return fig


def futures(truth: Motion, samples: Motion, size: tuple[int, int] = (1000, 420)) -> np.ndarray:
    """One pose, dark, and the last poses of samples (N, T) from it with the ways of their wrists: (H, W, 3) uint8."""
    with Scene(size) as scene:
        scene.skeleton(truth, "truth", frame=0)
        for index in range(len(samples.root)):
            tone = blend(ROLE["ours"], "white", 0.65 * index / max(len(samples.root) - 1, 1))
            one = samples.clip(index)
            scene.skeleton(one, tone, frame=-1, shadow=0.2).trail(one, "pelvis", tone).trail(one, "left_wrist", tone)
        return scene.floor().image(seconds=truth.frames / truth.fps)


def dimensions(effects: Mapping[str, Motion], size: tuple[int, int] = (1150, 360)) -> np.ndarray:
    """A panel per latent dimension: the last pose of three roll-outs (3, T), below, at and above the prior's mean."""
    roles = ("baseline", "observation", "ours")
    with Scene(size, panels=tuple(effects)) as scene:
        for panel, motion in enumerate(effects.values()):
            for index, role in enumerate(roles):
                scene.skeleton(motion.clip(index), role, frame=-1, shadow=0.25, panel=panel)
        return scene.floor().image()
