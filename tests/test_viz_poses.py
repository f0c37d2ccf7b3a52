"""Pictures of poses: handles are seen where they are, and plots show the numbers they are given."""

import pytest
import torch

from data_synth import scenes
from motionlab.motion import Motion
from motionlab.viz import poses


@pytest.fixture(scope="module")
def pose() -> Motion:
    return scenes.held_out(1).clip(0).cut(0, 1)


def balls(picture):
    """How many pixels have the handles' hue."""
    r, g, b = (picture[..., k].astype(int) for k in range(3))
    return int(((r > 120) & (r - g > 50) & (g - b > 10)).sum())


def test_a_row_shows_every_pose_and_its_handles(pose):
    which = torch.zeros(22, dtype=torch.bool)
    roles = {"real": "truth", "two": "ours"}
    panels = {"real": pose, "two": [pose, pose]}
    none = poses.row(panels, pose.positions[0], which, roles)
    which[[15, 20]] = True
    some = poses.row(panels, pose.positions[0], which, roles)
    assert some.shape == none.shape == (300, 380, 3)
    assert balls(none) < 20 and balls(some[:, :190]) > 40 and balls(some[:, 190:]) > 40
    assert poses.stacked([none, some]).shape == (600, 380, 3)


def test_plots_show_their_numbers(generator):
    found = {"mean pose": torch.rand(30, generator=generator) + 2, "told": torch.rand(30, generator=generator) + 1}
    figure = poses.errors({"synthetic": found, "recordings": found}, {"told": "ours"}, xlabel="error (cm)")
    left = figure.axes[0]
    assert [t.get_text() for t in left.get_yticklabels()] == ["mean pose", "told"]
    assert left.get_title() == "synthetic (n = 30)"
    strokes = [line.get_xdata() for line in left.lines if len(set(line.get_xdata())) == 1]
    assert [x[0] for x in strokes] == pytest.approx([v.mean().item() for v in found.values()], rel=1e-5)
    steps = poses.over_steps({"free": {"synthetic": torch.rand(30, 3, generator=generator)}}, (1, 5, 50), {})
    assert [t.get_text() for t in steps.axes[0].get_xticklabels()] == ["1", "5", "50"]
