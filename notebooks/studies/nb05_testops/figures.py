"""The figures of notebooks 05a and 05b: fits beside their truth, in the world, in the image and over time."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, Observation2D
from motionlab.viz.movie import Mesh, overlay
from motionlab.viz.palette import INK, ROLE
from motionlab.viz.scene import Scene
from studies.shared.plots import canvas, paints

_WOOD, _SKIN = "#b9a88f", to_rgb("#d9cbbd")


def through_the_camera(
    truth: Motion, camera: Camera, layers: Mapping[str, tuple[str, Tensor, Tensor]], frame: int, *,
    things: Sequence[Mesh], width: int, body: BodyModel | None = None,
) -> np.ndarray:  # fmt: skip
    """What the camera sees, once per layer, with keypoints drawn over it: pictures side by side (H, W, 3) uint8.

    layers: label -> (role, pixels (T, 25, 2), confidence (T, 25)); the detections, or the landmarks of a fit. body:
    shows its skin instead of the mannequin.
    """
    size = (width, round(width * camera.height / camera.width))
    with Scene(size, camera=camera) as scene:
        scene.floor()
        if body is None:
            scene.skeleton(truth, _SKIN, frame=frame)
        else:
            scene.body(body, truth, "truth", frame=frame)
        for vertices, faces in things:
            scene.mesh(vertices[0].numpy(), faces.numpy(), _WOOD)
        plain = scene.image()
    drawn = []
    for label, (role, pixels, confidence) in layers.items():
        seen = Observation2D(pixels, confidence, BODY_25, truth.fps, camera)
        picture = Image.fromarray(overlay(seen, plain, frame, role, width=3.5))
        ImageDraw.Draw(picture).text((10, 8), label, fill=INK, font=ImageFont.load_default(15))
        drawn.append(np.asarray(picture))
    return np.concatenate(drawn, 1)


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
