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
from studies.nb05_testops.hard_cases import SYNTHETIC
from studies.shared.plots import canvas


def forest(rows: Mapping[str, Sequence[tuple[str, str, tuple]]], xlabels: Mapping[str, str]) -> Figure:
    """Draws differences with intervals: a panel per measure, a line per case, one colour per source.

    rows: measure -> (case, source, (mean, low, high, ...)).
    """
    cases = list(dict.fromkeys(case for case, _, _ in next(iter(rows.values()))))
    fig, axes = canvas(1, len(rows), size=(3.4 * len(rows), 0.9 + 0.42 * len(cases)), sharey=True)
    for ax, (measure, some) in zip(axes, rows.items(), strict=True):
        for case, source, (mean, low, high, *_) in some:
            y = len(cases) - cases.index(case) + (0.14 if source == SYNTHETIC else -0.14)
            paint = colour("ours" if source == SYNTHETIC else "real")
            ax.plot((low, high), (y, y), color=paint, lw=2)
            ax.plot(mean, y, "o", color=paint, ms=5, label=source if case == cases[0] else None)
        ax.axvline(0, color=INK, lw=0.8)
        ax.set(xlabel=xlabels[measure])
    axes[0].set_yticks(range(len(cases), 0, -1), cases)
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return fig


def arms(shares: Mapping[str, Mapping[str, float]], errors: Mapping[str, Mapping[str, tuple]]) -> Figure:
    """Draws by source and method the share of clips that sit, and the error of the legs with its interval."""
    names = list(next(iter(shares.values())))
    fig, axes = canvas(1, 2, size=(9.4, 0.9 + 0.36 * len(names)), sharey=True)
    for source in shares:
        paint, up = (colour("ours"), 0.16) if source == SYNTHETIC else (colour("real"), -0.16)
        at = [len(names) - k + up for k in range(len(names))]
        axes[0].barh(at, [shares[source][name] for name in names], height=0.28, color=paint, label=source)
        for y, name in zip(at, names, strict=True):
            mean, low, high = errors[source][name]
            axes[1].plot((low, high), (y, y), color=paint, lw=2)
            axes[1].plot(mean, y, "o", color=paint, ms=5)
    axes[0].set_yticks(range(len(names), 0, -1), names)
    axes[0].set(xlabel="share of clips that sit", xlim=(0, 1.02))
    axes[1].set(xlabel="error of the hidden legs (cm), mean and 95 % interval", xlim=(0, None))
    axes[0].grid(axis="y", visible=False)
    axes[1].legend(*axes[0].get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(1.0, 1.0))
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
