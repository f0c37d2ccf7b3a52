"""What reacts in JupyterLab: a time slider over motions, and an experiment whose knobs redraw its picture."""

from __future__ import annotations

import asyncio
import contextlib
import html
import inspect
import io
import os
import sys
from collections import deque
from collections.abc import Callable, Mapping
from unittest import mock

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.viz.movie import jpeg, stage, strip
from motionlab.viz.scene import Scene

BACKENDS = ("static", "picture", "trame")
_RATE = 25  # steps of the slider per second
_DRAWING = "<span style='color: #777777'>drawing …</span>"


def _newest(draw: Callable[[object], None]) -> Callable[[object], None]:
    """``draw``, always on the thread that made it, skipping values that newer ones have overtaken.

    ipykernel 7 answers widgets on a thread of their own, but a window's OpenGL context and trame's event loop belong
    to the thread that made them: drawn from another one, pictures stay as they were. Without a running event loop (a
    script, a test) it draws at once.
    """
    try:
        loop = asyncio.get_running_loop()
    except RuntimeError:
        return draw
    waiting: deque[object] = deque(maxlen=1)

    def run() -> None:
        if waiting:
            draw(waiting.pop())

    def call(value: object) -> None:
        waiting.append(value)
        loop.call_soon_threadsafe(run)

    return call


def _trame(scene: Scene):
    """A view in the browser, drawn by the kernel and turned with the mouse, and what sends it a new picture."""
    from trame_pyvista.jupyter import elegantly_launch, get_server

    server = get_server(name=scene.plotter.theme.trame.jupyter_server_name)
    if not server.running:
        # trame's WebAssembly view, not used here, downloads itself when the server starts: an error without a network
        with mock.patch.dict(sys.modules, {"trame.widgets.vtklocal": None}):
            elegantly_launch(server)
    scene.plotter.notebook = True  # else pyvista guesses, and shows nothing where it sees no notebook
    view = scene.plotter.show(jupyter_backend="server", jupyter_kwargs={"add_menu": False}, return_viewer=True)
    return view, view.viewer.update


def slider(
    motions: Motion | Mapping[str, Motion],
    backend: str | None = None,
    *,
    body: BodyModel | None = None,
    size=None,
    follow=False,
):
    """Builds a time slider over motions side by side, with a play button that plays at the speed of life.

    Where drawing cannot keep up, frames are skipped; the clock is that of the picture shown.

    Args:
        motions: one, or label -> motion, as in :func:`motionlab.viz.movie.film`.
        backend: "static": key poses as one picture (H, W, 3) (CI); "picture": an image that is drawn anew;
            "trame": a view that a person turns with the mouse, through pyvista's trame back end. By default "trame"
            where ``$PYVISTA_JUPYTER_BACKEND`` says so, as ``make lab`` does, else "picture".
        size: width and height in pixels.

    Returns:
        an array for "static", else an ipywidgets box with children (view, controls).

    Raises:
        ValueError: no such backend.
    """
    if backend is None:
        backend = "trame" if os.environ.get("PYVISTA_JUPYTER_BACKEND") == "trame" else "picture"
    if backend not in BACKENDS:
        raise ValueError(f"no backend {backend!r}; backends are {', '.join(BACKENDS)}")
    if backend == "static":
        return strip(motions if isinstance(motions, Motion) else next(iter(motions.values())), body=body)
    import ipywidgets

    panels = 1 if isinstance(motions, Motion) else len(motions)
    size = size or (640 if panels == 1 else min(420 * panels, 1100), 420)
    scene, seconds = stage(motions, None, body, size, follow=follow)
    steps = max(round(seconds * _RATE), 1)
    width = f"{size[0]}px"
    play = ipywidgets.Play(min=0, max=steps, interval=1000 // _RATE)
    hand = ipywidgets.IntSlider(min=0, max=steps, readout=False, layout={"flex": "1 1 auto"})
    clock = ipywidgets.Label("0.00 s", layout={"width": "5em"})
    ipywidgets.jslink((play, "value"), (hand, "value"))
    scene.at(0.0)
    if backend == "trame":
        view, refresh = _trame(scene)
    else:
        view = ipywidgets.Image(value=jpeg(scene.image(), 92), format="jpeg", layout={"width": width})

        def refresh() -> None:
            view.value = jpeg(scene.image(), 92)

    def draw(step: int) -> None:
        now = step * seconds / steps
        scene.at(now)
        refresh()
        clock.value = f"{now:.2f} s"

    turn = _newest(draw)
    hand.observe(lambda change: turn(change["new"]), names="value")
    return ipywidgets.VBox([view, ipywidgets.HBox([play, hand, clock], layout={"width": width})])


def explore(draw: Callable[..., np.ndarray | Figure], **knobs: object):
    """Builds an experiment with knobs: whenever one is turned, ``draw(**values)`` draws the picture anew.

    Where drawing cannot keep up, values that newer ones have overtaken are skipped. An error is shown below the
    picture, which stays.

    Args:
        draw: values by knob to a picture (H, W, 3) uint8 or a matplotlib figure.
        knobs: as for ``ipywidgets.interact``: (low, high, step) and numbers make sliders, a list or mapping a menu,
            True or False a box to tick, or any widget. They begin at the defaults of ``draw``, where it has some.

    Returns:
        an ipywidgets box with children (picture, message, knob, knob, ...).
    """
    import ipywidgets
    import traitlets

    hands = ipywidgets.interactive(lambda **values: None, **knobs).children[:-1]
    begins = {p.name: p.default for p in inspect.signature(draw).parameters.values() if p.default is not p.empty}
    for hand in hands:
        if hand.description in begins and not isinstance(knobs[hand.description], ipywidgets.Widget):
            with contextlib.suppress(traitlets.TraitError):  # no value of this knob
                hand.value = begins[hand.description]
    room = {"align_self": "flex-start", "margin": "0", "max_width": "100%", "max_height": "60vh"}  # as fits the window
    picture = ipywidgets.Image(format="png", layout=room)
    message = ipywidgets.HTML(style={"text_color": "#b3261e"})  # a Label would cut a long message

    def redraw(values: dict[str, object]) -> None:
        message.value = _DRAWING
        try:
            picture.value = _png(draw(**values))
            message.value = ""
        except Exception as error:  # whatever the experiment raises is for the person who turned the knob
            message.value = html.escape(f"{type(error).__name__}: {error}")

    def now() -> dict[str, object]:
        return {hand.description: hand.value for hand in hands}

    turn = _newest(redraw)
    for hand in hands:
        hand.style.description_width = "initial"
        hand.continuous_update = False
        hand.observe(lambda change: turn(now()), names="value")
    redraw(now())
    return ipywidgets.VBox([picture, message, *hands])


def _png(picture: np.ndarray | Figure) -> bytes:
    buffer = io.BytesIO()
    if isinstance(picture, Figure):
        picture.savefig(buffer, format="png", dpi=100, bbox_inches="tight")
    else:
        Image.fromarray(picture).save(buffer, "png")
    return buffer.getvalue()
