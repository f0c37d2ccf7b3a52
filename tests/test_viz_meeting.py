"""What accuracy costs."""

import torch

from motionlab.viz.meeting import errors_and_seconds


def test_every_method_has_its_point_and_its_name(generator):
    points = {"slow": (20.0, torch.tensor([4.0, 6.0, torch.nan])), "quick": (0.1, torch.tensor([7.0, 8.0]))}
    figure = errors_and_seconds(points, {"slow": "stage3"}, generator, ylabel="cm")
    (ax,) = figure.axes
    assert {"slow", "quick"} <= {t.get_text() for t in ax.texts}
    assert [line.get_ydata()[0] for line in ax.lines if line.get_marker() == "o"] == [5.0, 7.5]
    assert ax.get_xscale() == "log"
