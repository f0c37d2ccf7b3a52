"""The figures of notebook 07 draw what they are given."""

import numpy as np
import torch

from data_synth import scenes
from motionlab.viz import decoupled as draw


def test_costs_say_how_many_times():
    x = torch.tensor
    seconds = {("official", 1, None): x([0.4, 0.4]), ("official", 1, 1): x([0.1, 0.1]),
               ("lean", 4, None): x([0.2]), ("lean", 4, 1): x([0.1])}  # fmt: skip
    one, four = draw.costs(seconds).axes
    assert one.get_title() == "official, 1 clip" and four.get_title() == "lean, 4 clips"
    assert [t.get_text().strip() for t in one.texts] == ["400", "100  x 4.0"]


def test_news_leaves_white_what_has_not_arrived():
    change = torch.zeros(3, 5)
    change[1, :2] = change[2, :4] = 0.1
    ax = draw.news({"K = 1": change, "K = 2": change}, 30.0).axes[0]
    shown = ax.get_images()[0].get_array()
    assert np.ma.getmaskarray(shown).sum() == 15 - 6 and np.isclose(shown[1, 0], -1)


def test_variants_have_a_dot_per_clip_and_a_median():
    found = {"copy": torch.tensor([1.0, 2.0, 9.0]), "L1": torch.tensor([0.0, 1.0, 2.0])}
    fig = draw.variants({"energy": found, "cm": found}, {"copy": "observation", "L1": "ours"}, straight={"energy": 5.0})
    assert len(fig.axes) == 2 and fig.axes[0].get_xscale() == "symlog" and fig.axes[1].get_xscale() == "linear"
    bars = [line for line in fig.axes[1].lines if line.get_linewidth() == 3]
    assert [bar.get_xdata()[0] for bar in bars] == [2.0, 1.0]


def test_curves_over_evaluations_and_their_levels():
    y = torch.tensor([[3.0, 5.0, 4.0], [1.0, 2.0, 3.0]])
    fig = draw.over_evaluations(
        {"a": {"L1": ((1, 10), y)}}, ("cm",), {"L1": "ours"}, lines={"a": {"reference": 1.0}}, between={"a": (0.5, 3.5)}
    )
    (ax,) = fig.axes
    assert ax.get_ylim() == (0.5, 3.5)
    assert list(ax.lines[0].get_ydata()) == [4.0, 2.0] and list(ax.lines[1].get_ydata()) == [1.0, 1.0]
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["L1", "reference"]


def test_measures_by_steps():
    found = {1: torch.tensor([1.0, 3.0, 2.0, 9.0]), 5: torch.tensor([4.0, 4.0, 4.0])}
    fig = draw.by_steps({"gap (cm)": found, "s": found})
    assert list(fig.axes[0].lines[0].get_ydata()) == [2.5, 4.0] and len(fig.axes[1].collections) == 2


def test_last_poses_fill_rows():
    truth = scenes.held_out(1, frames=8).clip(0)
    shown = draw.last_poses(
        {"truth": truth, "other": truth, "third": truth}, {"truth": "truth", "other": "ours"}, columns=2
    )
    assert shown.shape == (2 * 290, 2 * 230, 3) and shown.dtype == np.uint8
    assert shown[:290].std() > 5
