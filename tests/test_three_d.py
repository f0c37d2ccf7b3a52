"""HuMoR's two tests in 3-D: what is hidden, how noisy, and what the filters must do with it."""

import pytest
import torch

from data_synth import scenes
from motionlab.humor import three_d


@pytest.fixture(scope="module")
def truth():
    return scenes.held_out(4)


def seeded():
    return torch.Generator().manual_seed(0)


def test_noise_has_the_size_and_hides_nothing(truth):
    seen = three_d.noisy(truth, seeded())
    assert seen.visible.all()
    assert (seen.points - truth.positions).std() == pytest.approx(0.04, rel=0.02)
    assert torch.equal(three_d.noisy(truth, seeded()).points, seen.points)


def test_what_is_low_is_hidden(truth):
    seen = three_d.low_hidden(truth)
    assert not seen.visible[..., truth.skeleton.indices(["left_knee", "right_foot"])].any()
    assert seen.visible[..., truth.skeleton.index("head")].float().mean() > 0.9
    assert 0.2 < 1 - seen.visible.float().mean() < 0.8


def test_filters_beat_the_noise(truth):
    seen = three_d.noisy(truth, seeded())
    found = {n: three_d.scores(x, truth, seen.visible) for n, x in three_d.filtered(seen).items()}
    raw = found.pop("as observed")
    assert raw["all"].mean() == pytest.approx(4 * (8 / torch.pi) ** 0.5, rel=0.03)  # mean of a Maxwell law
    assert min(f["all"].mean() for f in found.values()) < 0.6 * raw["all"].mean()
    assert all((f["acceleration"] < raw["acceleration"]).all() for f in found.values())


def test_the_truth_has_no_error(truth):
    seen = three_d.low_hidden(truth)
    found = three_d.scores(truth, truth, seen.visible)
    assert found["hidden"].abs().max() < 1e-4 and (found["contact F1"] == 1).all() and (found["under floor"] == 0).all()
    assert three_d.scores(truth.positions, truth, seen.visible)["contact F1"].mean() > 0.8
