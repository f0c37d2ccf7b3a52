"""The figures of notebook 05: fits beside their truth, in the world, in the image and over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, Observation2D
from motionlab.viz.movie import Mesh, overlay
from motionlab.viz.palette import INK, LINE, ROLE, colour
from motionlab.viz.scene import Scene
from studies.shared.plots import canvas, paints

_WOOD, _SKIN = "#b9a88f", to_rgb("#d9cbbd")


def through_the_camera(
    truth: Motion,
    camera: Camera,
    layers: Mapping[str, tuple[str, Tensor, Tensor]],
    frame: int,
    *,
    things: Sequence[Mesh] = (),
    width: int = 460,
) -> np.ndarray:
    """What the camera sees, once per layer, with keypoints drawn over it: pictures side by side (H, W, 3) uint8.

    layers: label -> (role, pixels (T, 25, 2), confidence (T, 25)); the detections, or the landmarks of a fit.
    """
    size = (width, round(width * camera.height / camera.width))
    with Scene(size, camera=camera) as scene:
        scene.skeleton(truth, _SKIN, frame=frame).floor()
        for vertices, faces in things:
            scene.mesh(vertices[0].numpy(), faces.numpy(), _WOOD)
        plain = scene.image()
    drawn = []
    for label, (role, pixels, confidence) in layers.items():
        seen = Observation2D(pixels, confidence, BODY_25, truth.fps, camera)
        drawn.append(_labelled(overlay(seen, plain, frame, role, width=3.5), label))
    return np.concatenate(drawn, 1)


def on_paper(layers: Mapping[str, tuple[str, Tensor, Tensor]], frame: int, *, height: int = 380) -> np.ndarray:
    """As :func:`through_the_camera` where there is no picture: layers over blank paper, cut to where the points are."""
    sure = torch.cat([pixels[frame][confidence[frame] > 0] for _, pixels, confidence in layers.values()])
    low, high = sure.amin(0), sure.amax(0)
    margin = 0.12 * (high - low).max()
    scale = height / float((high - low)[1] + 2 * margin)
    blank = np.full((height, max(round(float((high - low)[0] + 2 * margin) * scale), 200), 3), 246, np.uint8)
    drawn = []
    for label, (role, pixels, confidence) in layers.items():
        seen = Observation2D((pixels - low + margin) * scale, confidence, BODY_25, 30.0)
        drawn.append(_labelled(overlay(seen, blank, frame, role, width=3.5), label))
    return np.concatenate(drawn, 1)


def _labelled(picture: np.ndarray, text: str) -> np.ndarray:
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((10, 8), text, fill=INK, font=ImageFont.load_default(15))
    return np.asarray(image)


def pairs(
    cases: Mapping[str, tuple[Tensor, Tensor]],
    *,
    ylabel: str,
    columns: int = 5,
    marks: Sequence[str] = ("stage 2", "stage 3"),
) -> Figure:
    """One panel per case: a line from every clip's value before (B,) to its value after, and the mean of each."""
    rows = -(-len(cases) // columns)
    fig, axes = canvas(rows, min(columns, len(cases)), size=(2.25 * min(columns, len(cases)), 2.7 * rows), sharey=True)
    before_role, after_role = ROLE["stage2"], ROLE["stage3"]
    for ax, (name, (before, after)) in zip(axes, cases.items(), strict=False):
        for a, b in zip(before.tolist(), after.tolist(), strict=True):
            ax.plot((0, 1), (a, b), color=LINE, lw=1.2, zorder=1)
        for x, values, paint in ((0, before, before_role), (1, after, after_role)):
            ax.scatter([x] * len(values), values, s=14, color=paint, zorder=2)
            ax.plot((x - 0.18, x + 0.18), [values.nanmean()] * 2, color=paint, lw=3, zorder=3)
        ax.set_title(name, fontsize=9)
        ax.set_xticks((0, 1), list(marks))
        ax.set_xlim(-0.4, 1.4)
        ax.grid(axis="x", visible=False)
    for ax in axes[len(cases) :]:
        ax.set_axis_off()
    for ax in axes[::columns]:
        ax.set_ylabel(ylabel)
    return fig


def gaps(
    increase: Mapping[tuple[str, str], Mapping[int, Tensor]], *, modes: Sequence[str], places: Sequence[str], roles
) -> Figure:
    """Error that a gap adds over its length: a panel per place, a curve per mode; a dot for every clip (B,)."""
    fig, axes = canvas(1, len(places), size=(3.2 * len(places), 2.9), sharey=True)
    for ax, place in zip(axes, places, strict=True):
        for mode in modes:
            found, paint = increase.get((mode, place), {}), colour(roles[mode])
            lengths = sorted(found)
            for length in lengths:
                ax.scatter([length] * len(found[length]), found[length], s=10, color=paint, alpha=0.45, lw=0)
            ax.plot(lengths, [found[n].nanmean().item() for n in lengths], color=paint, lw=1.8, label=mode)
        ax.axhline(0, color=INK, lw=0.8)
        ax.set(title=f"{place} missing", xlabel="frames without detections", xticks=lengths)
        ax.set_yscale("symlog", linthresh=1.0)
    axes[0].set_ylabel("later frames: error added (cm)")
    axes[0].legend()
    return fig


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
    axes[-1].legend()
    return fig


def stages_of(
    truth: Motion, stages: Mapping[int, Motion], index: int, keep: Sequence[int] = (2, 3)
) -> dict[str, Motion]:
    """One clip's truth and stages, as panels for :func:`side_by_side`."""
    return {"truth": truth.clip(index)} | {f"stage {k}": stages[k].clip(index) for k in keep}


def grid(pictures: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Pictures of one size as one, row by row."""
    rows = [np.concatenate(pictures[i : i + columns], 1) for i in range(0, len(pictures), columns)]
    return np.concatenate(rows)
