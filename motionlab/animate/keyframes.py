"""A widget for JupyterLab in which a person chooses what of a motion stays and sees the rest filled in."""

import contextlib
import html
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from motionlab import io
from motionlab.animate import filling
from motionlab.animate.rewriting import write_back
from motionlab.body import BodyModel
from motionlab.errors import DataError
from motionlab.motion import Motion, runs
from motionlab.retarget import retarget
from motionlab.viz.interactive import Player, _newest
from motionlab.viz.movie import stage
from motionlab.viz.palette import ROLE, TILE

_SIZE = (840, 420)


def editor(path: str | Path, backend: str | None = None, *, body: BodyModel | str | None = "anny", **guided: str):
    """Builds an editor of a file: the motion beside what is made between its keys (``filling.inbetween``).

    One slider moves and plays both frame by frame over a strip of the keys; beside it are what is kept, a method, and a
    button that exports. Whatever is changed is filled in and drawn anew at once. What goes wrong is said below in red;
    the picture stays, and nothing is exported until it is right.

    It is an ipywidgets box; its attribute ``hands`` holds by name what a person touches and reads: player, frames,
    keep, previous, next, joints, method, file, export, message. backend: of the view, as of ``slider``: "picture" or
    "trame". body: whose skin is shown; None, or joints that are not known: a figure. guided: unit, up of a BVH.

    Raises:
        DataError: not a readable motion.
    """
    import ipywidgets

    path = Path(path).resolve()
    motion = io.load(path, **guided)
    kept, made, last, lift = set(), motion, motion.frames - 1, None
    if body:
        with contextlib.suppress(DataError):
            lift = retarget(motion).floor
    skin = None if lift is None else BodyModel.from_anny() if isinstance(body, str) else body
    wide = {"width": f"{_SIZE[0]}px"}
    whole = {"width": "auto", "margin": "2px"}

    def words(step: int) -> str:
        frame = min(step, last)
        return f"frame {frame} of {last}, {frame / motion.fps:.2f} s{', kept' if frame in kept else ''}"

    def dress(motion: Motion) -> Motion:
        if skin is None:
            return motion
        shown = retarget(motion, floor=False).motion
        return replace(shown, root=shown.root + torch.tensor([0.0, 0.0, lift]))

    given = dress(motion)
    panels = {"given": given, "in between": replace(given)}  # two motions: one is exchanged, the other is its ghost
    scene, seconds = stage(panels, {"given": "truth"}, skin, _SIZE, follow=True, ghost=given)
    player = Player(scene, seconds, backend, steps=max(last, 1), words=words)
    player.hand.layout, player.clock.layout = {"width": "auto", "margin": "0"}, {"width": "15em", "margin": "2px 12px"}
    strip = ipywidgets.HTML(layout={"width": "auto", "margin": "0"})
    narrow = {"width": "3em"}
    before = ipywidgets.Button(icon="step-backward", tooltip="to the previous kept frame", layout=narrow)
    after = ipywidgets.Button(icon="step-forward", tooltip="to the next kept frame", layout=narrow)
    keep = ipywidgets.Button(layout={"width": "11em"})
    frames = ipywidgets.Text(value="0,last", continuous_update=False, placeholder="as 0,45,60-80,last", layout=whole)
    method = ipywidgets.Dropdown(options=[("default", ""), *((m, m) for m in filling.METHODS)], layout=whole)
    chosen = ipywidgets.SelectMultiple(options=[*filling.GROUPS, *motion.skeleton.names], rows=9, layout=whole)
    target = f"{path.stem}_inbetween{path.suffix}"
    file = ipywidgets.Text(value=target, continuous_update=False, layout=whole | {"flex": "1 1 auto"})
    out = ipywidgets.Button(description="export", layout={"width": "7em"})
    message = ipywidgets.HTML(layout=wide)

    def say(*lines: str, wrong: bool = False) -> None:
        message.style.text_color = "#b3261e" if wrong else None
        message.value = "<div style='line-height: 1.5'>" + "<br>".join(map(html.escape, lines)) + "</div>"

    def attempt(act: Callable[[], Sequence[str]]) -> bool:
        try:
            say(*act())
            return True
        except Exception as error:  # for the person: on the kernel's loop nobody else would hear of it
            typed = isinstance(error, ValueError)  # or chosen
            say(str(error) if typed else f"{type(error).__name__}: {error}", wrong=True)
            return False

    def read() -> set[int]:
        return filling.frames_named(frames.value, motion.frames, "frames kept")

    def make() -> Sequence[str]:
        nonlocal kept, made
        now = read()
        say("making what lies between …")
        began = time.perf_counter()
        found = filling.inbetween(motion, filling.key_mask(motion, now, chosen.value), method=method.value or None)
        taken, made, kept = time.perf_counter() - began, found.motion, now
        strip.value = _strip(kept, motion.frames)
        scene.exchange(dress(made), panel=1)
        player.draw(player.hand.value)
        mark()
        count = motion.frames - len(kept)
        return (f"{count} of {motion.frames} frames made in {taken:.1f} s, {len(kept)} kept as they are", *found.notes)

    def redraw(_: object = None) -> None:
        out.disabled = not attempt(make)

    def at() -> int:
        return min(player.hand.value, last)

    def mark(_: object = None) -> None:
        keep.description, keep.icon = ("let this frame go", "unlock") if at() in kept else ("keep this frame", "lock")

    def toggle(_: object) -> None:
        try:
            now = read()  # of which some may still be waiting to be drawn
        except ValueError:
            now = kept
        frames.value = _text(now ^ {at()}, last)

    def jump(to: int) -> None:
        player.hand.value = to

    def export() -> Sequence[str]:
        goal = Path(file.value).resolve()
        return (f"{goal} is written: {write_back(path, goal, motion, made)}",)

    again = _newest(redraw)  # and exports, in the order in which they were asked for
    for hand in (frames, chosen, method):
        hand.observe(again, names="value")
    player.hand.observe(mark, names="value")
    keep.on_click(toggle)
    before.on_click(lambda _: jump(max((k for k in kept if k < at()), default=at())))
    after.on_click(lambda _: jump(min((k for k in kept if k > at()), default=at())))
    out.on_click(_newest(lambda _: out.disabled or attempt(export)))
    redraw()

    def titled(title: str, *hands: ipywidgets.Widget, width: str) -> ipywidgets.VBox:
        head = ipywidgets.HTML(f"<b>{title}</b>", layout={"margin": "0 2px"})
        return ipywidgets.VBox([head, *hands], layout={"width": width})

    files = ipywidgets.HBox([file, out])
    right = [("frames kept, from 0: 0,45,60-80,last", frames), ("method", method), ("file", files)]
    below = [
        titled("joints kept in all frames (Ctrl-click: several, or none)", chosen, width="50%"),
        ipywidgets.VBox([titled(title, hand, width="100%") for title, hand in right], layout={"width": "50%"}),
    ]
    buttons = ipywidgets.HBox([player.play, before, after, keep, player.clock, *player.turns])
    time_line = ipywidgets.VBox([player.hand, strip, buttons], layout=wide)
    box = ipywidgets.VBox([player.view, time_line, ipywidgets.HBox(below, layout=wide), message])
    box.hands = {"player": player, "frames": frames, "keep": keep, "previous": before, "next": after}
    box.hands |= {"joints": chosen, "method": method, "file": file, "export": out, "message": message}
    return box


def _text(frames: Collection[int], last: int) -> str:
    """Frames as a person writes them: 0,60-80,last."""
    ends = [["last" if end == last > 0 else str(end) for end in run] for run in _runs(frames, last + 1)]
    return ",".join(first if first == end else f"{first}-{end}" for first, end in ends)


def _runs(frames: Collection[int], count: int) -> list[tuple[int, int]]:
    """First and last of each run of frames without a gap."""
    return [(a, b - 1) for a, b in runs(torch.isin(torch.arange(count), torch.tensor([*frames])))]


def _strip(kept: Collection[int], count: int) -> str:
    """A bar as long as the slider's, with a mark at each kept frame."""
    share = 100 / max(count - 1, 1)
    here = f"position: absolute; top: 0; bottom: 0; background: {ROLE['ours']}"
    marks = "".join(
        f"<div style='{here}; left: calc({first * share:.3f}% - 1px); width: calc({(end - first) * share:.3f}% + 3px)'>"
        "</div>"
        for first, end in _runs(kept, count)
    )
    return f"<div style='position: relative; height: 8px; margin: 0 8px; background: {TILE}'>{marks}</div>"
