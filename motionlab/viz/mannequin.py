"""The figure of a skeleton: rigid solids around its bones; the surfaces, lights and words of a scene;
the floor's tiles, and the shadow that each body throws on them."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyvista as pv
import torch
from matplotlib.colors import to_rgb
from scipy.ndimage import gaussian_filter
from torch import Tensor
from vtkmodules.vtkCommonCore import vtkInformation
from vtkmodules.vtkRenderingOpenGL2 import vtkOpenGLActor

from motionlab.body import vertex_normals
from motionlab.skeleton import STANDARD, Skeleton
from motionlab.viz.palette import INK, PAPER, TILE, blend, side_of, sides

_DEEPER = 60.0  # steps of the depth buffer, about a centimetre
_SIDES, _ROUND = 16, np.linspace(0, np.pi / 2, 5)
#: Radii in metres at both ends of the bone that ends in a joint, and its belly; for a person of 1.7 m.
_MANNEQUIN = {"hip": (0.075, 0.08, 0.0), "knee": (0.078, 0.046, 0.006), "ankle": (0.045, 0.029, 0.014),
              "spine1": (0.108, 0.103, 0.0), "spine2": (0.103, 0.104, 0.0), "spine3": (0.104, 0.106, 0.0),
              "neck": (0.06, 0.045, 0.0), "head": (0.045, 0.042, 0.0), "collar": (0.05, 0.05, 0.0),
              "shoulder": (0.048, 0.052, 0.0), "elbow": (0.048, 0.033, 0.005),
              "wrist": (0.034, 0.022, 0.006)}  # fmt: skip
#: The look of every solid: matt, a little light from everywhere, a soft gleam.
SKIN = {"ambient": 0.2, "diffuse": 0.8, "specular": 0.12, "specular_power": 20}
_TILE = 0.5  # metres
_FLOOR_Z, _SHADOW_Z = -0.008, -0.003  # metres below the floor: soles stay on top, layers do not fight
_CELLS, _WIDTH = 144, 3.6  # cells of the square that carries a shadow; its least width, metres
_LIGHT = np.array([0.10, -0.16])  # metres a shadow moves sideways per metre of height


@dataclass(frozen=True, eq=False)
class Figure:
    """Solids in the frames of their joints.

    vertices (V, 3): metres, in the frame of joint[v]. faces (F, 3). colours (V, 3) uint8.
    """

    vertices: np.ndarray
    faces: np.ndarray
    joint: np.ndarray
    colours: np.ndarray

    def pose(self, positions: np.ndarray, orientations: np.ndarray) -> np.ndarray:
        """Computes world vertices (V, 3) for joint positions (J, 3) and orientations (J, 3, 3): R_joint v + p_joint."""
        return np.einsum("vij,vj->vi", orientations[self.joint], self.vertices) + positions[self.joint]


def _lathe(start, end, along, radius, widen=1.0):
    """A surface of revolution about start -> end: ``along`` in metres on the axis, ``radius`` there; x times widen."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = np.linalg.norm(end - start)
    axis = (end - start) / length if length > 0 else np.array([0.0, 1.0, 0.0])  # a bone of no length is a ball
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
    vertices = start + along[:, None, None] * axis + radius[:, None, None] * ring
    middle = (start + end)[0] / 2
    vertices[..., 0] = middle + (vertices[..., 0] - middle) * widen
    k, i = np.meshgrid(np.arange(len(along) - 1), np.arange(_SIDES), indexing="ij")
    a, b = k * _SIDES + i, k * _SIDES + (i + 1) % _SIDES
    faces = np.stack((a, b, a + _SIDES, b, b + _SIDES, a + _SIDES), -1).reshape(-1, 3)
    return vertices.reshape(-1, 3), faces


def _limb(start, end, r0: float, r1: float, bulge: float = 0.0, widen: float = 1.0):
    """A bone from ``start`` to ``end`` with round ends of radius r0 and r1 and a belly ``bulge`` metres high."""
    length = float(np.linalg.norm(np.subtract(end, start)))
    s = np.linspace(0, 1, 7)[1:-1]
    along = np.concatenate((-r0 * np.cos(_ROUND), s * length, length + r1 * np.sin(_ROUND)))
    belly = (1 - s) * r0 + s * r1 + bulge * np.sin(np.pi * s**0.7)
    return _lathe(start, end, along, np.concatenate((r0 * np.sin(_ROUND), belly, r1 * np.cos(_ROUND))), widen)


def _ellipsoid(centre, radii):
    """An ellipsoid with its axes along the frame's: vertices, faces."""
    turn = np.linspace(0, np.pi, 17)
    vertices, faces = _lathe((0, 0, 0), (0, 1, 0), -np.cos(turn), np.sin(turn))
    return vertices * np.asarray(radii) + np.asarray(centre), faces


def _mannequin(skeleton: Skeleton, offsets: np.ndarray):
    size = np.linalg.norm(offsets[1:], axis=-1).sum() / STANDARD.offsets[1:].norm(dim=-1).sum().item()
    for j, name in enumerate(skeleton.names[1:], start=1):
        part = name.split("_")[-1]
        if part in _MANNEQUIN:
            r0, r1, bulge = (size * r for r in _MANNEQUIN[part])
            yield skeleton.parents[j], side_of(name), _limb((0, 0, 0), offsets[j], r0, r1, bulge)
    extra = [
        ("pelvis", (0, -0.01, -0.01), (0.155, 0.105, 0.11)),
        ("spine3", (0, 0.115, 0.008), (0.155, 0.2, 0.11)),
        ("head", (0, 0.035, 0.025), (0.078, 0.118, 0.098)),
        ("left_wrist", (0.085, -0.002, 0.004), (0.088, 0.019, 0.042)),
        ("right_wrist", (-0.085, -0.002, 0.004), (0.088, 0.019, 0.042)),
        ("left_shoulder", (0, 0, 0), (0.058, 0.058, 0.058)),
        ("right_shoulder", (0, 0, 0), (0.058, 0.058, 0.058)),
    ]
    for name, centre, radii in extra:
        yield skeleton.index(name), side_of(name), _ellipsoid(np.multiply(centre, size), np.multiply(radii, size))
    for side in ("left", "right"):
        ankle, ball = skeleton.index(f"{side}_ankle"), skeleton.index(f"{side}_foot")
        x, y, z = offsets[ball]
        ground, toe = y - skeleton.sole, max(skeleton.sole, 0.008 * size)
        heel_r = 0.026 * size
        heel, tip = (0.0, ground + heel_r, -0.03 * size), (x, ground + toe, z)
        yield ankle, side, _limb(heel, tip, heel_r, toe, widen=1.6)
        yield ankle, side, _limb((0, 0, 0), heel, 0.032 * size, heel_r)
        high = toe - skeleton.sole
        yield ball, side, _limb((0, high, 0), (x / 3, high, 0.055 * size), toe, toe, 0, 2.6)


def _any_body(skeleton: Skeleton, offsets: np.ndarray):
    rest = skeleton.rest_positions().reshape(-1, 3)
    height = float((rest.amax(0) - rest.amin(0)).max()) or 1.0
    leaves = set(range(len(skeleton))) - set(skeleton.parents)
    for j, name in enumerate(skeleton.names[1:], start=1):
        length = float(np.linalg.norm(offsets[j]))
        if length < 1e-3 * height:
            continue
        end = np.divide(offsets[j], length)
        parent = skeleton.names[skeleton.parents[j]].lower()
        if "head" in parent and "fore" not in parent:
            yield skeleton.parents[j], "middle", _limb(0.3 * offsets[j], 0.7 * offsets[j], 0.4 * length, 0.36 * length)
            continue
        r = min(0.06 * (length * height) ** 0.5, 0.3 * length)
        yield skeleton.parents[j], side_of(name), _limb((0, 0, 0), offsets[j], r, 0.6 * r, 0.12 * r)
        if "head" in name.lower() and j in leaves:
            r = 0.05 * height
            yield j, "middle", _limb(0.3 * r * end, 1.5 * r * end, r, 0.9 * r)


@lru_cache(maxsize=16)  # a strip shows one skeleton many times
def build(skeleton: Skeleton, base: str | tuple) -> Figure:
    """Builds a figure in three tones of a colour for any skeleton: a mannequin for the standard joints, else bones.

    Radii follow the lengths of the bones; the soles of the mannequin lie ``skeleton.sole`` below its balls.
    """
    offsets = skeleton.offsets.detach().double().reshape(-1, len(skeleton), 3)[0].cpu().numpy()
    tones = sides(base)
    mannequin = skeleton.names == STANDARD.names
    parts = list((_mannequin if mannequin else _any_body)(skeleton, offsets))
    joints, where, solids = zip(*parts or [(0, "middle", _ellipsoid((0, 0, 0), (0.05, 0.05, 0.05)))], strict=True)
    counts = [len(v) for v, _ in solids]
    joint, colours = np.repeat(joints, counts), np.repeat([tones[side] for side in where], counts, axis=0)
    vertices = np.concatenate([v for v, _ in solids])
    if mannequin:  # a light visor: which way the head looks
        head = joint == skeleton.index("head")
        local = (vertices - (vertices[head].max(0) + vertices[head].min(0)) / 2) / np.ptp(vertices[head], axis=0) * 2
        face = np.clip((local[:, 2] - 0.45) / 0.3, 0, 1) * np.clip((0.75 - np.abs(local[:, 1])) / 0.3, 0, 1) * head
        colours += 0.75 * face[:, None] * (1 - colours)
    first = np.cumsum([0, *counts[:-1]])
    faces = np.concatenate([f + i for i, (_, f) in zip(first, solids, strict=True)])
    return Figure(vertices, faces, joint, (255 * colours).round().astype(np.uint8))


def array(x: Tensor) -> np.ndarray:
    """Returns a tensor as a float64 array."""
    return x.detach().double().cpu().numpy()


def surface(points: np.ndarray, faces: np.ndarray) -> pv.PolyData:
    """Builds a mesh with normals."""
    mesh = pv.PolyData.from_regular_faces(points, faces)
    move_surface(mesh, points)
    return mesh


def move_surface(mesh: pv.PolyData, points: np.ndarray) -> None:
    """Moves a mesh in place: no new actor, no new topology."""
    mesh.points = points
    normals = vertex_normals(torch.as_tensor(points), torch.as_tensor(mesh.regular_faces))
    mesh.point_data.active_normals = normals.numpy()


def add_surface(plotter: pv.Plotter, mesh: pv.PolyData, paint, opacity: float = 1.0) -> pv.Actor:
    """Shows a surface in one colour (r, g, b), or in a colour per vertex (V, 3) uint8; returns its actor."""
    look = {"color": paint}
    if isinstance(paint, np.ndarray):
        mesh.point_data["paint"], look = paint, {"scalars": "paint", "rgb": True}
    shares = [1.0] if opacity == 1 else [1e-3, opacity]
    layers = [plotter.add_mesh(mesh, opacity=share, reset_camera=False, **look, **SKIN) for share in shares]
    if opacity != 1:  # first its depth alone, so that nothing inside or behind shows through
        deep = vtkInformation()
        deep.Set(vtkOpenGLActor.GLDepthMaskOverride(), 1)
        layers[0].SetPropertyKeys(deep)
        for layer in layers:  # and a little deeper than it is, so that it does not paint what is in its place
            layer.mapper.SetResolveCoincidentTopologyToPolygonOffset()
            layer.mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(0.0, _DEEPER)
    layers[-1].prop.interpolation = "Phong"
    return layers[-1]


def add_field(plotter: pv.Plotter, mesh: pv.PolyData, values: np.ndarray, title: str, limits, cmap: str) -> pv.Actor:
    """Shows a scalar per vertex on a surface, with a bar that names it."""
    mesh.point_data["field"] = values
    high = plotter.window_size[1]
    bar = {"title": title, "vertical": True, "position_x": 0.86, "position_y": 0.2, "width": 0.05, "height": 0.55,
           "title_font_size": max(high // 34, 9), "label_font_size": max(high // 38, 8), "color": INK,
           "n_labels": 3, "fmt": "%.2g"}  # fmt: skip
    look = {"scalars": "field", "clim": limits, "cmap": cmap, "scalar_bar_args": bar}
    actor = plotter.add_mesh(mesh, reset_camera=False, **look, **SKIN)
    actor.prop.interpolation = "Phong"
    plotter.scalar_bars[title].SetVerticalTitleSeparation(8)
    return actor


def add_lights(plotter: pv.Plotter) -> None:
    """Adds three lights that travel with the eye: a warm key from the upper left, a cool fill, a rim from behind."""
    lamps = [((-1.4, 1.8, 2.0), "#fff6ea", 1.0), ((2.0, 0.3, 1.4), "#e6efff", 0.6), ((0.6, 1.6, -2.2), "#ffffff", 0.6)]
    for position, tint, strength in lamps:
        lamp = pv.Light(position=position, color=tint, light_type="camera light", intensity=strength)
        plotter.add_light(lamp, only_active=True)


def add_words(plotter: pv.Plotter, text: str, place: str, size: float):
    """Adds text at a place of the panel, such as "lower_left", so many points high; returns its actor."""
    return plotter.add_text(text, position=place, font_size=round(size), color=INK, font="arial")


def floor_tiles(centre: np.ndarray, radius: float) -> pv.PolyData:
    """Builds a checkerboard of 0.5 m tiles on the world's grid that fades into the paper, colours in "paint"."""
    low, across = np.floor((np.asarray(centre) - radius) / _TILE), int(np.ceil(2 * radius / _TILE)) + 1
    middle, cells = (low + across / 2) * _TILE, 2 * across  # two cells per tile: a smoother fade
    side = {"i_size": across * _TILE, "j_size": across * _TILE, "i_resolution": cells, "j_resolution": cells}
    mesh = pv.Plane(center=(*middle, _FLOOR_Z), direction=(0, 0, 1), **side)
    at = mesh.cell_centers().points[:, :2]
    odd = np.floor(at / _TILE).sum(1, keepdims=True) % 2
    away = np.linalg.norm(at - np.asarray(centre), axis=-1, keepdims=True) / radius
    fade = np.clip((away - 0.35) / 0.65, 0, 1)
    fade = fade * fade * (3 - 2 * fade)
    tile = np.where(odd, blend(TILE, "white", 0.75), to_rgb(TILE))
    rgb = (1 - fade) * tile + fade * np.array(to_rgb(PAPER))
    mesh.cell_data["paint"] = (255 * rgb).round().astype(np.uint8)
    return mesh


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
        a, b, c = (points[faces[:, i]] for i in range(3))
        third = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 6
        self.areas = np.bincount(faces.ravel(), np.repeat(third, 3), minlength=len(points))  # about each vertex, m^2
        self.strength = strength
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
