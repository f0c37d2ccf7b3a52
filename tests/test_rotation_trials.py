import math

import pytest
import torch

from motionlab import rotation
from motionlab.skeleton import UPRIGHT
from studies.nb02_rotations import trials


def spinning(rounds_per_second, seconds=10.0, count=3):
    t = torch.arange(round(seconds * 30)) / 30
    return [rotation.rotation_about("z", 2 * math.pi * rounds_per_second * t + i) @ UPRIGHT for i in range(count)]


def seed(value=0):
    return torch.Generator().manual_seed(value)


def test_every_body_with_level_hips_is_on_the_cut():
    """In the heading frame the left axis goes to -x: an eigenvalue of -1, so a half turn, however far it bows."""
    for bow in (0.0, 0.4, math.pi / 2, math.pi):
        bowed = [root @ rotation.rotation_about("x", torch.tensor(bow)) for root in spinning(0.1, seconds=1.0)]
        assert trials.canonical_angle(bowed).min() > 179.9
    leaning = [root @ rotation.rotation_about("z", torch.tensor(0.5)) for root in spinning(0.1, seconds=1.0)]
    # quaternion product of the half turn about (0, 1, 1)/sqrt(2) with a lean of 0.5 about the body's z
    expected = 2 * math.degrees(math.acos(math.sin(0.25) / math.sqrt(2)))
    assert trials.canonical_angle(leaning).max() == pytest.approx(expected, abs=0.1)


def test_flips_follow_from_the_rate_of_turning():
    # each full turn passes the cut once; carried and decoded then disagree until, a turn later, they differ by more
    flips = trials.count_flips(spinning(0.5), seed())
    assert flips.minutes == pytest.approx(0.5)
    assert flips.midpoint_deg.median() == pytest.approx(180, abs=0.1)
    assert (flips.per_minute > 0).all()
    assert flips.sixd_per_minute.max() == 0
    assert flips.sixd_midpoint_deg.max() < 0.1
    still = trials.count_flips([root[:1].expand(300, 3, 3) for root in spinning(0.5)], seed())
    assert still.per_minute.max() == 0


def test_gaps_are_lively_do_not_overlap_and_obey_the_most():
    paths = trials.lively_gaps(spinning(0.5), seed(), most=10)
    assert len(paths) == 10
    turn = torch.rad2deg(rotation.geodesic(paths[:, 9], paths[:, -10]))
    assert (turn >= 20).all()
    assert len(trials.lively_gaps(spinning(0.01), seed(), most=10)) == 0
