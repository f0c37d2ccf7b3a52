"""The figures of notebook 04 draw what they are given."""

import numpy as np
import torch

from data_synth import scenes
from motionlab.humor import state
from motionlab.humor.parity import Row
from motionlab.viz import prior as draw


def noise(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(shape)))


def test_anatomy_shows_every_part_and_every_number():
    clip = scenes.held_out(1, frames=12)
    x = state.from_motion(clip)[0, 5]
    fig = draw.anatomy(state.localise(x, state.heading(x)), clip.clip(0).skeleton)
    body, band = fig.axes
    words = " ".join(text.get_text() for text in body.texts)
    assert all(f"{name}  {part.stop - part.start}" in words for name, part in state.SLICES.items())
    assert sum(patch.get_width() for patch in band.patches) == 339
    dots = [c for c in body.collections if len(c.get_offsets()) == 22]
    assert len(dots) == 1


def test_parity_puts_forms_apart():
    rows = [Row("a", "official", 0.0, 1e-10), Row("b", "lean", 2e-5, 5e-5), Row("c", "lean", 1e-6, 5e-5)]
    official, lean = draw.parity(rows).axes
    assert "1 arrays" in official.get_title() and "2 arrays" in lean.get_title()
    heights = lean.collections[0].get_offsets()[:, 1]
    assert heights.tolist() == [1e-6, 2e-5]


def test_learning_has_a_line_per_held_out_source():
    names = [f"{source}: {measure}" for source in ("synthetic", "recordings") for measure in ("one step", "2 s", "kl")]
    curve = [{"step": step, "loss": 1.0} | dict.fromkeys(names, 5.0 - step) for step in (1, 2, 3)]
    axes = draw.learning(curve).axes
    assert [len(ax.get_lines()) for ax in axes] == [2, 2, 2]
    assert axes[1].get_lines()[0].get_ydata().tolist() == [4.0, 3.0, 2.0]


def test_latents_sort_and_mark_what_is_in_use():
    kl = torch.tensor([0.0, 0.5, 0.001, 0.2])
    fig = draw.latents(kl, noise(30, 2), ["walk", "sit"] * 15, 0.01)
    heights = [patch.get_height() for patch in fig.axes[0].patches]
    assert np.allclose(heights, [0.5, 0.2, 0.001, 0.0])
    assert len({patch.get_facecolor() for patch in fig.axes[0].patches}) == 2
    assert [len(c.get_offsets()) for c in fig.axes[1].collections] == [15, 15]


def test_drift_has_a_panel_per_source():
    series = {"rolled out": noise(5, 20) + 0.1, "errors added": noise(5, 20) + 0.1}
    fig = draw.drift({"a": series, "b": series}, {"rolled out": "axis-angle", "errors added": "axis-angle"})
    assert len(fig.axes) == 2 and "5 clips" in fig.axes[0].get_title()
    line, dotted = fig.axes[0].get_lines()
    assert (line.get_linestyle(), dotted.get_linestyle()) == ("-", ":")
    assert np.allclose(line.get_ydata(), series["rolled out"].median(0).values)


def test_futures_and_dimensions_draw_somebody():
    clip = scenes.held_out(1, frames=20)
    three = clip.clip([0, 0, 0])
    fig = draw.paths({"walk": (clip.clip(0), three)})
    assert len(fig.axes[0].get_lines()) == 3 + 1 + 1
    picture = draw.futures(clip.clip(0), three, size=(300, 200))
    assert picture.shape == (200, 300, 3) and (picture < 120).all(-1).any()
    panels = draw.dimensions({"dimension 3": three, "dimension 5": three}, size=(400, 200))
    assert panels.shape == (200, 400, 3)
