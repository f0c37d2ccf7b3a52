"""Feet that glide through a gap step: one after the other, lifted on the way, at rest before and behind."""

from dataclasses import replace

import pytest
import torch

from motionlab.diffusion import footsteps
from motionlab.diffusion.planting import planted
from motionlab.motion import Motion
from motionlab.skeleton import ANKLES, BALLS, STANDARD, UPRIGHT

FRAMES, GAP = 70, slice(20, 50)
KNOWN = torch.ones(1, FRAMES, dtype=torch.bool)
KNOWN[:, GAP] = False
LEG = float(STANDARD.offsets[STANDARD.indices(("left_knee", "left_ankle"))].norm(dim=-1).sum())


@pytest.fixture(scope="module")
def glides():
    """Somebody with bent knees stands, stands half a metre on behind a gap, and in between is pushed there."""
    rot = torch.eye(3).repeat(1, FRAMES, len(STANDARD), 1, 1)
    rot[:, :, 0] = UPRIGHT
    root = torch.zeros(1, FRAMES, 3)
    root[..., 1] = 0.5 * ((torch.arange(FRAMES) - 19.0) / 31).clamp(0, 1)
    root[..., 2] = STANDARD.standing_height() - 0.04
    contacts = torch.ones(1, FRAMES, len(STANDARD.contact_names))
    start = Motion(STANDARD, root, rot, 30.0, contacts)
    from motionlab.retarget import two_bone_ik

    heels = start.positions[0][:, STANDARD.indices(ANKLES)] + torch.tensor([0.0, 0.0, 0.04])
    return replace(start, rot=two_bone_ik(start.clip(0), heels).rot[None])


def dragged(motion):
    """Metres that ankles which are low go over the floor in the gap, (F,)."""
    ankle = motion.positions[0][:, STANDARD.indices(ANKLES)]
    low = ankle[..., 2] < ankle[0, :, 2] + 0.03
    return (ankle.diff(dim=0)[..., :2].norm(dim=-1) * (low[1:] & low[:-1])).sum(0)


def test_who_stands_elsewhere_behind_a_gap_steps_there_and_does_not_slide(glides):
    pushed, steps = (planted(glides, known=KNOWN, ease=6, step=step) for step in (False, True))
    assert dragged(pushed).min() > 0.4  # the control: in a line from place to place
    assert dragged(steps).max() < 0.15
    ankle = steps.positions[0][:, STANDARD.indices(ANKLES)]
    high = ankle[..., 2] - ankle[0, :, 2]
    assert high.amax(0).min() > 0.03 and high.min() > -0.005
    assert (steps.positions - glides.positions)[KNOWN].abs().max() < 1e-4


def test_feet_that_glide_together_step_one_after_the_other(glides):
    steps = planted(glides, known=KNOWN, ease=6, step=True)
    speed = steps.positions[0][:, STANDARD.indices(BALLS), :2].diff(dim=0).norm(dim=-1) * 30
    middle = [float((speed[:, f] * torch.arange(FRAMES - 1)).sum() / speed[:, f].sum()) for f in range(2)]
    assert abs(middle[0] - middle[1]) > 8  # frames; a hop: 0
    assert (speed > 1.0).sum(0).min() > 3


def test_feet_that_stay_or_are_not_said_to_stand_keep_their_time():
    time = torch.arange(40, dtype=torch.float64)[None, :, None].expand(1, 40, 2)
    way = torch.stack((0.6 * time / 40, 0 * time, 0 * time), -1).float()
    stands, known = torch.ones(1, 40, 2, dtype=torch.bool), torch.zeros(1, 40, 1, dtype=torch.bool)
    known[:, :5], known[:, 35:] = True, True
    when, anew, moving = footsteps.retimed(way, stands, known, LEG, 30.0)
    assert anew[:, 5:35].all() and not anew[known.expand_as(anew)].any() and 0 < moving.sum() < anew.sum()
    assert (when.diff(dim=1) >= 0).all() and (when[:, 5] < 5).all() and (when[:, 34] > 34).all()
    for path, said in ((0.05 * way, stands), (way, ~stands)):
        when, anew, _ = footsteps.retimed(path, said, known, LEG, 30.0)
        assert torch.equal(when, time.expand_as(when)) and not anew.any()


def test_a_step_is_lifted_by_its_length_and_a_foot_that_is_high_already_is_not():
    still = torch.ones(1, 40, 1, dtype=torch.bool)
    still[:, 10:25] = False
    rest, far = torch.tensor([0.08]), torch.linspace(0, 1, 17)
    ankle = torch.zeros(1, 40, 1, 3)
    ankle[..., 2] = 0.08
    for length, high in ((0.2, 0.024), (0.9, 0.08 * LEG)):
        ankle[0, 9:26, 0, 0] = length * far
        ankle[0, 26:, 0, 0] = length
        rise = footsteps.lifted(ankle, still, rest, LEG)
        assert float(rise.max()) == pytest.approx(high, rel=1e-3) and rise[still].max() == 0
    ankle[0, 10:25, 0, 2] = 0.3
    assert footsteps.lifted(ankle, still, rest, LEG).max() == 0
