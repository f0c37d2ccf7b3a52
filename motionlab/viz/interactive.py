"""A time slider in JupyterLab; a static picture where nobody turns it."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np
from PIL import Image

from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.viz.movie import stage, strip


def _png(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "png")
    return buffer.getvalue()


def slider(
    motions: Motion | Mapping[str, Motion],
    backend: str = "picture",
    *,
    body: BodyModel | None = None,
    size=None,
    follow=False,
):
    """Motions side by side under a time slider with a play button.

    Args:
        motions: one, or label -> motion, as in :func:`motionlab.viz.movie.film`.
        backend: "static": key poses as one picture (H, W, 3) (CI); "picture": a slider that redraws an image here;
            "trame": a view that a person turns, through pyvista's trame back end.

    Returns:
        an array for "static", else an ipywidgets box with children (view, controls).

    Raises:
        ValueError: no such backend.
    """
    if backend == "static":
        return strip(motions if isinstance(motions, Motion) else next(iter(motions.values())), body=body)
    if backend not in ("picture", "trame"):
        raise ValueError(f"no backend {backend!r}; backends are static, picture, trame")
    import ipywidgets

    panels = 1 if isinstance(motions, Motion) else len(motions)
    scene, seconds = stage(motions, None, body, size or (min(420 * panels, 1100), 420), follow=follow)
    steps = max(int(seconds * 25), 1)
    play = ipywidgets.Play(min=0, max=steps, interval=80)
    hand = ipywidgets.IntSlider(min=0, max=steps, readout=False, layout={"width": "60%"})
    clock = ipywidgets.Label("0.00 s")
    ipywidgets.jslink((play, "value"), (hand, "value"))
    scene.at(0.0)
    if backend == "trame":
        view = scene.plotter.show(jupyter_backend="trame", return_viewer=True)
        refresh = view.viewer.update
    else:
        view = ipywidgets.Image(value=_png(scene.image()), format="png")

        def refresh() -> None:
            view.value = _png(scene.image())

    def turn(change) -> None:
        now = change["new"] * seconds / steps
        clock.value = f"{now:.2f} s"
        scene.at(now)
        refresh()

    hand.observe(turn, names="value")
    return ipywidgets.VBox([view, ipywidgets.HBox([play, hand, clock])])
