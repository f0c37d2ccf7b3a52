"""The figures of notebook 12."""

import pytest
import torch

from motionlab.viz import worlds


def test_the_correlation_stands_over_its_panel():
    legs = torch.linspace(0.1, 2.0, 40)
    roles = {"tied": "ours", "loose": "baseline"}
    figure = worlds.roots_and_legs({"tied": (0.5 * legs, legs), "loose": (-legs + 3, legs)}, roles, most=10)
    assert [ax.get_title() for ax in figure.axes] == ["tied: r = 1.00", "loose: r = -1.00"]
    assert len(figure.axes[0].collections[0].get_offsets()) == 10
    assert "m/s" in figure.axes[0].get_xlabel() and "m/s" in figure.axes[0].get_ylabel()


def test_ways_are_drawn_to_one_scale():
    figure = worlds.ways({"a": torch.rand(5, 8, 3), "b": 3 * torch.rand(4, 8, 3)}, {"a": "ours", "b": "truth"})
    assert [len(ax.lines) for ax in figure.axes] == [5, 4]
    widths = [high - low for ax in figure.axes for low, high in (ax.get_xlim(), ax.get_ylim())]
    assert widths == pytest.approx([widths[0]] * 4) and widths[0] > 2
