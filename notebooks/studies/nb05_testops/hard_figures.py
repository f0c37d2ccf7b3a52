"""The figures of notebook 05b: differences by case, what sits, swing by length of a failure, what a camera sees."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from data_synth.scenes import Scene
from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.viz.movie import meshes
from motionlab.viz.palette import INK, LINE, colour
from motionlab.viz.scene import Scene as Scene3D
from studies.nb05_testops.figures import through_the_camera
from studies.nb05_testops.hard_cases import CMU, SYNTHETIC
from studies.shared.plots import canvas, intervals

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
            ax.plot(
                [x + 0.5 * k for x in leads], [by_lead[n].nanmean().item() for n in leads], color=paint, label=label
            )
        ax.axhline(1.0, color=INK, lw=0.8)
        ax.axhline(0.5, color=LINE, lw=1.0, ls="--")
        ax.set(title=f"{source}, {len(next(iter(by_lead.values())))} people", xticks=leads)
        ax.set_xticklabels(["none" if n < 0 else str(n) for n in leads])
        ax.set(xlabel="frames of failure", ylim=(0, None))
    axes[0].set_ylabel(ylabel)
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig


def seen_by(scene: Scene, label: str, frame: int, body: BodyModel) -> np.ndarray:
    """Draws what the first clip's camera sees at a frame, with the detections on it."""
    clip, things = scene.clip(0), meshes(scene.occluders[0])
    layer = {label: ("observation", clip.keypoints, clip.confidence)}
    how = {"things": things, "body": body, "width": 620}
    return through_the_camera(scene.truth.clip(0), scene.cameras[0], layer, frame, **how)


def wrists(motions: Mapping[str, Motion], roles: Mapping[str, str], body: BodyModel) -> np.ndarray:
    """Draws bodies at the end of their clips, and the way of both wrists, a panel each."""
    with Scene3D((400 * len(motions), 420), panels=tuple(motions)).floor() as scene:
        for panel, (label, motion) in enumerate(motions.items()):
            role = roles.get(label, label)
            scene.body(body, motion, role, panel=panel)
            for side in ("left", "right"):
                scene.trail(motion, f"{side}_wrist", role, panel=panel)
        return scene.image(60.0)
