"""HuMoR's two tests in 3-D: what is hidden, and how noisy the rest."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from data_synth import scenes
from motionlab.humor import three_d
from motionlab.humor.testops import Schedule
from motionlab.humor.weights import JOINTS


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


def test_the_smoothness_with_the_least_error_wins(truth, monkeypatch):
    def fake(observation, priors, *, weights, schedule):
        assert schedule.steps[2] == 0
        off = abs(weights.joints3d_smooth[1] - 100.0)  # JOINTS has 10: the tenfold is best
        return SimpleNamespace(stages={2: replace(truth, root=truth.root + 0.001 * off)})

    monkeypatch.setattr(three_d, "fit", fake)
    best = three_d.tuned(three_d.low_hidden(truth), truth, None, JOINTS, Schedule())
    assert best == replace(JOINTS, joints3d_smooth=(100.0, 100.0, 0.0))
