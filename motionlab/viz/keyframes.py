"""A widget for JupyterLab in which a person chooses what of a motion stays and sees the rest filled in."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence

from motionlab.motion import Motion
from motionlab.viz.interactive import _newest, slider


def keyframe_editor(
    motion: Motion,
    fill: Callable[[str, list[str], str], tuple[Motion, Sequence[str]]],
    export: Callable[[Motion, str], str],
    *,
    joints: Sequence[str] = (),
    methods: Sequence[str] = (),
    keys: str = "0,last",
    target: str = "inbetween.bvh",
    backend: str | None = None,
):
    """Builds an editor: the motion beside what is made between its keys, a time slider that plays both, keys, joints,
    a method, and a button that exports. Whatever is changed is filled in and drawn anew at once; what goes wrong is
    said below.

    Args:
        fill: (keys as text, joints that stay, method or "") to the motion made and notes. export: (motion, file name)
            to what is to be said. joints: to choose from. methods: to choose from, besides the default.
        keys, target: at first. backend: of the view, as of ``slider``: "picture" or "trame".

    Returns:
        an ipywidgets box with children (view, buttons, joints, message).
    """
    import ipywidgets

    frames = ipywidgets.Text(value=keys, description="frames kept", continuous_update=False)
    this = ipywidgets.Button(description="keep this frame", tooltip="or let it go again")
    which = ipywidgets.SelectMultiple(options=list(joints), description="joints kept", rows=6)
    way = ipywidgets.Dropdown(options=[("default", ""), *((m, m) for m in methods)], description="method")
    name = ipywidgets.Text(value=target, description="file")
    out = ipywidgets.Button(description="export")
    message, made = ipywidgets.HTML(), {"motion": motion}
    buttons = ipywidgets.HBox([frames, this, way, name, out], layout={"flex_flow": "row wrap"})
    box = ipywidgets.VBox([ipywidgets.HBox(), buttons, which, message])

    def say(text: str) -> None:
        message.value = html.escape(text)

    def now() -> int:
        hand = box.children[0].children[1].children[1]
        return round(hand.value / max(hand.max, 1) * (motion.frames - 1))

    def redraw(_: object) -> None:
        say("drawing …")
        try:
            made["motion"], notes = fill(frames.value, list(which.value), way.value)
        except ValueError as error:  # of the keys, joints or method that were chosen
            say(str(error))
            return
        step = box.children[0].children[1].children[1].value if box.children[0].children else 0
        view = slider({"given": motion, "in between": made["motion"]}, backend or None)
        view.children[1].children[1].value = step
        box.children = (view, *box.children[1:])
        say("; ".join(notes))

    def toggle(_: object) -> None:
        words, frame = [word for word in frames.value.split(",") if word], str(now())
        frames.value = ",".join([w for w in words if w != frame] if frame in words else [*words, frame])

    def write(_: object) -> None:
        try:
            say(export(made["motion"], name.value))
        except ValueError as error:
            say(str(error))

    again = _newest(redraw)
    for hand in (frames, which, way):
        hand.style.description_width = "initial"
        hand.observe(lambda change: again(change["new"]), names="value")
    this.on_click(toggle)
    out.on_click(write)
    redraw(None)
    return box
