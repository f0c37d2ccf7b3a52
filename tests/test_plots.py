"""Plots: what is drawn is what was given, colours keep their meaning, and nothing global changes."""

import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb

from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from motionlab.viz import plots
from motionlab.viz.palette import ROLE


@pytest.fixture(autouse=True)
def unchanged():
    before = dict(mpl.rcParams)
    yield
    assert dict(mpl.rcParams) == before
    import matplotlib.pyplot as plt

    assert plt.get_fignums() == []


def noise(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def test_colours_follow_roles_and_no_two_labels_share_one():
    paint = plots.paints(["truth", "ours", "mine", "yours", "SLERP"], {"SLERP": "baseline"})
    assert paint["truth"] == to_rgb(ROLE["truth"]) and paint["SLERP"] == to_rgb(ROLE["baseline"])
    assert len(set(paint.values())) == 5
    with pytest.raises(KeyError, match="no role 'blue'"):
        plots.paints(["a"], {"a": "blue"})


def test_curves_draw_the_median_and_the_band():
    t, y = np.arange(50) / 10, noise(11, 50)
    figure = plots.curves(t, {"truth": y[0], "ours": torch.tensor(y)}, ylabel="height (m)")
    (ax,) = figure.axes
    np.testing.assert_allclose(ax.lines[0].get_ydata(), y[0])
    np.testing.assert_allclose(ax.lines[1].get_ydata(), np.median(y, axis=0))
    (band,) = ax.collections
    assert band.get_datalim(ax.transData).y1 == pytest.approx(np.percentile(y, 75, axis=0).max())
    assert ax.get_xlabel() == "time (s)" and ax.get_ylabel() == "height (m)"
    with pytest.raises(ShapeError, match="ours"):
        plots.curves(t, {"ours": y[:, :7]}, ylabel="m")


def test_histograms_share_their_bins_and_lose_no_sample():
    figure = plots.histograms({"synthetic": noise(500), "real": 2 + noise(900, seed=1)}, xlabel="speed (m/s)")
    stairs = [p for p in figure.axes[0].patches if not p.get_fill()]
    values = [p.get_data() for p in stairs]
    assert np.array_equal(values[0].edges, values[1].edges)
    assert [v.values.sum() for v in values] == pytest.approx([100, 100])
    assert "n = 900" in figure.axes[0].get_legend().get_texts()[1].get_text()
    plots.histograms({"a": np.ones(5)}, xlabel="constant")
    with pytest.raises(ShapeError, match="nothing to plot for a"):
        plots.histograms({"a": [float("nan")]}, xlabel="x")


def test_a_spectrum_peaks_where_its_signal_swings():
    t = torch.arange(600) / 60
    figure = plots.spectrum({"ours": (torch.sin(2 * np.pi * 5 * t)[None], 60.0)}, unit="m")
    frequency, power = figure.axes[0].lines[0].get_data()
    assert frequency[power.argmax()] == pytest.approx(5, abs=0.3)


def test_bars_carry_their_intervals():
    figure = plots.bars({"walk": {"baseline": (4, 3, 6), "ours": (3, 2, 5)}, "run": {"ours": (2, 1, 4)}}, ylabel="cm")
    ax = figure.axes[0]
    assert sorted(bar.get_height() for bar in ax.patches) == [2, 3, 4]
    ends = sorted(y for c in ax.collections for segment in c.get_segments() for _, y in segment)
    assert ends == [1, 2, 3, 4, 5, 6]


def test_a_heatmap_names_its_rows_and_columns():
    figure = plots.heatmap(torch.eye(3)[:2], ["a", "b"], ["x", "y", "z"], label="weight")
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == ["a", "b"]
    with pytest.raises(ShapeError, match="expected"):
        plots.heatmap(torch.eye(3), ["a", "b"], ["x", "y", "z"], label="weight")


@pytest.mark.parametrize("log", [False, True])
def test_boxes_mark_the_median_and_the_middle_half(log):
    x = np.exp(noise(999))
    ax = plots.boxes({"real": x, "one": [2.0]}, xlabel="speed (m/s)", log=log).axes[0]
    np.testing.assert_allclose(ax.lines[0].get_xdata(), np.percentile(x, (25, 75)), rtol=0.01)
    assert ax.lines[1].get_xdata()[0] == pytest.approx(np.median(x))


def test_stick_figures_stand_on_their_line():
    rot = torch.eye(3).repeat(5, 22, 1, 1)
    rot[:, 0] = UPRIGHT
    motion = Motion(STANDARD, torch.tensor([0.0, 0.0, float(STANDARD.standing_height())]).repeat(5, 1), rot, 10.0)
    ax = plots.stick_figures(motion, 3).axes[0]
    bones = np.array([line.get_ydata() for line in ax.lines[:-1]])
    assert len(bones) == 3 * 21 and bones.min() == pytest.approx(STANDARD.sole, abs=1e-6)
    with pytest.raises(ShapeError, match="batch"):
        plots.stick_figures(Motion(STANDARD, motion.root[None], motion.rot[None], 10.0))
