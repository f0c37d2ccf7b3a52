"""Measures of gait, and paired differences, against what is known."""

import math
from dataclasses import replace

import pytest
import torch

from motionlab import metrics, rotation
from motionlab.skeleton import STANDARD
from studies.shared.sitting import sits
from tests.draws import seeded
from tests.figures import standing


def bent(hip, knee):
    """Two who stand, but with both thighs raised by ``hip`` degrees and both knees flexed by ``knee``."""
    motion = standing(40)
    for side in ("left", "right"):
        for part, degrees in (("hip", -hip), ("knee", knee)):
            turn = rotation.exp(torch.tensor([math.radians(degrees), 0.0, 0.0]))
            motion.rot[:, STANDARD.index(f"{side}_{part}")] = turn
    return replace(motion, root=motion.root.repeat(2, 1, 1), rot=motion.rot.repeat(2, 1, 1, 1, 1))


def test_angles_of_a_seat():
    tilt, bend = metrics.tilt_and_bend(bent(90, 80))
    rest_tilt, rest_bend = metrics.tilt_and_bend(bent(0, 0))
    assert ((tilt - rest_tilt) - 90).abs().max() < 3 and ((bend - rest_bend) - 80).abs().max() < 3


@pytest.mark.parametrize(("hip", "knee", "seated"), [(90, 90, 1), (90, 20, 0), (20, 90, 0), (0, 0, 0)])
def test_who_sits(hip, knee, seated):
    assert sits(bent(hip, knee), torch.ones(2, 40)).tolist() == [seated] * 2


def test_paired_differences():
    x = torch.randn(200, generator=seeded())
    found = metrics.paired(x + 1 + 0.1 * torch.randn(200, generator=seeded(1)), x, seeded(2))
    assert found.low < 1 < found.high < 1.1 and found.n == 200
    assert metrics.paired(torch.tensor([1.0, torch.nan, 3.0]), torch.zeros(3), seeded()).n == 2
    assert str(found).startswith("+1.0")
