"""A scene: figures, bodies, things and trails over a floor, seen through one window, moving in sync:
``Scene().floor().skeleton(motion, "ours").trail(motion, "left_wrist").image(seconds=0.5)``.

Importing this module chooses, once, which window VTK draws into: quiet where there is no display.
"""

import contextlib
import ctypes
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Self

import numpy as np
import pyvista as pv
import torch
from torch import Tensor

from motionlab import viz
from motionlab.body import BodyModel, lbs, tailored
from motionlab.errors import ShapeError
from motionlab.motion import Motion, single
from motionlab.observation import Camera
from motionlab.viz import mannequin, viewpoint
from motionlab.viz.mannequin import Shadow, floor_tiles
from motionlab.viz.palette import INK, LINE, PAPER, blend, colour

# It comes with CUDA builds of torch. Loaded after Mesa's LLVM, it kills the process.
with contextlib.suppress(ImportError, OSError):
    importlib.import_module("triton._C.libtriton")

#: What gives Debian and Ubuntu a window to draw into.
RENDERING_PACKAGES = "libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libglx-mesa0 libxrender1"
RENDERING_REMEDY = f"apt-get update && apt-get install -y {RENDERING_PACKAGES}"

# Without a display, EGL (else OSMesa) is chosen before VTK tries X and writes about it to stderr.
if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
    for _library, _window in {"libEGL.so.1": "vtkEGLRenderWindow", "libOSMesa.so.8": "vtkOSOpenGLRenderWindow"}.items():
        with contextlib.suppress(OSError):
            ctypes.CDLL(_library)
            os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", _window)
            break


class Scene(contextlib.AbstractContextManager):
    """One window with one panel, or several side by side; what adds to it returns it, so calls chain.

    Args:
        size: width and height of the window in pixels; a camera's own size by default, else 640 x 480.
        panels: a label above each panel.
        camera: see exactly what this pinhole camera sees; else the eye frames everything that moves.
        azimuth, elevation: degrees of the eye around and above the subject; azimuth from the motion by default.
        follow: the eye travels with the subject instead of standing far enough away.
        footroom: share of the picture left free below.
        fine: smooth edges; where the processor draws, that takes three times as long.

    Time is in seconds, so motions of different frame rates stay in sync; past its end a motion holds still.
    A ``role`` is a name of ``palette.ROLE`` or a colour (r, g, b) in 0..1.

    Raises:
        ShapeError: the size has another shape than the camera's image.
    """

    def __init__(
        self, size: tuple[int, int] | None = None, *, panels: Sequence[str] = ("",), camera: Camera | None = None,
        azimuth: float | None = None, elevation: float = 11.0, follow: bool = False, footroom: float = 0.04,
        fine: bool = True,
    ) -> None:  # fmt: skip
        size = size or ((camera.width, camera.height) if camera else (640, 480))
        if camera and abs(size[0] / len(panels) * camera.height / camera.width - size[1]) > 1:
            raise ShapeError(f"size: expected the shape of the camera's {camera.width} x {camera.height}, got {size}")
        self.size, self.panels, self.camera, self.seconds = size, tuple(panels), camera, 0.0
        self._view = {"aspect": size[0] / len(panels) / size[1], "azimuth": azimuth, "elevation": elevation}
        self._view |= {"follow": follow, "headroom": 0.11 if any(panels) else 0.02, "footroom": footroom}
        how = {"window_size": list(size), "border": False, "lighting": "none"}
        self.plotter = pv.Plotter(off_screen=True, shape=(1, len(panels)), **how)
        self._updates: list[Callable[[float], None]] = []
        self._figures: dict[int, tuple[list[Motion], int]] = {}  # panel -> motion of its last one, place in _seen
        self._eyes: dict[int, tuple] = {}  # panel -> where its eye was put and what it looks at
        self._hand: tuple[np.ndarray, np.ndarray] | None = None  # eye from what it looks at, and that from the subject
        self._seen: list[list[tuple[np.ndarray, float]]] = [[] for _ in panels]  # paths (T, M, 3) and their fps
        self._left, self._framing, self._floor = None, None, False
        for index, label in enumerate(panels):
            plotter = self._panel(index)
            plotter.set_background(PAPER)
            plotter.enable_anti_aliasing("ssaa", all_renderers=False)
            mannequin.add_lights(plotter)
            if label:
                mannequin.add_words(plotter, label, "upper_edge", max(size[1] / 42, 7))
        self._smoothing = [renderer.GetPass() for renderer in self.plotter.renderers]
        self.smooth(fine and not viz.draft)

    def _panel(self, panel: int) -> pv.Plotter:
        if not 0 <= panel < len(self.panels):
            raise IndexError(f"panel {panel}: the scene has {len(self.panels)}")
        self.plotter.subplot(0, panel)
        return self.plotter

    def _watch(self, panel: int, path: np.ndarray, fps: float = 1.0) -> Self:
        self._seen[panel].append((path, fps))
        self._framing = None
        return self

    def moving(self, update: Callable[[float], None]) -> Self:
        """Calls a function of the time in seconds now, and whenever that changes."""
        self._updates.append(update)
        update(self.seconds)
        return self

    def floor(self) -> Self:
        """Adds a checkerboard of 0.5 m tiles at z = 0 in all panels."""
        self._floor, self._framing = True, None
        return self

    def skeleton(self, motion: Motion, role: str | tuple = "ours", *, opacity: float = 1.0, **how) -> Self:
        """Adds a figure with volume, its left side light and its right side dark; options as of :meth:`body`."""
        figure = mannequin.build(single(motion).skeleton, colour(role))

        def shape(now: Motion, index: int) -> np.ndarray:
            return figure.pose(*(mannequin.array(whole[index]) for whole in now.world))

        show = partial(mannequin.add_surface, paint=figure.colours, opacity=opacity)
        return self._surface(motion, shape, figure.faces, show, **how)

    def exchange(self, motion: Motion, *, panel: int = 0) -> Self:
        """Puts another motion, of the same joints, into a panel's last framed figure or body."""
        held, place = self._figures[panel]
        held[0] = single(motion)
        self._seen[panel][place] = (mannequin.array(motion.positions), motion.fps)
        self._framing = None
        return self

    def body(
        self, body: BodyModel, motion: Motion, role: str | tuple = "ours", *, field: Tensor | None = None,
        title: str = "", limits: tuple[float, float] | None = None, cmap: str = "viridis", opacity: float = 1.0, **how,
    ) -> Self:  # fmt: skip
        """Adds the skin of a body moved by a motion; a ``field`` (V,) is painted on it, with a bar named ``title``.

        how: panel, frame, shadow, framed and shown.
        ``frame`` holds one frame; by default it moves with the scene's time. ``shadow`` is how dark its shadow is, 0
        for none. ``shown`` says in which of the motion's frames there is somebody; by default in all. What is not
        ``framed`` does not decide where the eye stands.
        """
        show = partial(mannequin.add_surface, paint=blend(colour(role), "white", 0.3), opacity=opacity)
        if field is not None:
            show = partial(mannequin.add_field, values=mannequin.array(field), title=title, limits=limits, cmap=cmap)
        faces = body.faces.cpu().numpy()
        return self._surface(single(motion), partial(_skin, body), faces, show, **how)

    def _surface(
        self, motion: Motion, shape: Callable[[Motion, int], np.ndarray], faces: np.ndarray, show: Callable, *,
        panel: int = 0, frame: int | None = None, shadow: float = 0.42, framed: bool = True,
        shown: Sequence[bool] | None = None,
    ) -> Self:  # fmt: skip
        if frame is not None:
            if not -motion.frames <= frame < motion.frames:
                raise IndexError(f"frame {frame}: the motion has {motion.frames}")
            motion = motion.cut(frame % motion.frames, frame % motion.frames + 1)
        plotter, held, drawn = self._panel(panel), [motion], (0, motion)
        if self._left is None:
            self._left = viewpoint.left_of(motion)
        points = shape(motion, 0)
        mesh = mannequin.surface(points, faces)
        shade = Shadow(plotter, points, faces, shadow) if shadow else None
        actors = [show(plotter, mesh), *([shade.actor] if shade else [])]

        def update(seconds: float) -> None:
            nonlocal drawn
            now = held[0]
            index = int(np.clip(round(seconds * now.fps), 0, now.frames - 1))
            for actor in actors if shown is not None else ():
                actor.SetVisibility(bool(shown[index]))
            if (index, now) != drawn:
                drawn = (index, now)
                points = shape(now, index)
                mannequin.move_surface(mesh, points)
                if shade:
                    shade.move(points)

        positions = mannequin.array(motion.positions)
        if shown is not None and np.any(shown):  # where nobody is shown does not decide where the eye stands
            on = np.flatnonzero(shown)
            positions = positions[on[(np.searchsorted(on, np.arange(len(positions)), "right") - 1).clip(0)]]
        if framed:
            self._figures[panel] = (held, len(self._seen[panel]))
            self._watch(panel, positions, motion.fps)
        return self.moving(update)

    def mesh(self, vertices, faces, paint=LINE, *, opacity: float = 1.0, framed: bool = True, panel: int = 0) -> Self:
        """Adds a mesh of vertices (V, 3), metres, and faces (F, 3) that stands still: a table."""
        points = np.array(vertices, float)
        mesh = pv.PolyData.from_regular_faces(points, np.asarray(faces))
        self._panel(panel).add_mesh(mesh, color=paint, opacity=opacity, reset_camera=False, **mannequin.SKIN)
        return self._watch(panel, points[None]) if framed else self

    def points(self, points, role: str | tuple = "observation", *, radius: float = 0.02, panel: int = 0) -> Self:
        """Adds still markers at (N, 3) metres."""
        at = np.asarray(points, float)
        ball = pv.Sphere(radius=radius, theta_resolution=24, phi_resolution=24)
        balls = pv.PolyData(at).glyph(geom=ball, scale=False, orient=False)
        self._panel(panel).add_mesh(balls, color=colour(role), reset_camera=False, **mannequin.SKIN)
        return self._watch(panel, at[None])

    def trail(self, motion: Motion, joint: str, role: str | tuple = "ours", *, panel: int = 0) -> Self:
        """Adds the whole path of a joint."""
        path = mannequin.array(single(motion).positions[:, motion.skeleton.index(joint)])
        line = pv.PolyData(path, lines=[len(path), *range(len(path))])
        look = {"line_width": 5, "render_lines_as_tubes": True, "ambient": 0.6, "diffuse": 0.4}
        self._panel(panel).add_mesh(line, color=colour(role), reset_camera=False, **look)
        return self._watch(panel, path[:, None], motion.fps)

    def caption(self) -> Callable[[str], None]:
        """Adds a line of text in the lower left corner; returns the function that sets it."""
        text = mannequin.add_words(self._panel(0), " ", "lower_left", max(self.size[1] / 60, 6))
        return lambda words: text.set_text("lower_left", words)

    def label(self, point, text: str, *, panel: int = 0) -> Self:
        """Adds a word that stays upright at a point (3,) of the world."""
        look = {"text_color": INK, "font_family": "arial", "bold": False, "show_points": False, "shape": None,
                "always_visible": True, "reset_camera": False, "font_size": max(round(self.size[1] / 22), 10),
                "justification_horizontal": "center", "justification_vertical": "top"}  # fmt: skip
        self._panel(panel).add_point_labels(np.asarray(point, float)[None], [text], **look)
        return self

    def at(self, seconds: float) -> Self:
        """Moves everything to a time."""
        turned = self.heed()
        self.seconds, fresh = float(seconds), self._framing is None
        for update in self._updates:
            update(self.seconds)
        if fresh:
            self._framing = viewpoint.choose_framing(self._seen, left=self._left, **self._view)
            for panel in range(len(self.panels)) if self._floor else ():
                tiles = floor_tiles(*self._framing.floors[panel])
                look = {"scalars": "paint", "rgb": True, "lighting": False, "reset_camera": False, "render": False}
                self._panel(panel).add_mesh(tiles, name=f"floor {panel}", **look)
        if fresh or turned or self._view["follow"]:
            self._aim()
        return self

    def _aim(self) -> None:
        for panel, renderer in enumerate(self.plotter.renderers):
            eye = renderer.camera
            if self.camera:
                viewpoint.match_camera(eye, self.camera)
            else:
                self._framing.aim(eye, panel, self.seconds, self._hand)
                self._eyes[panel] = (eye.position, eye.focal_point)
            renderer.camera_set = True

    def heed(self) -> bool:
        """Turns the eyes of all panels as a hand has turned one of them since they were put; says whether one has.

        All stay upright, above the floor and near the subject, and travel on with it, turned.
        """
        for panel, put in self._eyes.items():
            eye = self.plotter.renderers[panel].camera
            if (eye.position, eye.focal_point) != put and self._framing:
                self._hand = self._framing.reached(eye, panel, self.seconds)
                self._aim()
                return True
        return False

    def turn(self, degrees: float) -> Self:
        """Turns all eyes around the subject, to the right as seen from above."""
        self.plotter.renderers[0].camera.Azimuth(degrees)
        return self

    def smooth(self, yes: bool) -> None:
        """Smooths edges, as at first, or does not: several times as fast where a processor draws."""
        for renderer, smoothing in zip(self.plotter.renderers, self._smoothing, strict=True):
            renderer.SetPass(smoothing if yes else None)

    def image(self, seconds: float | None = None) -> np.ndarray:
        """Draws the picture (H, W, 3) uint8 at a time, the present one by default."""
        self.at(self.seconds if seconds is None else seconds)
        self.plotter.render()
        return np.ascontiguousarray(self.plotter.screenshot(return_img=True)[..., :3])

    def close(self, *_) -> None:
        """Closes the window."""
        self.plotter.close()

    __exit__ = close


@lru_cache(maxsize=16)  # a film draws a frame of several people twice: over the footage and from the side
def _skin(body: BodyModel, motion: Motion, index: int) -> np.ndarray:
    """Vertices (V, 3) of a frame."""
    with torch.no_grad():
        now = motion.cut(index, index + 1)
        return mannequin.array(lbs(tailored(body, now.skeleton), now.skeleton, now.root, now.rot)[0])
