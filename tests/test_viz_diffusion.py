"""The figures of notebook 10 draw what they are given."""

import numpy as np
import torch

from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.schedule import cosine
from motionlab.diffusion.trained import Recipe, Trained
from motionlab.viz import diffusion as draw
from motionlab.viz.palette import colour
from tests.fit_inputs import two_walks


def noise(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(shape)))


def test_schedules_draw_both_and_their_errors():
    named = {"squared": cosine(100), "printed": cosine(100, power=1)}
    errors = {name: {10: noise(3), 100: noise(3)} for name in named}
    left, middle, right = draw.schedules(named, errors, roles={"squared": "ours", "printed": "axis-angle"}).axes
    assert np.allclose(left.get_lines()[0].get_ydata(), named["squared"].alpha_bar)
    assert middle.get_yscale() == "log" and len(right.collections) == 2
    assert right.get_lines()[1].get_xdata().tolist() == [10, 100]


def test_noising_has_a_row_per_level():
    recipe = Recipe(contacts=False, noising=50)
    walk = two_walks()
    layout = recipe.layout
    model = Trained(
        torch.nn.Identity(), recipe.schedule, layout, Normaliser.measure(layout.encode(walk), layout), recipe
    )
    picture = draw.noising(model, walk.clip(slice(0, 1)), (0.0, 0.9), torch.Generator().manual_seed(0))
    assert picture.dtype == np.uint8 and picture.shape == (420, 900, 3)
    assert np.abs(picture[:210].astype(int) - picture[210:]).mean() > 1


def test_training_has_a_row_per_run_and_marks_the_choice():
    curve = [
        {"step": s, "loss": 1.0 / s, "simple": 1.0 / s, "x0 error at t = 50": 0.5, "x0 error at t = 200": 0.7}
        | ({"kid": 3.0 / s} if s > 1 else {})
        for s in (1, 2, 3)
    ]
    axes = draw.training({"a": curve, "b": curve}, {"a": 2}).axes
    assert len(axes) == 6
    losses, errors, kid = axes[:3]
    assert losses.get_ylabel() == "a" and len(losses.get_lines()) == 1 and len(errors.get_lines()) == 2
    assert kid.get_lines()[0].get_xdata().tolist() == [2, 3] and kid.get_lines()[1].get_xdata()[0] == 2


def test_by_level_draws_means_per_source():
    series = {"network": noise(5, 3) + 0.1, "filter": noise(5, 3) + 0.2}
    fig = draw.by_level({"a": series, "b": series}, (0.1, 0.5, 0.9), ylabel="x", roles={})
    assert len(fig.axes) == 2 and "5 windows" in fig.axes[0].get_title()
    assert np.allclose(fig.axes[0].get_lines()[0].get_ydata(), series["network"].double().mean(0))


def test_ablation_bands_the_seeds():
    table = {"all": {"x": 1.0, "y": 2.0}, "seed 1": {"x": 1.5, "y": 2.0}, "no fk": {"x": 4.0}}
    fig = draw.ablation(table, seeds=("all", "seed 1", "absent"), truth={"y": 1.9})
    x, y = fig.axes
    assert [label.get_text() for label in x.get_yticklabels()] == list(table)
    assert x.collections[0].get_facecolors()[2][:3].tolist() == list(colour("axis-angle"))
    band = x.patches[0].get_extents().transformed(x.transData.inverted())
    assert np.allclose((band.x0, band.x1), (1.0, 1.5)) and len(y.get_lines()) == 1 and not x.get_lines()


def test_by_minutes_sorts():
    fig = draw.by_minutes({"a": {20.0: (2.0, 1.0, 3.0), 5.0: (4.0, 3.0, 5.0)}}, ylabel="x")
    line = fig.axes[0].containers[0].lines[0]
    assert line.get_xdata().tolist() == [5, 20] and line.get_ydata().tolist() == [4, 2]


def test_kinds_puts_labels_side_by_side():
    row = {"one": (1.0, 0.5, 1.5), "two": (2.0, 1.5, 2.5)}
    fig = draw.kinds({"legs": row, "gap": row}, ylabel="x", roles={}, reference=1.0)
    one, two = (c.lines[0] for c in fig.axes[0].containers)
    assert one.get_ydata().tolist() == [1, 1] and (two.get_xdata() > one.get_xdata()).all()
