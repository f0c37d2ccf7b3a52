"""What scenes are made of, as VTK meshes: surfaces with our own normals, lines, cameras, light and titles."""

from __future__ import annotations

import numpy as np
import pyvista as pv
from scipy.sparse import csr_array
from torch import Tensor

from motionlab.observation import Camera
from motionlab.viz.palette import INK

#: The look of every solid: matt, a little light from everywhere, a soft gleam.
SKIN = {"ambient": 0.2, "diffuse": 0.8, "specular": 0.12, "specular_power": 20}


def array(x: Tensor) -> np.ndarray:
    """A tensor as a float64 array."""
    return x.detach().double().cpu().numpy()


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3): the area-weighted mean of the faces around each vertex."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    rows, columns = faces.T.ravel(), np.tile(np.arange(len(faces)), 3)
    around = csr_array((np.ones(rows.size), (rows, columns)), shape=(len(vertices), len(faces)))
    normals = around @ face
    return normals / (np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-20)


def surface(points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> pv.PolyData:
    """A mesh that keeps the given normals when its points move in place."""
    mesh = pv.PolyData.from_regular_faces(np.array(points, float), np.asarray(faces))
    mesh.point_data.active_normals = np.array(normals, float)
    return mesh


def reshape(mesh: pv.PolyData, points: np.ndarray, normals: np.ndarray) -> None:
    """Move a mesh in place: no new actor, no new topology."""
    mesh.points[:], mesh.point_data.active_normals[:] = points, normals
    mesh.GetPoints().GetData().Modified()
    mesh.GetPointData().GetNormals().Modified()
    mesh.Modified()


def add_surface(plotter: pv.Plotter, mesh: pv.PolyData, paint, opacity: float = 1.0) -> None:
    """Show a surface in one colour (r, g, b), or in a colour per vertex (V, 3) uint8."""
    if isinstance(paint, np.ndarray):
        mesh.point_data["paint"] = paint
        look = {"scalars": "paint", "rgb": True}
    else:
        look = {"color": paint}
    actor = plotter.add_mesh(mesh, opacity=opacity, reset_camera=False, **look, **SKIN)
    actor.prop.interpolation = "Phong"


def add_field(plotter: pv.Plotter, mesh: pv.PolyData, values: np.ndarray, title: str, limits, cmap: str) -> None:
    """Show a scalar per vertex on a surface, with a bar that names it."""
    mesh.point_data["field"] = values
    height = plotter.window_size[1]
    bar = {
        "title": title, "vertical": True, "position_x": 0.86, "position_y": 0.2, "width": 0.05, "height": 0.55,
        "title_font_size": max(height // 34, 9), "label_font_size": max(height // 38, 8), "color": INK,
        "n_labels": 3, "fmt": "%.2g",
    }  # fmt: skip
    actor = plotter.add_mesh(
        mesh, scalars="field", clim=limits, cmap=cmap, reset_camera=False, scalar_bar_args=bar, **SKIN
    )
    actor.prop.interpolation = "Phong"
    plotter.scalar_bars[title].SetVerticalTitleSeparation(8)


def polyline(path: np.ndarray) -> pv.PolyData:
    """One line through points (T, 3); a single point gives a line without length."""
    path = np.repeat(path, 2, axis=0) if len(path) == 1 else path
    return pv.PolyData(np.array(path, float), lines=[len(path), *range(len(path))])


def add_line(plotter: pv.Plotter, line: pv.PolyData, paint, width: float) -> None:
    """Show a line ``width`` pixels wide."""
    plotter.add_mesh(
        line, color=paint, line_width=width, render_lines_as_tubes=True, reset_camera=False, ambient=0.6, diffuse=0.4
    )


def add_frustum(plotter: pv.Plotter, camera: Camera, depth: float, picture, paint) -> np.ndarray:
    """Show a camera as its pyramid of view, ``picture`` (H, W, 3) on the base; returns tip and corners (5, 3)."""
    w, h = camera.width, camera.height
    pixels = np.array([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]], float)
    rays = pixels @ np.linalg.inv(array(camera.intrinsics)).T * depth  # (4, 3), camera axes
    tip = array(camera.centre)
    corners = rays @ array(camera.rotation) + tip
    base = pv.PolyData(corners, [4, 0, 1, 2, 3])
    if picture is None:
        plotter.add_mesh(base, color=paint, opacity=0.12, lighting=False, reset_camera=False)
    else:
        base.active_texture_coordinates = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)
        texture = pv.Texture(np.ascontiguousarray(np.asarray(picture)[..., :3]))
        plotter.add_mesh(base, texture=texture, lighting=False, reset_camera=False)
    every = np.vstack((tip, corners))
    edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
    add_line(plotter, pv.PolyData(every, lines=np.insert(np.array(edges), 0, 2, axis=1).ravel()), paint, 2)
    middle, up = corners[:2].mean(0), (corners[0] - corners[3]) * 0.12
    roof = np.array([middle + up, corners[0] * 0.6 + corners[1] * 0.4, corners[0] * 0.4 + corners[1] * 0.6])
    plotter.add_mesh(pv.PolyData(roof, [3, 0, 1, 2]), color=paint, lighting=False, reset_camera=False)
    return every


def light(plotter: pv.Plotter) -> None:
    """Three lights that travel with the eye: a warm key from the upper left, a cool fill, a rim from behind."""
    for position, tint, strength in (
        ((-1.4, 1.8, 2.0), "#fff6ea", 1.0),
        ((2.0, 0.3, 1.4), "#e6efff", 0.6),
        ((0.6, 1.6, -2.2), "#ffffff", 0.6),
    ):
        lamp = pv.Light(position=position, color=tint, light_type="camera light", intensity=strength)
        plotter.add_light(lamp, only_active=True)


def title(plotter: pv.Plotter, text: str, height: int) -> None:
    """A label above the panel."""
    plotter.add_text(text, position="upper_edge", font_size=max(round(height / 42), 7), color=INK, font="arial")


def caption(plotter: pv.Plotter, height: int):
    """A line of text in the lower left corner; set it with ``.set_text("lower_left", ...)``."""
    return plotter.add_text(" ", position="lower_left", font_size=max(round(height / 60), 6), color=INK, font="arial")


def add_label(plotter: pv.Plotter, point: np.ndarray, text: str, height: int) -> None:
    """A word at a point of the world, upright on the screen."""
    plotter.add_point_labels(
        point[None], [text], font_size=max(round(height / 22), 10), text_color=INK, font_family="arial", bold=False,
        show_points=False, shape=None, always_visible=True, reset_camera=False, justification_horizontal="center",
        justification_vertical="top",
    )  # fmt: skip
