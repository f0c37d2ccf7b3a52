import numpy as np
import pytest
import torch
import twins

from motionlab.contact import _hysteresis, contacts_from_positions, resting_heights, with_contacts
from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from tests.figures import standing


def test_who_stands_still_touches_with_the_feet_only():
    contacts = with_contacts(standing(10)).contacts
    feet = [name.endswith(("ankle", "foot")) for name in STANDARD.contact_names]
    assert torch.equal(contacts, torch.tensor(feet).float().expand(10, -1))
    torch.testing.assert_close(resting_heights(STANDARD)[5], torch.tensor(STANDARD.sole))
    assert 0.07 < resting_heights(STANDARD)[3] < 0.09


def test_a_slide_or_a_lift_is_no_contact():
    motion = standing(30)
    along = torch.linspace(0, 1, 30)[:, None]  # metres over one second, 1 m/s
    for direction in ([1.0, 0, 0], [0, 0, 1.0]):
        moved = Motion(STANDARD, motion.root + along * torch.tensor(direction), motion.rot, motion.fps)
        assert with_contacts(moved).contacts.sum() == 0


def test_contacts_do_not_depend_on_the_frame_rate():
    """A foot that stands for 0.5 s, steps for 0.5 s, and stands again: the same at 30 and at 120 Hz."""
    shares = []
    for fps in (30, 60, 120):
        time = torch.arange(int(1.5 * fps)) / fps
        phase = ((time - 0.5) / 0.5).clamp(0, 1)
        foot = torch.stack((0.4 * (1 - (torch.pi * phase).cos()), 0 * time, 0.1 * (torch.pi * phase).sin()), -1)
        contact = contacts_from_positions(foot[:, None], fps, 0.0)[:, 0]
        assert contact[0] == contact[-1] == 1 and torch.diff(contact).abs().sum() == 2
        shares.append(contact.mean())
    assert max(shares) - min(shares) < 0.05


def test_hysteresis_agrees_with_its_twin_in_both_directions():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        off = rng.random((40, 3)) < 0.3
        on = (rng.random((40, 3)) < 0.2) & ~off
        found = _hysteresis(torch.as_tensor(on), torch.as_tensor(off)).numpy()
        for c in range(3):
            forward = twins.hysteresis(on[:, c], off[:, c])
            backward = twins.hysteresis(on[::-1, c], off[::-1, c])[::-1]
            assert (found[:, c] == (np.array(forward) | np.array(backward))).all()
        reversed_time = _hysteresis(torch.as_tensor(on[::-1].copy()), torch.as_tensor(off[::-1].copy()))
        assert (reversed_time.numpy() == found[::-1]).all()


def test_flicker_between_the_thresholds_makes_one_contact():
    height = torch.tensor([0.1, 0.05, 0.02, 0.05, 0.02, 0.05, 0.1])
    foot = torch.stack((0 * height, 0 * height, height), -1)[:, None]
    assert contacts_from_positions(foot, 1.0, 0.0)[:, 0].tolist() == [0, 1, 1, 1, 1, 1, 0]
    single = contacts_from_positions(foot, 1.0, 0.0, height=(0.03, 0.03))[:, 0]
    assert single.tolist() == [0, 0, 1, 0, 1, 0, 0]  # the control: one threshold flickers


def test_one_frame_has_no_speed():
    with pytest.raises(ShapeError, match="2"):
        with_contacts(standing(1))
