"""Changes of velocity at every step, and whether what was given has stayed."""

import math

import numpy as np
import pytest
import torch

from studies.shared import inbetween_measures as inbetween
from tests.draws import seeded


def straight(frames=12, speed=1.5):
    t = torch.arange(frames, dtype=torch.float64)[:, None, None] / 30
    return (t * torch.tensor([speed, 0.0, 0.0])).expand(-1, 4, 3).clone()


def test_step_changes_agree_with_loops():
    p = torch.randn(2, 7, 3, 3, generator=seeded(1), dtype=torch.float64)
    found = inbetween.step_changes(p, 30.0)
    change = {
        (i, t): np.mean([math.dist(p[i, t + 1, j] - p[i, t, j], p[i, t, j] - p[i, t - 1, j]) for j in range(3)]) * 30
        for i in range(2)
        for t in range(1, 6)
    }
    for i in range(2):
        for step in range(6):
            assert found[i, step] == pytest.approx(max(change.get((i, t), -1) for t in (step, step + 1)))
    assert len(inbetween.natural_changes(p, 30.0)) == 2 * 4


def test_the_worst_error_looks_at_known_frames_only():
    truth = straight()
    found = truth.clone()
    known = torch.zeros(12, dtype=torch.bool)
    known[[0, 11]] = True
    found[5] += 9.0
    assert inbetween.worst_known_m(found, truth, known) == 0
    found[11, 2, 1] += 0.04
    assert inbetween.worst_known_m(found, truth, known).item() == pytest.approx(0.04)
    assert inbetween.worst_known_m(found, truth, torch.zeros(12)).isnan()
