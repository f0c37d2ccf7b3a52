"""What reacts in JupyterLab: a time slider over motions, and an experiment whose knobs redraw its picture."""

import asyncio
import contextlib
import html
import inspect
import io
import os
import sys
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.viz.movie import Film, data_url, jpeg, stage
from motionlab.viz.scene import Scene

_RATE = 25  # steps of the slider per second
_REST, _WHEEL = 0.4, 1.1  # seconds without motion until edges are smoothed; times as far by a notch of the wheel


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
    """A view in the browser, drawn by the kernel and turned with the mouse, and what sends it a new picture.

    What turns one panel turns all. While something moves it is drawn quickly, and once more when it rests.
    """
    # trame's WebAssembly view, not used here, downloads itself when the server starts: an error without a network
    sys.modules.setdefault("trame.widgets.vtklocal", None)
    scene.plotter.enable_terrain_style(mouse_wheel_zooms=_WHEEL)  # the horizon stays level
    scene.plotter.iren.interactor.EnableRenderOff()  # a hand moves the eye; trame draws as often as it can
    scene.plotter.notebook = True  # else pyvista guesses, and shows nothing where it sees no notebook
    view = scene.plotter.show(jupyter_backend="server", jupyter_kwargs={"add_menu": False}, return_viewer=True)
    resting: list[asyncio.TimerHandle] = []

    def stir() -> None:
        scene.smooth(False)
        while resting:
            resting.pop().cancel()
        resting.append(asyncio.get_running_loop().call_later(_REST, settle))

    def settle() -> None:
        scene.smooth(True)
        view.viewer.update()

    def update() -> None:
        stir()
        view.viewer.update()

    scene.plotter.render_window.AddObserver("StartEvent", lambda *_: stir() if scene.heed() else None)
    return view, update


def slider(
    motions: Motion | Mapping[str, Motion], backend: str | None = None, *, roles: Mapping[str, str] | None = None,
    body: BodyModel | None = None, size: tuple[int, int] | None = None, **view,
):  # fmt: skip
    """Builds a time slider over motions side by side, with a play button that plays at the speed of life.

    Where drawing cannot keep up, frames are skipped; the clock is that of the picture shown.

    Args:
        motions, roles, body: as of :func:`motionlab.viz.movie.film`. view: its things, ghost, follow and azimuth; the
            eye travels with each motion, if not told otherwise.
        backend: "picture": an image that is drawn anew, with buttons that turn it; "trame": a view that a person turns
            with the mouse, through pyvista's trame back end. By default "trame" where ``$PYVISTA_JUPYTER_BACKEND`` says
            so, as ``make lab`` does, else "picture".
        size: width and height in pixels.

    Returns:
        an ipywidgets box with children (view, controls).

    Raises:
        ValueError: no such backend.
    """
    import ipywidgets

    panels = 1 if isinstance(motions, Motion) else len(motions)
    size = size or (640 if panels == 1 else min(420 * panels, 1020), 420)
    shown = Player(*stage(motions, roles, body, size, **{"follow": True} | view), backend)
    shown.clock.layout.width = "5em"
    row = [shown.play, shown.hand, shown.clock, *shown.turns]
    return ipywidgets.VBox([shown.view, ipywidgets.HBox(row, layout={"width": f"{size[0]}px"})])


class Player:
    """A scene in JupyterLab as widgets to arrange: ``view``, ``play``, ``hand`` (a slider), ``clock`` (a label) and
    ``turns`` (buttons that turn the picture, where no mouse does).

    seconds: how long the scene moves. backend: as of :func:`slider`. steps: of the slider from start to end; by default
    25 per second. words: step of the picture that is shown, to what the clock says.
    """

    def __init__(
        self, scene: Scene, seconds: float, backend: str | None = None, steps: int = 0, words: Callable | None = None
    ) -> None:
        import ipywidgets

        backend = backend or ("trame" if os.environ.get("PYVISTA_JUPYTER_BACKEND") == "trame" else "picture")
        if backend not in ("picture", "trame"):
            raise ValueError(f"no backend {backend!r}; backends are picture, trame")
        self.scene, self.seconds = scene, seconds
        self.steps = steps or max(round(seconds * _RATE), 1)
        self._words = words or (lambda step: f"{step * seconds / self.steps:.2f} s")
        stride = max(round(self.steps / max(seconds, 1e-3) / _RATE), 1)  # at more steps per second some are skipped
        interval = max(round(1000 * stride * seconds / self.steps), 1)
        self.play = ipywidgets.Play(min=0, max=self.steps, step=stride, interval=interval)
        self.hand = ipywidgets.IntSlider(min=0, max=self.steps, readout=False, layout={"flex": "1 1 auto"})
        self.clock = ipywidgets.Label(self._words(0))
        ipywidgets.jslink((self.play, "value"), (self.hand, "value"))
        self.turns = []
        scene.at(0.0)
        if backend == "trame":
            self.view, self._refresh = _trame(scene)
        else:
            self.view = ipywidgets.Image(format="jpeg", layout={"width": f"{scene.size[0]}px"})
            self._refresh = lambda: setattr(self.view, "value", jpeg(scene.image(), 92))
            self._refresh()
            turn = _newest(lambda degrees: (scene.turn(degrees), self.draw(self.hand.value)))
            for way, degrees in (("left", 30.0), ("right", -30.0)):
                button = ipywidgets.Button(icon=f"rotate-{way}", tooltip=f"turn to the {way}", layout={"width": "3em"})
                button.on_click(lambda _, by=degrees: turn(by))
                self.turns.append(button)
        moved = _newest(self.draw)
        self.hand.observe(lambda change: moved(change["new"]), names="value")

    def draw(self, step: int) -> None:
        """Shows the scene as it now is at a step of the slider."""
        self.scene.at(step * self.seconds / self.steps)
        self._refresh()
        self.clock.value = self._words(step)


def explore(draw: Callable, *, units: Mapping[str, str] | None = None, **knobs: object):
    """Builds an experiment with knobs: whenever one is turned, ``draw(**values)`` draws the picture anew.

    Where drawing cannot keep up, values that newer ones have overtaken are skipped. An error is shown below the
    picture, which stays. It is an ipywidgets box with children (picture, message, knob, knob, ...).

    Args:
        draw: values by knob to a picture (H, W, 3) uint8, a matplotlib figure or a film.
        units: of knobs, by name: "gap (s)".
        knobs: as for ``ipywidgets.interact``: (low, high, step) and numbers make sliders, a list or mapping a menu,
            True or False a box to tick, or any widget. They begin at the defaults of ``draw``, where it has some.
    """
    import ipywidgets
    import traitlets

    hands = dict(zip(knobs, ipywidgets.interactive(lambda **values: None, **knobs).children[:-1], strict=True))
    begins = {p.name: p.default for p in inspect.signature(draw).parameters.values() if p.default is not p.empty}
    for name, hand in hands.items():
        if not isinstance(knobs[name], ipywidgets.Widget):
            hand.layout.width = "min(100%, 34em)"  # in ipywidgets's 300 pixels, one is ten of a thousand steps
            with contextlib.suppress(traitlets.TraitError):  # no value of this knob
                hand.value = begins.get(name, hand.value)
    for name, unit in (units or {}).items():
        hands[name].description = f"{name} ({unit})"
    picture = ipywidgets.HTML()
    message = ipywidgets.HTML(style={"text_color": "#b3261e"})  # a Label would cut a long message

    def redraw(_: object) -> None:
        message.value = "<span style='color: #777777'>drawing …</span>"
        try:
            picture.value = _shown(draw(**{name: hand.value for name, hand in hands.items()}))
            message.value = ""
        except Exception as error:  # whatever the experiment raises is for the person who turned the knob
            message.value = html.escape(f"{type(error).__name__}: {error}")

    turn = _newest(redraw)
    for hand in hands.values():
        hand.style.description_width = "initial"
        hand.continuous_update = False
        hand.observe(turn, names="value")
    redraw(None)
    return ipywidgets.VBox([picture, message, *hands.values()])


def _shown(picture: np.ndarray | Figure | Film) -> str:
    """HTML of a picture no higher than fits the window; its shape is said, so that what is below stays in place."""
    if isinstance(picture, Film):
        return picture._repr_html_()
    buffer = io.BytesIO()
    if isinstance(picture, Figure):
        picture.savefig(buffer, format="png", dpi=100, bbox_inches="tight")
    else:
        Image.fromarray(picture).save(buffer, "png")
    width, height = Image.open(buffer).size
    room = f"width: {width}px; aspect-ratio: {width} / {height}; max-width: min(100%, {60 * width / height:.0f}vh)"
    return f'<img style="{room}" src="{data_url("image/png", buffer.getvalue())}">'
