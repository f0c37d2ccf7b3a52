"""A scene: figures, bodies, things and trails over a floor, seen through one window, moving in sync.

>>> scene = Scene().floor().skeleton(motion, "ours").trail(motion, "left_wrist")  # doctest: +SKIP
>>> scene.image(seconds=0.5)  # doctest: +SKIP

Importing this module chooses, once, which window VTK draws into: quiet where there is no display.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache, partial

import numpy as np
import pyvista as pv
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from motionlab import viz
from motionlab.body import BodyModel, lbs
from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.observation import Camera
from motionlab.tailoring import tailored
from motionlab.viz import mannequin, viewpoint
from motionlab.viz.palette import LINE, PAPER, TILE, blend, colour

# It comes with CUDA builds of torch. Loaded after Mesa's LLVM, it kills the process.
with contextlib.suppress(ImportError, OSError):
    importlib.import_module("triton._C.libtriton")

_TILE = 0.5  # metres
_FLOOR_Z, _SHADOW_Z = -0.008, -0.003  # metres below the floor: soles stay on top, layers do not fight
_CELLS, _WIDTH = 144, 3.6  # cells of the square that carries a shadow; its least width, metres
_LIGHT = np.array([0.10, -0.16])  # metres a shadow moves sideways per metre of height
#: What gives Debian and Ubuntu a window to draw into.
RENDERING_PACKAGES = "libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libglx-mesa0 libxrender1"
RENDERING_REMEDY = f"apt-get update && apt-get install -y {RENDERING_PACKAGES}"
_WINDOWS = {"libEGL.so.1": "vtkEGLRenderWindow", "libOSMesa.so.8": "vtkOSOpenGLRenderWindow"}


def _prepare_offscreen() -> None:
    """Without a display, choose EGL (else OSMesa) before VTK tries X and writes about it to stderr."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        window = next((name for library, name in _WINDOWS.items() if _opens(library)), None)
        if window:
            os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", window)


def _opens(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


_prepare_offscreen()


class Scene:
    """One window with one panel, or several side by side; what adds to it returns it, so calls chain.

    Args:
        size: width and height of the window in pixels; a camera's own size by default, else 640 x 480.
        panels: a label above each panel.
        camera: see exactly what this pinhole camera sees; else the eye frames everything that moves.
        azimuth, elevation: degrees of the eye around and above the subject; azimuth from the motion by default.
        follow: the eye travels with the subject instead of standing far enough away.
        footroom: share of the picture left free below.

    Time is in seconds, so motions of different frame rates stay in sync; past its end a motion holds still.
    A ``role`` is a name of ``palette.ROLE`` or a colour (r, g, b) in 0..1.

    Raises:
        ShapeError: the size has another shape than the camera's image.
    """

    def __init__(
        self,
        size: tuple[int, int] | None = None,
        *,
        panels: Sequence[str] = ("",),
        camera: Camera | None = None,
        azimuth: float | None = None,
        elevation: float = 11.0,
        follow: bool = False,
        footroom: float = 0.04,
    ) -> None:
        size = size or ((camera.width, camera.height) if camera else (640, 480))
        if camera and abs(size[0] / len(panels) * camera.height / camera.width - size[1]) > 1:
            raise ShapeError(f"size: expected the shape of the camera's {camera.width} x {camera.height}, got {size}")
        self.size, self.panels, self.camera = size, tuple(panels), camera
        self.azimuth, self.elevation, self.follow, self.footroom = azimuth, elevation, follow, footroom
        self.seconds = 0.0
        self.plotter = pv.Plotter(
            shape=(1, len(panels)), off_screen=True, window_size=list(size), border=False, lighting="none"
        )
        if viz.draft:
            self.plotter.render_window.SetMultiSamples(0)
        self._updates: list[Callable[[float], None]] = []
        self._figures: dict[int, tuple[list[np.ndarray], int]] = {}  # panel -> what moves its last one, place in _seen
        self._exchanged = 0  # times a figure got another motion
        self._eyes: dict[int, tuple] = {}  # panel -> where its eye was put and what it looks at
        self._seen: list[list[tuple[np.ndarray, float]]] = [[] for _ in panels]  # paths (T, M, 3) and their fps
        self._left: np.ndarray | None = None
        self._floors: set[int] = set()
        self._framing: viewpoint.Framing | None = None
        for index, label in enumerate(panels):
            plotter = self._panel(index)
            plotter.set_background(PAPER)
            if not viz.draft:
                plotter.enable_anti_aliasing("ssaa", all_renderers=False)
            mannequin.add_lights(plotter)
            if label:
                mannequin.add_title(plotter, label, size[1])

    def _panel(self, panel: int) -> pv.Plotter:
        if not 0 <= panel < len(self.panels):
            raise IndexError(f"panel {panel}: the scene has {len(self.panels)}")
        self.plotter.subplot(0, panel)
        return self.plotter

    def _watch(self, panel: int, path: np.ndarray, fps: float = 1.0) -> Scene:
        self._seen[panel].append((path, fps))
        self._framing = None
        return self

    def floor(self, panel: int | None = None) -> Scene:
        """Adds a checkerboard of 0.5 m tiles at z = 0 in one panel, or in all."""
        self._floors |= set(range(len(self.panels))) if panel is None else {panel}
        self._framing = None
        return self

    def skeleton(
        self, motion: Motion, role: str | tuple = "ours", *, frame: int | None = None, shadow=0.42, panel: int = 0
    ) -> Scene:
        """Adds a figure with volume, its left side light and its right side dark.

        ``frame`` holds one frame; by default the figure moves with the scene's time. ``shadow`` is how dark its
        shadow is, 0 for none.
        """
        figure = mannequin.build(mannequin.single(motion).skeleton, colour(role))
        world = list(map(mannequin.array, motion.world))

        def shape(index: int) -> tuple[np.ndarray, np.ndarray]:
            return figure.pose(world[0][index], world[1][index])

        def show(plotter: pv.Plotter, mesh: pv.PolyData) -> pv.Actor:
            return mannequin.add_surface(plotter, mesh, figure.colours)

        self._surface(motion, shape, figure.faces, show, frame, shadow, panel)
        if frame is None:
            self._figures[panel] = (world, len(self._seen[panel]) - 1)
        return self

    def exchange(self, motion: Motion, *, panel: int = 0) -> Scene:
        """Puts another motion, of the same skeleton and length, into a panel's last figure; nothing is built anew.

        Raises:
            ShapeError: other joints, or more or fewer frames.
        """
        (world, place), now = self._figures[panel], list(map(mannequin.array, mannequin.single(motion).world))
        if world[0].shape != now[0].shape:
            raise ShapeError(f"motion: expected places {world[0].shape} as of the figure, got {now[0].shape}")
        world[:] = now
        self._exchanged += 1
        self._seen[panel][place] = (now[0], motion.fps)
        self._framing = None
        return self

    def body(
        self,
        body: BodyModel,
        motion: Motion,
        role: str | tuple = "ours",
        *,
        field: Tensor | None = None,
        title: str = "",
        limits: tuple[float, float] | None = None,
        cmap: str = "viridis",
        frame: int | None = None,
        shadow: float = 0.42,
        panel: int = 0,
        shown: Sequence[bool] | None = None,
    ) -> Scene:
        """Adds the skin of a body moved by a motion; a ``field`` (V,) is painted on it, with a bar named ``title``.

        ``shown`` says in which of the motion's frames there is somebody; by default in all.
        """
        paint = blend(colour(role), "white", 0.3)
        faces = body.faces.cpu().numpy()
        mannequin.single(motion)

        def show(plotter: pv.Plotter, mesh: pv.PolyData) -> pv.Actor | None:
            if field is None:
                return mannequin.add_surface(plotter, mesh, paint)
            return mannequin.add_field(plotter, mesh, mannequin.array(field), title, limits, cmap)

        return self._surface(motion, partial(_skin, body, motion), faces, show, frame, shadow, panel, shown)

    def _surface(self, motion, shape, faces, show, frame, shadow, panel, there=None) -> Scene:
        if frame is not None and not -motion.frames <= frame < motion.frames:
            raise IndexError(f"frame {frame}: the motion has {motion.frames}")
        plotter, positions = self._panel(panel), mannequin.array(motion.positions)
        shown = 0 if frame is None else frame % motion.frames
        drawn = (shown, self._exchanged)
        if self._left is None:
            self._left = viewpoint.left_of(motion.cut(shown, shown + 1))
        points, normals = shape(shown)
        mesh = mannequin.surface(points, faces, normals)
        shade = _Shadow(plotter, points, faces, shadow) if shadow else None
        actors = [show(plotter, mesh), *([shade.actor] if shade else [])]

        def update(seconds: float) -> None:
            nonlocal drawn
            index = int(np.clip(round(seconds * motion.fps), 0, motion.frames - 1))
            if there is not None:
                for actor in actors:
                    actor.SetVisibility(bool(there[index]))
            if (index, self._exchanged) != drawn:
                drawn = (index, self._exchanged)
                points, normals = shape(index)
                mannequin.move_surface(mesh, points, normals)
                if shade:
                    shade.move(points)

        if frame is None:
            self._updates.append(update)
            update(self.seconds)
            return self._watch(panel, positions, motion.fps)
        return self._watch(panel, positions[shown][None])

    def mesh(
        self, vertices, faces, paint: str | tuple = LINE, *, fps: float = 30.0, opacity=1.0, shadow=0.0, panel: int = 0
    ) -> Scene:
        """Adds a mesh of faces (F, 3) that stands still, (V, 3) metres, or moves, (T, V, 3) at ``fps``: a table."""
        path, faces, plotter = np.asarray(vertices, float), np.asarray(faces), self._panel(panel)
        path = path[None] if path.ndim == 2 else path
        shade = None
        if shadow:
            from trimesh import remesh  # half a second, and a film of people has no mesh

            fine, finer = (path[0], faces) if len(path) > 1 else remesh.subdivide_to_size(path[0], faces, max_edge=0.08)
            shade = _Shadow(plotter, fine, finer, shadow)
        mesh = pv.PolyData.from_regular_faces(path[0].copy(), faces)
        plotter.add_mesh(mesh, color=paint, opacity=opacity, reset_camera=False, **mannequin.SKIN)

        def update(seconds: float) -> None:
            mesh.points = path[int(np.clip(round(seconds * fps), 0, len(path) - 1))]
            if shade:
                shade.move(mesh.points)

        if len(path) > 1:
            self._updates.append(update)
        return self._watch(panel, path, fps)

    def points(self, points, role: str | tuple = "observation", *, radius: float = 0.02, panel: int = 0) -> Scene:
        """Adds still markers at (N, 3) metres."""
        at = np.asarray(points, float)
        ball = pv.Sphere(radius=radius, theta_resolution=24, phi_resolution=24)
        balls = pv.PolyData(at).glyph(geom=ball, scale=False, orient=False)
        self._panel(panel).add_mesh(balls, color=colour(role), reset_camera=False, **mannequin.SKIN)
        return self._watch(panel, at[None])

    def trail(self, motion: Motion, joint: str, role: str | tuple = "ours", *, panel: int = 0) -> Scene:
        """Adds the path of a joint: pale as a whole, strong up to now."""
        path = mannequin.array(mannequin.single(motion).positions[:, motion.skeleton.index(joint)])
        plotter, paint, line = self._panel(panel), colour(role), mannequin.polyline(path)
        mannequin.add_line(plotter, mannequin.polyline(path), blend(paint, PAPER, 0.6), 2)
        mannequin.add_line(plotter, line, paint, 5)

        def update(seconds: float) -> None:
            now = int(np.clip(round(seconds * motion.fps), 0, len(path) - 1))
            line.points = path[np.minimum(np.arange(line.n_points), now)]

        self._updates.append(update)
        update(self.seconds)
        return self._watch(panel, path[:, None], motion.fps)

    def caption(self) -> Callable[[str], None]:
        """Adds a line of text in the lower left corner; returns the function that sets it."""
        text = mannequin.add_caption(self._panel(0), self.size[1])
        return lambda words: text.set_text("lower_left", words)

    def label(self, point, text: str, *, panel: int = 0) -> Scene:
        """Adds a word that stays upright at a point (3,) of the world."""
        mannequin.add_label(self._panel(panel), np.asarray(point, float), text, self.size[1])
        return self

    def _arrange(self) -> None:
        width, height = self.size
        self._framing = viewpoint.choose_framing(
            self._seen,
            aspect=width / len(self.panels) / height,
            azimuth=self.azimuth,
            elevation=self.elevation,
            left=self._left,
            follow=self.follow,
            headroom=0.11 if any(self.panels) else 0.02,
            footroom=self.footroom,
        )
        for panel in self._floors:
            tiles = _floor_tiles(self._framing.centres[panel], self._framing.radii[panel])
            self._panel(panel).add_mesh(
                tiles,
                scalars="paint",
                rgb=True,
                lighting=False,
                reset_camera=False,
                name=f"floor {panel}",
                render=False,
            )

    def at(self, seconds: float) -> Scene:
        """Moves everything to a time."""
        self.seconds, fresh = float(seconds), self._framing is None
        for update in self._updates:
            update(self.seconds)
        if fresh:
            self._arrange()
        if fresh or self.follow:
            for panel, renderer in enumerate(self.plotter.renderers):
                if self.camera:
                    viewpoint.match_camera(renderer.camera, self.camera)
                else:
                    self._aim(renderer.camera, panel)
                renderer.camera_set = True
        return self

    def _aim(self, eye: pv.Camera, panel: int) -> None:
        """Moves the eye of a panel to where it belongs; one that a hand has turned meanwhile travels on, turned."""
        found, up = (eye.position, eye.focal_point), eye.up
        was = self._eyes.get(panel, found)
        self._framing.aim(eye, panel, self.seconds)
        self._eyes[panel] = (eye.position, eye.focal_point)
        if found != was:
            travel = np.subtract(eye.focal_point, was[1])
            eye.position, eye.focal_point, eye.up = found[0] + travel, found[1] + travel, up

    def image(self, seconds: float | None = None) -> np.ndarray:
        """Draws the picture (H, W, 3) uint8 at a time, the present one by default."""
        self.at(self.seconds if seconds is None else seconds)
        self.plotter.render()
        return np.ascontiguousarray(self.plotter.screenshot(return_img=True)[..., :3])

    def close(self) -> None:
        """Closes the window."""
        self.plotter.close()

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *_) -> None:
        self.close()


def _floor_tiles(centre: np.ndarray, radius: float) -> pv.PolyData:
    """A checkerboard of 0.5 m tiles on the world's grid, colours in cell_data "paint", that fades into the paper."""
    low = np.floor((np.asarray(centre[:2]) - radius) / _TILE).astype(int)
    count = int(np.ceil(2 * radius / _TILE)) + 1
    fine = 2  # cells per tile: a smoother fade
    step = _TILE / fine
    i, j = np.meshgrid(np.arange(count * fine), np.arange(count * fine), indexing="ij")
    corner = low * _TILE + np.stack((i, j), -1).reshape(-1, 2) * step
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * step
    points = np.full((len(corner), 4, 3), _FLOOR_Z)
    points[..., :2] = corner[:, None] + square
    odd = ((low[0] + i // fine + low[1] + j // fine) % 2).reshape(-1, 1)
    away = np.linalg.norm(corner + step / 2 - np.asarray(centre[:2]), axis=-1, keepdims=True) / radius
    fade = np.clip((away - 0.35) / 0.65, 0, 1)
    fade = fade * fade * (3 - 2 * fade)
    dark, light = np.array(blend(TILE, TILE, 0)), np.array(blend(TILE, "white", 0.75))
    rgb = (1 - fade) * np.where(odd, light, dark) + fade * np.array(blend(PAPER, PAPER, 0))
    faces = np.insert(np.arange(4 * len(corner)).reshape(-1, 4), 0, 4, axis=1)
    mesh = pv.PolyData(points.reshape(-1, 3), faces.ravel())
    mesh.cell_data["paint"] = (255 * rgb).round().astype(np.uint8)
    return mesh


def _vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """A third of the area of the faces around each vertex, square metres (V,)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 6
    return np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(vertices))


def _darkness(points: np.ndarray, areas: np.ndarray, centre: np.ndarray, width: float = _WIDTH) -> np.ndarray:
    """How much light a surface keeps from the floor around ``centre``, (cells, cells) in 0..1, row = y.

    The surface is splatted on the floor with its area; what is high is blurred widely, what touches
    sharply, so contact is visible.
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


class _Shadow:
    """A translucent square on the floor that follows one surface (V, 3), (F, 3); ``move`` redraws it in place."""

    def __init__(self, plotter: pv.Plotter, points: np.ndarray, faces: np.ndarray, strength: float) -> None:
        self.areas, self.strength = _vertex_areas(points, faces), strength
        self.width = max(_WIDTH, float(np.ptp(points[:, :2], axis=0).max()) + 1.5)
        self.square = pv.PolyData(np.zeros((4, 3)), [4, 0, 1, 2, 3])
        self.square.active_texture_coordinates = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
        self.pixels = pv.ImageData(dimensions=(_CELLS, _CELLS, 1))
        rgba = np.zeros((_CELLS * _CELLS, 4), np.uint8)
        rgba[:, :3] = (36, 40, 52)
        self.pixels.point_data.set_scalars(rgba, "rgba")
        texture = pv.Texture(self.pixels)
        texture.interpolate = True
        self.actor = plotter.add_mesh(self.square, texture=texture, lighting=False, reset_camera=False)
        self.move(points)

    def move(self, points: np.ndarray) -> None:
        """Redraw for the surface's vertices (V, 3), world."""
        centre = (points[:, :2].min(0) + points[:, :2].max(0)) / 2
        alpha = 255 * self.strength * _darkness(points, self.areas, centre, self.width)
        self.pixels.point_data["rgba"][:, 3] = alpha.ravel()
        self.pixels.GetPointData().GetScalars().Modified()
        self.pixels.Modified()
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * self.width / 2 + centre
        self.square.points = np.column_stack((corners, np.full(4, _SHADOW_Z)))


@lru_cache(maxsize=16)  # a film draws a frame of several people twice: over the footage and from the side
def _skin(body: BodyModel, motion: Motion, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) of a frame and their normals."""
    with torch.no_grad():
        now = motion.cut(index, index + 1)
        skin = mannequin.array(lbs(tailored(body, now.skeleton), now.skeleton, now.root, now.rot)[0])
    return skin, mannequin.vertex_normals(skin, body.faces.cpu().numpy())
