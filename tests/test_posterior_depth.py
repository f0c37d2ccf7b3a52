from dataclasses import replace

import pytest
import torch

from motionlab.contact import with_contacts
from motionlab.errors import ShapeError
from motionlab.humor import energies
from motionlab.motion import Motion
from motionlab.posterior import depth
from motionlab.posterior.depth import KNOWLEDGE, Known
from motionlab.posterior.sampling import mixed, sample
from motionlab.skeleton import STANDARD
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


def test_size_alone_scales_the_floor_below_the_camera(seen):
    """A person grown by 10 % about his pelvis at the same place sinks into the floor unless the camera is higher."""
    grown = theta(0.1, 0.1, 0.0)
    _, rest = seen.residuals(grown, Known(feet=True))
    expected = seen.height * (1 - torch.tensor(0.1).exp())  # similar triangles about the camera
    feet = rest[2:].reshape(3, 4) * depth.FOOT
    flat = seen.residuals(theta(0, 0, 0), Known(feet=True))[1][2:].reshape(3, 4) * depth.FOOT
    assert torch.allclose(feet, 1.1052 * flat + expected.double(), atol=2e-3)


def test_the_most_probable_point_and_its_width_agree_with_the_chain(seen, generator):
    known = KNOWLEDGE["and camera height to 5 cm"]
    mean, factor = seen.laplace(known)
    start = mean + torch.randn(24, 3, generator=generator, dtype=torch.float64) @ factor.mT
    found = sample(
        lambda x: seen.log_prob(x, known), start, names=depth.NAMES, generator=generator, steps=3000,
        moves=mixed(mean, factor),
    )  # fmt: skip
    sigma = (factor @ factor.mT).diagonal().sqrt()
    assert ((found.draws().mean(0) - mean).abs() < 0.25 * sigma).all()
    assert torch.allclose(found.draws().std(0), sigma, rtol=0.2)


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


def test_wrongly_measured_camera_moves_the_person_by_its_share(seen):
    known = KNOWLEDGE["and camera height to 1 cm"]
    right, _ = seen.laplace(known)
    wrong, _ = seen.moved(0.05).laplace(known)
    assert float(wrong[1] - right[1]) == pytest.approx(0.05 / seen.height, rel=0.25)


def test_true_numbers_of_a_person_moved_or_grown_are_his_way_and_growth(clip, camera, seen):
    here = depth.true_numbers(seen, clip, camera, FRAMES)
    rest = clip.skeleton.rest_positions()[..., 1]
    standard = STANDARD.rest_positions()[..., 1]
    taller = (rest.max() - rest.min()) / (standard.max() - standard.min())
    assert torch.allclose(here, theta(float(taller.log()), 0, 0), atol=1e-6)
    away = camera.centre + 1.1 * (clip.root - camera.centre)
    moved = depth.true_numbers(seen, replace(clip, root=away), camera, FRAMES)
    assert moved[1] == pytest.approx(0.09531, abs=1e-4)
    tall = replace(clip, skeleton=clip.skeleton.scaled(1.05))
    assert (depth.true_numbers(seen, tall, camera, FRAMES) - here)[0] == pytest.approx(0.04879, abs=1e-4)


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
