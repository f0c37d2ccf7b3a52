import math
from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from studies.nb01_data import sources_compared
from tests.draws import seeded
from tests.figures import standing


def noisy(seed, shift, people=30):
    table = shift + torch.randn(10 * people, len(sources_compared.DESCRIPTION_UNITS), generator=seeded(seed))
    return sources_compared.Windows(table, torch.arange(people).repeat_interleave(10), ("walk",) * len(table))


def test_a_judge_tells_apart_what_differs_and_tosses_a_coin_otherwise():
    for other in (noisy(1, 0.0), noisy(1, 0.0, people=4)):  # the few: a quarter of its windows are of the one judged
        assert sources_compared.judge(noisy(0, 0.0), other).mean() == pytest.approx(0.5, abs=0.08)
    assert len(found := sources_compared.judge(noisy(0, 0.0), noisy(1, 2.0))) == 30 and found.min() > 0.9


def test_what_differs_most_is_found_on_other_people():
    (made := noisy(1, 0.0)).table[:, 3] -= 1.0
    found = [sources_compared.lacking(noisy(0, 0.0), some) for some in (noisy(1, 0.0), made)]
    chance, most = (sources_compared.largest_elsewhere(gaps).mean() for gaps in found)
    assert chance < 0.3 and most == pytest.approx(1.0, abs=0.15)


def test_quick_motion_is_the_share_above_four_hertz():
    motion = standing(90)
    t = torch.arange(90) / 30
    slow, fast = (motion.root + torch.stack((0.1 * (2 * math.pi * f * t).sin(), 0 * t, 0 * t), -1) for f in (1.0, 8.0))
    share = [sources_compared.describe(replace(motion, root=r))["quick motion"].item() for r in (slow, fast)]
    assert share[0] < 1 < 99 < share[1]


def test_feet_on_the_floor_are_measured():
    motion = standing(90)
    lifted = replace(motion, root=motion.root + torch.tensor([0.0, 0.0, 0.4]))
    on, off = (sources_compared.describe(m)["feet on the floor"].item() for m in (motion, lifted))
    assert (on, off) == (100, 0)


def test_describe_a_turning_gliding_statue():
    t = torch.arange(30) / 30
    aa = torch.zeros(30, 22, 3)
    aa[:, STANDARD.index("left_knee"), 0] = aa[:, STANDARD.index("right_knee"), 0] = math.radians(40)
    rot = rotation.axis_angle_to_matrix(aa)
    rot[:, 0] = rotation.rotation_about("z", math.radians(90) * t) @ UPRIGHT
    root = torch.stack((1.2 * t, torch.zeros(30), torch.full((30,), 0.992)), -1)
    found = sources_compared.describe(Motion(STANDARD, root, rot, 30.0))
    assert set(found) == set(sources_compared.DESCRIPTION_UNITS)
    expected = {"root speed": 1.2, "turning rate": 90.0, "knee flexion": 40.0, "elbow flexion": 0.0}
    for name, value in expected.items():
        assert found[name].item() == pytest.approx(value, abs=0.05), name
