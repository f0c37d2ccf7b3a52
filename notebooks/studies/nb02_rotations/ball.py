"""The ball of rotation vectors, radius pi: each point a rotation, opposite points of its surface the same one."""

import math
from collections.abc import Mapping

import numpy as np
import pyvista as pv
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.skeleton import UPRIGHT
from motionlab.viz.palette import INK, LINE, ROLE, blend
from motionlab.viz.scene import Scene

_LABEL = {
    "shape": None, "font_family": "arial", "text_color": INK, "always_visible": True, "show_points": False,
    "reset_camera": False,
}  # fmt: skip
_HIGH = 800  # pixels
_TUBE = {"smooth_shading": True, "specular": 0.2, "reset_camera": False}


def draw_ball(vectors: Mapping[str, Tensor], gap: int, *, azimuth: float, upto: float) -> np.ndarray:
    """Draws rotation vectors (T, 3) by role in the ball, as a picture (H, W, 3).

    A path is broken where it leaves the ball on one side and comes back on the other; both points are named. Its
    hidden frames are beads. The grey ring is an upright body in every heading.

    Args:
        gap: hidden frames, in the middle. upto: share of the path that is drawn strongly, with a head at its end.
    """
    with Scene((1000, _HIGH), azimuth=azimuth, elevation=24.0) as scene:
        scene.plotter.enable_depth_peeling(8)
        _add_ball(scene)
        for role, path in vectors.items():
            _add_path(scene.plotter, np.asarray(path, float), role, gap, upto)
        return scene.image()


def _add_ball(scene: Scene) -> None:
    """The ball, its lines of latitude and longitude, its axes, and the ring of upright bodies."""
    skin = pv.Sphere(radius=math.pi, theta_resolution=96, phi_resolution=96)
    scene.mesh(skin.points, skin.regular_faces, blend(ROLE["axis-angle"], "white", 0.6), opacity=0.16)
    plotter = scene.plotter
    around = np.linspace(0, 2 * math.pi, 121)
    ring = np.stack((np.cos(around), np.sin(around), 0 * around), -1)
    circles = [ring, ring[:, [0, 2, 1]], ring[:, [2, 0, 1]]]
    for circle in circles:
        plotter.add_mesh(pv.lines_from_points(math.pi * circle), color=LINE, line_width=1.5, reset_camera=False)
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        line = pv.lines_from_points(np.stack((-math.pi * axis, math.pi * axis)))
        plotter.add_mesh(line, color=LINE, line_width=1, reset_camera=False)
        plotter.add_point_labels([1.07 * math.pi * axis], [name], font_size=_HIGH // 44, **_LABEL)
    heading = torch.linspace(1e-4, math.tau - 1e-4, 241, dtype=torch.float64)
    upright = rotation.matrix_to_axis_angle(rotation.rotation_about("z", heading) @ UPRIGHT.double())
    line = pv.lines_from_points(upright.numpy()).tube(radius=0.018)
    plotter.add_mesh(line, color=ROLE["observation"], **_TUBE)


def _add_path(plotter: pv.Plotter, path: np.ndarray, role: str, gap: int, upto: float) -> None:
    """One path: strong up to now and pale after, with beads at its hidden frames, and where it leaves and re-enters."""
    now = max(1, round(upto * (len(path) - 1)))
    paint = ROLE[role]
    broken = np.flatnonzero(np.linalg.norm(np.diff(path, axis=0), axis=-1) > math.pi)
    thick = 0.055 if role == "truth" else 0.035
    pale = blend(paint, "white", 0.6)
    for part in np.split(np.arange(len(path)), broken + 1):
        for some, radius, tone in ((part[part <= now], thick, paint), (part[part >= now], 0.02, pale)):
            if len(some) > 1:
                plotter.add_mesh(pv.lines_from_points(path[some]).tube(radius=radius), color=tone, **_TUBE)
    first = (len(path) - gap) // 2
    bead = pv.Sphere(radius=0.1 if role == "truth" else 0.08)
    beads = pv.PolyData(path[first : first + gap]).glyph(geom=bead, scale=False, orient=False)
    plotter.add_mesh(beads, color=paint, **_TUBE)
    if upto < 1:
        plotter.add_mesh(pv.Sphere(radius=0.17, center=path[now]), color=paint, **_TUBE)
    for i in broken:
        ends = path[i : i + 2] / np.linalg.norm(path[i : i + 2], axis=-1, keepdims=True)
        words = ["leaves here", "comes back here:\nthe same rotation"]
        plotter.add_point_labels(3.6 * ends, words, font_size=_HIGH // 42, **_LABEL)
