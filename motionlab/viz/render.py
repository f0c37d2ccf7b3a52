"""Which window VTK draws into: set once, before the first one, and quiet where there is no display."""

from __future__ import annotations

import ctypes
import os
import sys

from motionlab.errors import MissingData

PACKAGES = "libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libglx-mesa0 libxrender1"
REMEDY = f"apt-get update && apt-get install -y {PACKAGES}"  #: what gives Debian and Ubuntu a window to draw into
_HOW = f"On Debian or Ubuntu, as root: {REMEDY}  (or, for OSMesa, libosmesa6)"
_WINDOWS = {"libEGL.so.1": "vtkEGLRenderWindow", "libOSMesa.so.8": "vtkOSOpenGLRenderWindow"}


def _opens(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def headless() -> bool:
    """True on a Linux machine without an X or Wayland display."""
    return sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def prepare() -> None:
    """Without a display, choose EGL (else OSMesa) before VTK tries X and writes about it to stderr."""
    if headless():
        window = next((name for library, name in _WINDOWS.items() if _opens(library)), None)
        if window:
            os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", window)


def check() -> str:
    """Draw one small picture off-screen and name the VTK window class that drew it.

    Raises:
        MissingData: no window can draw here; says what to install.
    """
    if headless() and not any(map(_opens, _WINDOWS)):
        raise MissingData("Off-screen rendering (EGL or OSMesa)", _HOW)
    prepare()
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=(16, 16))
    plotter.set_background("#ff0000")
    try:
        red = plotter.screenshot(return_img=True)
        window = plotter.render_window.GetClassName()
    finally:
        plotter.close()
    if tuple(red[8, 8, :3]) != (255, 0, 0):
        raise MissingData(f"A graphics driver for {window}, which drew nothing,", _HOW)
    return window
