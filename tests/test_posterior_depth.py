from dataclasses import replace

import pytest
import torch

from motionlab.contact import with_contacts
from motionlab.errors import ShapeError
from motionlab.humor import energies
from motionlab.motion import Motion
from studies.nb09_posterior import depth
from studies.nb09_posterior.depth import KNOWLEDGE, Known
from tests.fit_inputs import keypoints

FRAMES = torch.tensor([2, 9, 16])


@pytest.fixture(scope="module")
def clip(walk):
    motion = with_contacts(walk.clip(0))
    return replace(motion, contacts=torch.ones_like(motion.contacts))


@pytest.fixture(scope="module")
def seen(clip, camera):
    return depth.view(clip, torch.zeros(8), keypoints(clip, camera), camera, FRAMES)


def theta(*numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def test_the_fitted_person_projects_onto_what_was_seen_of_him(seen):
    miss, rest = seen.residuals(theta(0, 0, 0), Known(feet=True))
    assert miss.abs().max() < 1e-2 and rest.shape == (2 + 12,)


def test_twice_as_large_twice_as_far_is_the_same_image(seen):
    """The pinhole's own symmetry, of which the formula does not know."""
    both = theta(0.3, 0.3, 0.0)
    assert seen.residuals(both, Known())[0].abs().max() < 1e-2
    for one in (theta(0.3, 0, 0), theta(0, 0.3, 0)):  # control
        assert seen.residuals(one, Known())[0].abs().max() > 20


def test_image_part_is_the_energy_of_a_fit(seen):
    at = theta(0.05, -0.02, 0.0)
    miss, rest = seen.residuals(at, Known())
    pixels = (miss + seen.pixels)[None]
    energy = energies.joints2d(pixels, seen.pixels[None], seen.weight[None])[0] / (2 * depth.PIXEL**2)
    assert seen.log_prob(at, Known()) == pytest.approx(-float(energy + 0.5 * rest.square().sum()), rel=1e-6)


def test_stature_fixes_distance_and_a_floor_of_unknown_height_does_not_but_a_measured_one_does(seen):
    width = {}
    for name, known in KNOWLEDGE.items():
        _, factor = seen.laplace(known)
        width[name] = float((factor @ factor.mT)[1, 1].sqrt())
    assert width["image"] == pytest.approx(0.5, rel=0.02)
    assert width["and stature"] == pytest.approx(depth.STATURE, rel=0.05)
    assert width["and feet on a floor"] == pytest.approx(width["and stature"], rel=0.05)
    height = seen.height
    for name, measured in (("and camera height to 5 cm", 0.05), ("and camera height to 1 cm", 0.01)):
        ruler = (measured**2 + depth.FOOT**2 / 12) ** 0.5 / height  # twelve joints of feet stand on it
        by_hand = (depth.STATURE**-2 + ruler**-2) ** -0.5  # two independent rulers
        assert width[name] == pytest.approx(by_hand, rel=0.2)


def test_undetected_points_do_not_count(clip, camera, seen):
    blind = keypoints(clip, camera)
    blind = replace(blind, confidence=blind.confidence.clone(), keypoints=blind.keypoints.clone())
    blind.confidence[:, 3], blind.keypoints[:, 3] = 0.0, torch.nan
    found = depth.view(clip, torch.zeros(8), blind, camera, FRAMES)
    value, before = (v.log_prob(theta(0.1, 0, 0), Known()) for v in (found, seen))
    assert value.isfinite() and value > before


def test_a_batch_or_a_fit_without_contacts_is_refused(clip, camera):
    for bad in (replace(clip, contacts=None), Motion(clip.skeleton, clip.root[None], clip.rot[None], 30.0)):
        with pytest.raises(ShapeError):
            depth.view(bad, torch.zeros(8), keypoints(clip, camera), camera, FRAMES)
