"""Five numbers of an assumed camera: the image's own symmetry, the floor, a known case."""

import math
from dataclasses import replace

import pytest
import torch

from motionlab.contact import with_contacts
from motionlab.observation import look_at
from studies.nb09_posterior import assumed_camera as assumed
from tests.fit_inputs import keypoints, side_camera, two_walks

FRAMES = torch.tensor([2, 9, 16])


@pytest.fixture(scope="module")
def clip():
    return with_contacts(two_walks().clip(0))


@pytest.fixture(scope="module")
def seen(clip):
    return assumed.view(clip, torch.zeros(8), keypoints(clip, side_camera()), side_camera(), FRAMES)


def image(seen, *theta):
    """The image's part of the energy alone: nothing touches, nothing is known."""
    view, free = replace(seen, touching=torch.zeros_like(seen.touching)), torch.full((5,), 1e9).double()
    return view.log_prob(torch.tensor([theta]).double(), torch.zeros(5).double(), free).item()


def test_as_tall_as_far_is_the_same_image_and_either_alone_is_not(seen):
    assert image(seen, 0, 0, 0, 0, 0) == pytest.approx(0.0, abs=1e-3)
    assert image(seen, 0.3, 0.3, 0, 0, 0) == pytest.approx(0.0, abs=1e-3)
    for one in ((0.3, 0, 0, 0, 0), (0, 0.3, 0, 0, 0), (0, 0, 0.3, 0, 0)):
        assert image(seen, *one) < -30
    assert image(seen, 0, 0.1, 0, 0, 0) < 5 * image(seen, 0, 0.1, 0.1, 0, 0) < 0  # a longer lens, but for perspective


def test_a_raised_or_turned_camera_lifts_feet_off_the_floor(seen):
    view, middle = replace(seen, touching=torch.ones_like(seen.touching)), torch.zeros(5).double()
    at = torch.tensor([[0, 0, 0, 0, 0], [0, 0, 0, 0, 0.3], [0, 0, 0, 0.1, 0]]).double()
    level, raised, turned = view.log_prob(at, middle, torch.full((5,), 1e9).double()).tolist()
    assert raised < level - 15 and turned < level - 15


def test_numbers_that_are_true_of_a_known_case(clip):
    """The fit assumed half the focal length, from where it stood, turned a little and lower: these are its errors."""
    true = look_at(torch.tensor([3.5, 2.0, 1.4]), torch.tensor([0.0, 1.5, 0.9]), focal=1000.0, width=1280, height=720)
    down = torch.tensor([0.0, 0.0, 0.2])
    low = look_at(torch.tensor([3.5, 2.0, 1.4]) - down, torch.tensor([0.0, 1.5, 0.9]) - down, focal=500.0, width=1280,
                  height=720)  # fmt: skip
    seen = assumed.view(clip, torch.zeros(8), keypoints(clip, true), low, FRAMES)
    stature, _, zoom, tilt, rise = assumed.true_numbers(seen, clip, true, FRAMES).tolist()
    assert zoom == pytest.approx(math.log(2), abs=1e-3) and rise == pytest.approx(0.2, abs=1e-5)
    assert tilt == pytest.approx(0.0, abs=1e-5) and abs(stature) < 0.2
    pitched = replace(true, rotation=true.rotation.clone())
    pitched.rotation[:, 2] = assumed.turned(low.rotation[:, 2].double(), torch.tensor([0.1]).double())[0].float()
    assert assumed.true_numbers(seen, clip, pitched, FRAMES)[3].item() == pytest.approx(0.1, abs=1e-5)
