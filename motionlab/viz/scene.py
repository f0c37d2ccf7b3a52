"""Scenes: figures, bodies, cameras and trails over a floor, seen through one window, moving in sync.

>>> scene = Scene().floor().skeleton(motion, "ours").trail(motion, "left_wrist")  # doctest: +SKIP
>>> scene.image(seconds=0.5)  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from trimesh import remesh

from motionlab.body import BodyModel, lbs
from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.observation import Camera
from motionlab.viz import render

render.prepare()

import pyvista as pv  # noqa: E402  the window is chosen before VTK loads

from motionlab.viz import figures, framing, ground, shapes, view, viewpoint  # noqa: E402
from motionlab.viz.palette import INK, LINE, PAPER, blend, colour  # noqa: E402


class Scene:
    """One window with one panel, or several side by side; what adds to it returns it, so calls chain.

    Args:
        size: width and height of the window in pixels; a camera's own size by default, else 640 x 480.
        panels: a label above each panel.
        camera: see exactly what this pinhole camera sees; else the eye frames everything that moves.
        azimuth, elevation: degrees of the eye around and above the subject; azimuth from the motion by default.
        follow: the eye travels with the subject instead of standing far enough away.
        footroom: share of the picture left free below.
        off_screen: False for a view that a person turns.

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
        off_screen: bool = True,
    ) -> None:
        size = size or ((camera.width, camera.height) if camera else (640, 480))
        if camera and abs(size[0] / len(panels) * camera.height / camera.width - size[1]) > 1:
            raise ShapeError(f"size: expected the shape of the camera's {camera.width} x {camera.height}, got {size}")
        self.size, self.panels, self.camera = size, tuple(panels), camera
        self.azimuth, self.elevation, self.follow, self.footroom = azimuth, elevation, follow, footroom
        self.seconds = 0.0
        self.plotter = pv.Plotter(
            shape=(1, len(panels)), off_screen=off_screen, window_size=list(size), border=False, lighting="none"
        )
        self._updates: list[Callable[[float], None]] = []
        self._seen: list[list[tuple[np.ndarray, float]]] = [[] for _ in panels]  # paths (T, M, 3) and their fps
        self._left: np.ndarray | None = None
        self._floors: set[int] = set()
        self._frame: framing.Frame | None = None
        for index, label in enumerate(panels):
            plotter = self._panel(index)
            plotter.set_background(PAPER)
            plotter.enable_anti_aliasing("ssaa", all_renderers=False)
            shapes.light(plotter)
            if label:
                shapes.title(plotter, label, size[1])

    def _panel(self, panel: int) -> pv.Plotter:
        if not 0 <= panel < len(self.panels):
            raise IndexError(f"panel {panel}: the scene has {len(self.panels)}")
        self.plotter.subplot(0, panel)
        return self.plotter

    def _watch(self, panel: int, path: np.ndarray, fps: float = 1.0) -> Scene:
        self._seen[panel].append((path, fps))
        self._frame = None
        return self

    def floor(self, panel: int | None = None) -> Scene:
        """A checkerboard of 0.5 m tiles at z = 0 in one panel, or in all."""
        self._floors |= set(range(len(self.panels))) if panel is None else {panel}
        self._frame = None
        return self

    def skeleton(
        self, motion: Motion, role: str | tuple = "ours", *, frame: int | None = None, shadow=0.42, panel: int = 0
    ) -> Scene:
        """A figure with volume, its left side light and its right side dark.

        ``frame`` holds one frame; by default the figure moves with the scene's time. ``shadow`` is how dark its
        shadow is, 0 for none.
        """
        figure = figures.build(figures.single(motion).skeleton, colour(role))
        positions, orientations = map(shapes.array, motion.world)

        def shape(index: int) -> tuple[np.ndarray, np.ndarray]:
            return figure.pose(positions[index], orientations[index])

        def show(plotter: pv.Plotter, mesh: pv.PolyData) -> None:
            shapes.add_surface(plotter, mesh, figure.colours)

        return self._surface(motion, shape, figure.faces, show, frame, shadow, panel)

    def body(
        self,
        body: BodyModel,
        motion: Motion,
        role: str | tuple = "ours",
        *,
        betas: Tensor | None = None,
        field: Tensor | None = None,
        title: str = "",
        limits: tuple[float, float] | None = None,
        cmap: str = "viridis",
        frame: int | None = None,
        shadow: float = 0.42,
        panel: int = 0,
    ) -> Scene:
        """The skin of a body moved by a motion; a ``field`` (V,) is painted on it, with a bar named ``title``."""
        paint = blend(colour(role), "white", 0.3)
        faces = body.faces.cpu().numpy()
        figures.single(motion)

        def shape(index: int) -> tuple[np.ndarray, np.ndarray]:
            with torch.no_grad():
                now = motion.cut(index, index + 1)
                skin = shapes.array(lbs(body, now.skeleton, now.root, now.rot, betas)[0])
            return skin, shapes.vertex_normals(skin, faces)

        def show(plotter: pv.Plotter, mesh: pv.PolyData) -> None:
            if field is None:
                shapes.add_surface(plotter, mesh, paint)
            else:
                shapes.add_field(plotter, mesh, shapes.array(field), title, limits, cmap)

        return self._surface(motion, shape, faces, show, frame, shadow, panel)

    def _surface(self, motion, shape, faces, show, frame, shadow, panel) -> Scene:
        if frame is not None and not -motion.frames <= frame < motion.frames:
            raise IndexError(f"frame {frame}: the motion has {motion.frames}")
        plotter, positions = self._panel(panel), shapes.array(motion.positions)
        shown = 0 if frame is None else frame % motion.frames
        if self._left is None:
            self._left = viewpoint.left_of(motion.cut(shown, shown + 1))
        points, normals = shape(shown)
        mesh = shapes.surface(points, faces, normals)
        shade = ground.Shadow(plotter, points, faces, shadow) if shadow else None
        show(plotter, mesh)

        def update(seconds: float) -> None:
            nonlocal shown
            index = int(np.clip(round(seconds * motion.fps), 0, motion.frames - 1))
            if index != shown:
                shown = index
                points, normals = shape(index)
                shapes.reshape(mesh, points, normals)
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
        """A mesh of faces (F, 3) that stands still, (V, 3) metres, or moves, (T, V, 3) at ``fps``: a table, a wall."""
        path, faces, plotter = np.asarray(vertices, float), np.asarray(faces), self._panel(panel)
        path = path[None] if path.ndim == 2 else path
        shade = None
        if shadow:
            fine, finer = (path[0], faces) if len(path) > 1 else remesh.subdivide_to_size(path[0], faces, max_edge=0.08)
            shade = ground.Shadow(plotter, fine, finer, shadow)
        mesh = pv.PolyData.from_regular_faces(path[0].copy(), faces)
        plotter.add_mesh(mesh, color=paint, opacity=opacity, reset_camera=False, **shapes.SKIN)

        def update(seconds: float) -> None:
            mesh.points = path[int(np.clip(round(seconds * fps), 0, len(path) - 1))]
            if shade:
                shade.move(mesh.points)

        if len(path) > 1:
            self._updates.append(update)
        return self._watch(panel, path, fps)

    def points(self, points, role: str | tuple = "observation", *, radius: float = 0.02, panel: int = 0) -> Scene:
        """Still markers at (N, 3) metres."""
        at = np.asarray(points, float)
        ball = pv.Sphere(radius=radius, theta_resolution=24, phi_resolution=24)
        balls = pv.PolyData(at).glyph(geom=ball, scale=False, orient=False)
        self._panel(panel).add_mesh(balls, color=colour(role), reset_camera=False, **shapes.SKIN)
        return self._watch(panel, at[None])

    def ghosts(self, motion: Motion, count: int = 6, role: str | tuple = "ours", *, panel: int = 0) -> Scene:
        """Onion skin: ``count`` poses evenly through time, the older the paler."""
        for index, frame in enumerate(np.linspace(0, figures.single(motion).frames - 1, count).round().astype(int)):
            pale = blend(PAPER, colour(role), 0.2 + 0.8 * index / max(count - 1, 1))
            self.skeleton(motion, pale, frame=int(frame), shadow=0.8 / (count + 1), panel=panel)
        return self

    def trail(self, motion: Motion, joint: str, role: str | tuple = "ours", *, panel: int = 0) -> Scene:
        """The path of a joint: pale as a whole, strong up to now."""
        path = shapes.array(figures.single(motion).positions[:, motion.skeleton.index(joint)])
        plotter, paint, line = self._panel(panel), colour(role), shapes.polyline(path)
        shapes.add_line(plotter, shapes.polyline(path), blend(paint, PAPER, 0.6), 2)
        shapes.add_line(plotter, line, paint, 5)

        def update(seconds: float) -> None:
            now = int(np.clip(round(seconds * motion.fps), 0, len(path) - 1))
            line.points = path[np.minimum(np.arange(line.n_points), now)]

        self._updates.append(update)
        update(self.seconds)
        return self._watch(panel, path[:, None], motion.fps)

    def frustum(self, camera: Camera, *, depth: float = 0.6, picture=None, panel: int = 0) -> Scene:
        """A camera as a pyramid ``depth`` metres high, with the picture it took on its base."""
        return self._watch(panel, shapes.add_frustum(self._panel(panel), camera, depth, picture, INK)[None])

    def caption(self) -> Callable[[str], None]:
        """A line of text in the lower left corner; returns the function that sets it."""
        text = shapes.caption(self._panel(0), self.size[1])
        return lambda words: text.set_text("lower_left", words)

    def label(self, point, text: str, *, panel: int = 0) -> Scene:
        """A word that stays upright at a point (3,) of the world."""
        shapes.add_label(self._panel(panel), np.asarray(point, float), text, self.size[1])
        return self

    def _arrange(self) -> None:
        width, height = self.size
        self._frame = framing.frame(
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
            tiles = ground.tiles(self._frame.centres[panel], self._frame.radii[panel])
            self._panel(panel).add_mesh(
                tiles, scalars="paint", rgb=True, lighting=False, reset_camera=False, name=f"floor {panel}"
            )

    def at(self, seconds: float) -> Scene:
        """Move everything to a time."""
        self.seconds, fresh = float(seconds), self._frame is None
        for update in self._updates:
            update(self.seconds)
        if fresh:
            self._arrange()
        if fresh or self.follow:
            for panel, renderer in enumerate(self.plotter.renderers):
                if self.camera:
                    view.match(renderer.camera, self.camera)
                else:
                    self._frame.aim(renderer.camera, panel, self.seconds)
                renderer.camera_set = True
        return self

    def image(self, seconds: float | None = None) -> np.ndarray:
        """The picture (H, W, 3) uint8 at a time, the present one by default."""
        self.at(self.seconds if seconds is None else seconds)
        self.plotter.render()
        return np.ascontiguousarray(self.plotter.screenshot(return_img=True)[..., :3])

    def close(self) -> None:
        """Give the window back."""
        self.plotter.close()

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *_) -> None:
        self.close()
