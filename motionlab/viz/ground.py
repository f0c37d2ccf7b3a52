"""What is below people: the floor's tiles, and the shadow that each body throws on them."""

from __future__ import annotations

import numpy as np
import pyvista as pv
from matplotlib.colors import to_rgb
from scipy.ndimage import gaussian_filter

from motionlab.viz.palette import PAPER, TILE, blend

_TILE = 0.5  # metres
_FLOOR_Z, _SHADOW_Z = -0.008, -0.003  # metres below the floor: soles stay on top, layers do not fight
_CELLS, _WIDTH = 144, 3.6  # cells of the square that carries a shadow; its least width, metres
_LIGHT = np.array([0.10, -0.16])  # metres a shadow moves sideways per metre of height


def floor_tiles(centre: np.ndarray, radius: float) -> pv.PolyData:
    """Builds a checkerboard of 0.5 m tiles on the world's grid that fades into the paper, colours in "paint"."""
    low = np.floor((np.asarray(centre[:2]) - radius) / _TILE).astype(int)
    step = _TILE / 2  # two cells per tile: a smoother fade
    cell = np.indices([2 * int(np.ceil(2 * radius / _TILE)) + 2] * 2).reshape(2, -1).T
    corner = low * _TILE + cell * step
    points = np.full((len(corner), 4, 3), _FLOOR_Z)
    points[..., :2] = corner[:, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * step
    odd = (low + cell // 2).sum(1, keepdims=True) % 2
    away = np.linalg.norm(corner + step / 2 - np.asarray(centre[:2]), axis=-1, keepdims=True) / radius
    fade = np.clip((away - 0.35) / 0.65, 0, 1)
    fade = fade * fade * (3 - 2 * fade)
    tile = np.where(odd, blend(TILE, "white", 0.75), to_rgb(TILE))
    rgb = (1 - fade) * tile + fade * np.array(to_rgb(PAPER))
    mesh = pv.PolyData.from_regular_faces(points.reshape(-1, 3), np.arange(4 * len(corner)).reshape(-1, 4))
    mesh.cell_data["paint"] = (255 * rgb).round().astype(np.uint8)
    return mesh


def _vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """A third of the area of the faces around each vertex, square metres (V,)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 6
    return np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(vertices))


def _darkness(points: np.ndarray, areas: np.ndarray, centre: np.ndarray, width: float = _WIDTH) -> np.ndarray:
    """How much light a surface keeps from the floor around ``centre``, (cells, cells) in 0..1, row = y.

    It is splatted on the floor with its area; what is high is blurred widely, what touches sharply: contact is visible.
    """
    height = np.clip(points[:, 2], 0, None)
    at = (points[:, :2] + height[:, None] * _LIGHT - centre[:2]) / width + 0.5
    cell = np.floor(at * _CELLS).astype(int)
    inside = ((cell >= 0) & (cell < _CELLS)).all(1)
    flat = np.where(inside, cell[:, 1] * _CELLS + cell[:, 0], 0)
    low, areas = np.exp(-((height / 0.18) ** 2)), areas * inside
    unit = (width / _CELLS) ** 2
    layers = []
    for share, sigma, gain in ((low, 0.022, 0.9), (1 - low, 0.075, 0.55)):
        splat = np.bincount(flat, areas * share, minlength=_CELLS**2).reshape(_CELLS, _CELLS) / unit
        layers.append(gain * gaussian_filter(splat, sigma * _CELLS / width, mode="constant", truncate=2.5))
    return 1 - np.exp(-sum(layers))


class Shadow:
    """A translucent square on the floor that follows one surface (V, 3), (F, 3); ``move`` redraws it in place."""

    def __init__(self, plotter: pv.Plotter, points: np.ndarray, faces: np.ndarray, strength: float) -> None:
        self.areas, self.strength = _vertex_areas(points, faces), strength
        self.width = max(_WIDTH, float(np.ptp(points[:, :2], axis=0).max()) + 1.5)
        self.square = pv.PolyData(np.zeros((4, 3)), [4, 0, 1, 2, 3])
        self.square.active_texture_coordinates = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
        self.pixels = pv.ImageData(dimensions=(_CELLS, _CELLS, 1))
        self.pixels.point_data.set_scalars(np.tile(np.array([36, 40, 52, 0], np.uint8), (_CELLS**2, 1)), "rgba")
        texture = pv.Texture(self.pixels)
        texture.interpolate = True
        self.actor = plotter.add_mesh(self.square, texture=texture, lighting=False, reset_camera=False)
        self.move(points)

    def move(self, points: np.ndarray) -> None:
        """Moves it to the surface's vertices (V, 3), world."""
        centre = (points[:, :2].min(0) + points[:, :2].max(0)) / 2
        alpha = 255 * self.strength * _darkness(points, self.areas, centre, self.width)
        self.pixels.point_data["rgba"][:, 3] = alpha.ravel()
        self.pixels.GetPointData().GetScalars().Modified()
        self.pixels.Modified()
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * self.width / 2 + centre
        self.square.points = np.column_stack((corners, np.full(4, _SHADOW_Z)))
