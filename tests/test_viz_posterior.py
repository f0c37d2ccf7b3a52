import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from motionlab.humor.state import FPS
from motionlab.viz import posterior as draw
from motionlab.viz.palette import colour
from tests.fit_inputs import two_walks

ROLES = {"Laplace": "baseline", "emcee": "ours"}


def texts(figure):
    found = [t.get_text() for ax in figure.axes if ax.get_visible() for t in (ax.xaxis.label, ax.yaxis.label, ax.title)]
    return " ".join(found)


def test_corner_shows_every_pair_once_the_truth_and_the_ellipse(generator):
    draws = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    truth = torch.tensor([0.5, 9.0, 0.0]).double()
    figure = draw.corner(
        {"emcee": draws}, ("a (m)", "b (m)", "c"), truth=truth, roles=ROLES,
        gaussian=(torch.zeros(3).double(), torch.eye(3).double()),
    )  # fmt: skip
    shown = [ax for ax in figure.axes if ax.get_visible()]
    assert len(shown) == 6
    assert "a (m)" in texts(figure) and "b (m)" in texts(figure)
    pair = figure.axes[3]  # second row, first column
    lines = {line.get_color(): line for line in pair.lines}
    assert pair.get_ylim()[1] > 9  # the truth is in view
    ring = next(np.stack(x.get_data(), 1) for c, x in lines.items() if c == "#e69f00")
    assert np.allclose(np.linalg.norm(ring, axis=1), 4.605**0.5, atol=1e-3)  # chi2 with two degrees: 90 %
    points = next(x for x in pair.lines if x.get_marker() == ".")
    assert np.allclose(points.get_color(), colour("ours"))


def test_narrowing_has_a_bar_at_each_median():
    widths = {"image": {"emcee": torch.tensor([1.0, 2, 9]), "Laplace": torch.tensor([2.0, 2, 2])}}
    figure = draw.narrowing(widths, ylabel="cm", roles=ROLES)
    bars = [line.get_ydata() for line in figure.axes[0].lines if len(line.get_xdata()) == 2]
    assert [list(b) for b in bars] == [[2, 2], [2, 2]]


def test_reliability_rises_to_all_clips_and_starts_where_the_nearest_is():
    figure = draw.reliability({"emcee": torch.tensor([0.5, 0.25, 1.0, 0.875])}, roles=ROLES)
    line = figure.axes[0].lines[-1]
    assert list(line.get_xdata()[:2]) == [25, 50] and list(line.get_ydata()[:2]) == [25, 50]
    assert line.get_ydata()[-1] == 100


def test_rank_bars_add_up():
    figure = draw.rank_bars({"emcee": torch.linspace(0.01, 0.99, 60).reshape(15, 4)}, roles=ROLES, bins=6)
    (bars,) = (p for p in figure.axes[0].patches if hasattr(p, "get_data"))
    assert bars.get_data().values.sum() == pytest.approx(100)
    assert np.allclose(bars.get_data().values, 100 / 6)


def test_fans_hold_the_draws_between_their_bands(generator):
    t = torch.linspace(0, 1, 12)
    draws = torch.randn(2, 40, 12, generator=generator)
    hidden = torch.arange(12) > 5
    figure = draw.fans({"clip 1": (t, t, hidden, draws)}, ("emcee", "Laplace"), FPS, ylabel="cm", roles=ROLES)
    assert len(figure.axes) == 2 and "clip 1" in texts(figure)


def test_ridge_is_measured_from_the_lower_end():
    figure = draw.ridge_line(torch.linspace(0, 1, 3), {"clip 1": torch.tensor([5.0, 100.0, 2.0])}, ylabel="nats")
    assert list(figure.axes[0].lines[0].get_ydata()) == [3, 98, 0]
    assert isinstance(figure, Figure)


def test_fan_film_shows_all_draws_at_once(tmp_path):
    walks = two_walks()
    panels = {"truth": walks.clip(0), "emcee": walks}
    film = draw.fan_film(panels, tmp_path / "fan.gif", roles=ROLES | {"truth": "truth"}, fps=3.0)
    assert film.path.stat().st_size > 5_000 and film.frames >= 4
    assert film.seconds == pytest.approx(23 / FPS)
