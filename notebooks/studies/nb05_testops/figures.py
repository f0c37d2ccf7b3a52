"""The figures of notebooks 05a to 05c: fits beside their truth, in the world, in the image and over time, and methods
beside each other, with what their mean is sure to."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from data_synth.scenes import Scene
from motionlab.body import BodyModel
from motionlab.metrics import interval
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Observation2D
from motionlab.viz.movie import meshes
from motionlab.viz.palette import INK, LINE, ROLE, colour
from motionlab.viz.scene import Scene as Stage
from studies.nb05_testops.hard_cases import CMU, SYNTHETIC
from studies.shared.overlay import overlay
from studies.shared.plots import canvas, intervals, paints

_WOOD, _SKIN = "#b9a88f", to_rgb("#d9cbbd")


def seen_by(scene: Scene, label: str, frame: int, body: BodyModel | None = None, width: int = 620) -> np.ndarray:
    """Draws what the first clip's camera sees at a frame, with the detections on it: (H, W, 3) uint8. body: shows its
    skin instead of the mannequin."""
    truth, camera, seen = scene.truth.clip(0), scene.cameras[0], scene.clip(0)
    with Stage((width, round(width * camera.height / camera.width)), camera=camera) as stage:
        stage.floor()
        if body is None:
            stage.skeleton(truth, _SKIN, frame=frame)
        else:
            stage.body(body, truth, "truth", frame=frame)
        for vertices, faces in meshes(scene.occluders[0]):
            stage.mesh(vertices[0].numpy(), faces.numpy(), _WOOD)
        plain = stage.image()
    seen = Observation2D(seen.keypoints, seen.confidence, BODY_25, truth.fps, camera)
    picture = Image.fromarray(overlay(seen, plain, frame, width=3.5))
    ImageDraw.Draw(picture).text((10, 8), label, fill=INK, font=ImageFont.load_default(15))
    return np.asarray(picture)


def spectra(cases: Mapping[str, Mapping[str, Tensor]], edges: Sequence[float], *, roles: Mapping[str, str]) -> Figure:
    """Power over true power by band of frequency, a panel per case: medians over clips (B, bands) and quartiles."""
    fig, axes = canvas(1, len(cases), size=(4.2 * len(cases), 2.9), sharey=True)
    labels = [f"{a:g}-{b:g}" for a, b in pairwise(edges)]
    for ax, (name, series) in zip(axes, cases.items(), strict=True):
        paint = paints(list(series), roles)
        for k, (label, values) in enumerate(series.items()):
            x = np.arange(len(labels)) + 0.16 * (k - (len(series) - 1) / 2)
            low, mid, high = np.nanpercentile(values.numpy(), (25, 50, 75), axis=0)
            ax.errorbar(x, mid, (mid - low, high - mid), fmt="o", ms=5, color=paint[label], label=label, lw=1.5)
        ax.axhline(1, color=ROLE["truth"], lw=1.2)
        ax.set_xticks(range(len(labels)), labels)
        ax.set(title=name, xlabel="frequency (Hz)", yscale="log")
    axes[0].set_ylabel("power / true power")
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig


def grid(pictures: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Pictures of one size as one, row by row."""
    rows = [np.concatenate(pictures[i : i + columns], 1) for i in range(0, len(pictures), columns)]
    return np.concatenate(rows)


# ------------------------------------------------------------------------------------------------------------------ 05b
#: A colour for each source.
TONES = {SYNTHETIC: "ours", CMU: "real"}


def forest(rows: Mapping[str, Sequence[tuple[str, str, tuple]]], xlabels: Mapping[str, str]) -> Figure:
    """Draws differences with intervals: a panel per measure, a line per case, one colour per source.

    rows: measure -> (case, source, (mean, low, high, ...)).
    """
    panels: dict[str, dict[str, dict[str, tuple]]] = {xlabels[measure]: {} for measure in rows}
    for by, some in zip(panels.values(), rows.values(), strict=True):
        for case, source, found in some:
            by.setdefault(source, {})[case] = found
    fig, axes = intervals(panels, TONES, size=(3.4 * len(rows), 4.7))
    for ax in axes:
        ax.axvline(0, color=INK, lw=0.8)
    return fig


def arms(shares: Mapping[str, Mapping[str, float]], errors: Mapping[str, Mapping[str, tuple]]) -> Figure:
    """Draws by source and method the share of clips that sit, and the error of the legs with its interval."""
    sit = {source: {name: (x, x, x) for name, x in by.items()} for source, by in shares.items()}
    panels = {"share of clips that sit": sit, "error of the hidden legs (cm), mean and 95 % interval": errors}
    fig, axes = intervals(panels, TONES, size=(9.4, 3.4))
    axes[0].set_xlim(-0.03, 1.03)
    axes[1].set_xlim(left=0)
    return fig


def dose(found: Mapping[str, Mapping[str, Mapping[int, Tensor]]], ylabel: str) -> Figure:
    """Draws swing over the length of the failure: a panel per source, a curve per method, a dot per person (P,)."""
    fig, axes = canvas(1, len(found), size=(4.2 * len(found), 3.0), sharey=True)
    for ax, (source, methods) in zip(axes, found.items(), strict=True):
        for k, (label, by_lead) in enumerate(methods.items()):
            paint, leads = colour({"stage 3": "stage3"}.get(label, "stage2")), list(by_lead)
            for lead in leads:
                ax.scatter([lead + 0.5 * k] * len(by_lead[lead]), by_lead[lead], s=10, color=paint, alpha=0.45, lw=0)
            ends = [x + 0.5 * k for x in leads], [by_lead[n].nanmean().item() for n in leads]
            ax.plot(*ends, color=paint, label=label)
        ax.axhline(1.0, color=INK, lw=0.8)
        ax.axhline(0.5, color=LINE, lw=1.0, ls="--")
        ax.set(title=f"{source}, {len(next(iter(by_lead.values())))} people", xticks=leads)
        ax.set_xticklabels(["none" if n < 0 else str(n) for n in leads])
        ax.set(xlabel="frames of failure", ylim=(0, None))
    axes[0].set_ylabel(ylabel)
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig


def wrists(motions: Mapping[str, Motion], roles: Mapping[str, str], body: BodyModel) -> np.ndarray:
    """Draws bodies at the end of their clips, and the way of both wrists, a panel each."""
    with Stage((400 * len(motions), 420), panels=tuple(motions)).floor() as stage:
        for panel, (label, motion) in enumerate(motions.items()):
            role = roles.get(label, label)
            stage.body(body, motion, role, panel=panel)
            for side in ("left", "right"):
                stage.trail(motion, f"{side}_wrist", role, panel=panel)
        return stage.image(60.0)


# ------------------------------------------------------------------------------------------------------------------ 05c
#: Method -> role, and whether its mark is filled: the plain stage 2 has the colour of the tuned one, and a hollow mark.
METHODS = {"best filter": ("baseline", True), "stage 2": ("stage2", False), "tuned stage 2": ("stage2", True),
           "stage 3": ("stage3", True)}  # fmt: skip
Values = Mapping[str, Tensor]  # method -> one number (P,) a person or clip


def dots(ax: Axes, found: Values, generator: torch.Generator) -> None:
    """Draws a method per column: a faint dot for each value, the mean and its 95 % interval."""
    for x, (method, values) in enumerate(found.items()):
        role, filled = METHODS[method]
        paint, values = ROLE[role], values[values.isfinite()].double()
        spread = np.linspace(-0.16, 0.16, len(values)) if len(values) > 1 else np.zeros(1)
        ax.scatter(x + spread, values, s=9, color=paint, alpha=0.35, lw=0)
        mean, low, high = interval(values, "mean", generator)
        face = paint if filled else "white"
        ax.errorbar(x, mean, [[mean - low], [high - mean]], fmt="o", ms=7, color=paint, mfc=face, lw=2, zorder=3)
        ax.annotate(f"{mean:.1f}", (x, mean), (8, 3), textcoords="offset points", fontsize=9, zorder=4)
    names = [name.replace(" stage", "\nstage").replace(" filter", "\nfilter") for name in found]
    ax.set_xticks(range(len(found)), names)
    ax.set_xlim(-0.5, len(found) - 0.3)
    ax.grid(axis="x", visible=False)


def methods(
    rows: Sequence[Mapping[str, Values]], ylabels: Sequence[str], generator: torch.Generator, *, width: float = 2.9
) -> Figure:
    """Draws rows of panels (title -> method -> values); the panels of one row share their axis."""
    columns = max(len(row) for row in rows)
    fig, axes = canvas(len(rows), columns, size=(width * columns, 2.6 * len(rows)), sharey="row")
    for row, label, some in zip(rows, ylabels, axes.reshape(len(rows), columns), strict=True):
        for ax, (title, found) in zip(some, row.items(), strict=False):
            dots(ax, found, generator)
            ax.set_title(title)
        for ax in some[len(row) :]:
            ax.set_axis_off()
        some[0].set_ylim(0, 1.08 * max(float(x[x.isfinite()].max()) for found in row.values() for x in found.values()))
        some[0].set_ylabel(label)
    return fig


def errors_over_time(moments: Mapping[str, Mapping[str, Tensor]], fps: float) -> Figure:
    """Draws the error (V, T) of methods over time, a panel per moment: a thin line a view, a thick one their mean."""
    fig, axes = canvas(1, len(moments), size=(2.7 * len(moments), 2.9), sharey=True)
    for ax, (title, found) in zip(axes, moments.items(), strict=True):
        for method, curves in found.items():
            time, paint = np.arange(curves.shape[-1]) / fps, ROLE[METHODS[method][0]]
            ax.plot(time, curves.T, color=paint, lw=0.9, alpha=0.4)
            ax.plot(time, curves.mean(0), color=paint, lw=2.4, label=method)
        ax.set(title=title, xlabel="time (s)")
    axes[0].set_ylabel("joint error (cm)")
    axes[0].set_ylim(0, 1.05 * max(float(x.max()) for found in moments.values() for x in found.values()))
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig
