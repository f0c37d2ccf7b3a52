"""The figures of notebook 09: draws as ghosts, regions around joints, and whether they hold what they promise."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pyvista as pv
from matplotlib.figure import Figure
from PIL import Image
from scipy.stats import binom
from torch import Tensor

from motionlab import viz
from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.posterior import Draws
from motionlab.viz import movie
from motionlab.viz.palette import INK, LINE, PAPER, ROLE, blend, colour
from motionlab.viz.scene import Scene
from studies.shared.plots import canvas, paints

REGION, AROUND = "axis-angle", ("left_ankle", "right_ankle")


def staged(
    draws: Draws, body: BodyModel, *, truth: Motion | None = None, things: Sequence[movie.Mesh] = (), ghosts: int = 6,
    level: float = 0.9, size: tuple[int, int] = (480, 420),
) -> Scene:  # fmt: skip
    """Puts a fit, some draws as ghosts and the regions of some hidden joints on a stage; beside it the truth, if known.

    Ghosts are laid on the fit's pelvis, as the regions are.
    """
    panels = ("truth", "fit, draws, regions")[0 if truth is not None else 1 :]
    scene = Scene((size[0] * len(panels), size[1]), panels=panels).floor()
    last = len(panels) - 1
    if truth is not None:
        scene.body(body, truth, "truth", panel=0)
    scene.body(body, draws.fit, "stage3", panel=last)
    pale = blend(colour("stage3"), PAPER, 0.35)
    for k in range(min(ghosts, len(draws.motions.root))):
        one = draws.motions.clip(k)
        one = Motion(one.skeleton, draws.fit.root, one.rot, one.fps)
        scene.body(body, one, pale, opacity=0.2, shadow=0, framed=False, panel=last)
    centre, shape = draws.places(level)
    for name in AROUND:
        joint = draws.fit.skeleton.index(name)
        hidden = shape[:, joint] * draws.hidden[:, joint, None, None]
        add_region(scene, centre[:, joint], hidden, draws.fit.fps, panel=last)
    for panel in range(len(panels)):
        for vertices, faces in things:
            scene.mesh(vertices[0].numpy(), faces.numpy(), "#b9a88f", opacity=0.3, framed=False, panel=panel)
    return scene


def add_region(scene: Scene, centres: np.ndarray, shapes: np.ndarray, fps: float, *, panel: int = 0) -> None:
    """Adds the region (x - c)^T S^-1 (x - c) <= 1 of centres c (T, 3) and shapes S (T, 3, 3), metres, as it moves;
    where S is zero there is none."""
    size, axes = np.linalg.eigh(np.asarray(shapes, float))
    roots = axes * np.sqrt(np.maximum(size, 0.0))[:, None]
    at, mesh = np.asarray(centres, float), pv.Sphere(radius=1.0, theta_resolution=24, phi_resolution=24)
    unit = np.array(mesh.points)
    scene.plotter.subplot(0, panel)
    look = {"lighting": False, "reset_camera": False, "render": False}
    scene.plotter.add_mesh(mesh, color=colour(REGION), opacity=0.4, **look)

    def update(seconds: float) -> None:
        now = int(np.clip(round(seconds * fps), 0, len(at) - 1))
        mesh.points = unit @ roots[now].T + at[now]

    scene.moving(update)


def picture(draws: Draws, body: BodyModel, seconds: float, **how) -> np.ndarray:
    """Draws one moment of :func:`staged`."""
    with staged(draws, body, **how) as scene:
        return scene.image(seconds)


def film(draws: Draws, body: BodyModel, path: Path, **how) -> movie.Film:
    """Writes :func:`staged` as a film of the motion's own rate."""
    fine, fps = 1 if viz.draft else 2, draws.fit.fps
    scene = staged(draws, body, size=(480 * fine, 420 * fine), **how)
    scene.smooth(False)
    with scene:
        clock, pictures = scene.caption(), []
        for now in movie.drawn(np.arange(draws.fit.frames) / fps):
            clock(f"{now:.1f} s")
            pictures.append(np.asarray(Image.fromarray(scene.image(float(now))).reduce(fine)))
    made = movie.write_film(pictures, path, fps * len(pictures) / draws.fit.frames, (draws.fit.frames - 1) / fps)
    return replace(made, poster=movie.jpeg(pictures[2 * len(pictures) // 3]))


def rank_bars(found: Mapping[str, Tensor], *, roles: Mapping[str, str]) -> Figure:
    """Draws ranks (C, n) of the truth among the draws, a panel each: flat where the sampler is right, a U: too sure.

    The band holds 95 % of the bars of a right one, were only the clips independent and a clip's ranks the same.
    """
    bins, (fig, axes) = 8, canvas(1, len(found), size=(3.0 * len(found) + 0.4, 2.7), sharey=True)
    paint = paints(list(found), roles)
    for ax, (label, ranks) in zip(axes, found.items(), strict=True):
        values, edges = ranks.flatten().numpy(), np.linspace(0, 1, bins + 1)
        ax.stairs(100 * np.histogram(values, edges)[0] / len(values), edges, color=(*paint[label], 0.55), fill=True)
        low, high = (100 * binom.ppf(q, len(ranks), 1 / bins) / len(ranks) for q in (0.025, 0.975))
        ax.axhspan(low, high, color=LINE, alpha=0.5, lw=0, zorder=0)
        ax.axhline(100 / bins, color=INK, lw=1, ls=":")
        ax.set(title=label, xlabel="rank of the true place")
    axes[0].set_ylabel("share (%)")
    return fig


def promises(held: Mapping[str, Mapping[str, Mapping[float, Tensor]]], roles: Mapping[str, str]) -> Figure:
    """Draws what regions held over what they promise, a row for each source and a panel for each kind: a dot a person
    (P,), means joined."""
    kinds = list(next(iter(held.values())))
    fig, axes = canvas(len(held), len(kinds), size=(9.6, 2.8 * len(held)), sharey=True, sharex=True)
    for ax, (source, kind) in zip(axes, product(held, kinds), strict=True):
        by_level, paint = held[source][kind], colour(roles[source])
        levels = [100 * level for level in by_level]
        ax.plot((0, 100), (0, 100), color=INK, lw=1, ls=":")
        for level, shares in zip(levels, by_level.values(), strict=True):
            shift = np.linspace(-2.5, 2.5, len(shares)) if len(shares) > 1 else 0.0
            ax.plot(level + shift, 100 * shares.sort().values, ".", ms=6, color=paint, alpha=0.45, mew=0)
        ax.plot(levels, [100 * shares.mean() for shares in by_level.values()], "o-", color=paint, ms=6)
        ax.set(title=f"{source}: {kind}" if kind == kinds[0] else kind, xlim=(42, 98), ylim=(-3, 103))
        ax.set(ylabel="held (%)" if kind == kinds[0] else "", xticks=levels, xlabel="promised (%)")
    return fig


def ridge(series: Mapping[str, Tensor], truth: Tensor, roles: Mapping[str, str]) -> Figure:
    """Draws (N, 5) of a camera by label: distance and focal length over what the fit assumed; truth (5,) black."""
    paint, (fig, (ax,)) = paints(list(series), roles), canvas(1, 1, size=(5.6, 4.2))
    for label, draws in series.items():
        x = draws[:: max(1, len(draws) // 1500)].exp()
        ax.plot(x[:, 1], x[:, 2], ".", ms=3, mew=0, alpha=0.4, color=paint[label], label=label)
    ax.plot(*truth[1:3].exp(), "+", ms=14, mew=2, color=ROLE["truth"], label="truth")
    ax.set(xlabel="distance over the assumed one", ylabel="focal length over the assumed one")
    legend = ax.legend(frameon=False)
    for dot in legend.legend_handles[:-1]:
        dot.set(markersize=8, alpha=1)
    return fig
