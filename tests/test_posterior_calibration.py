"""Notebook 09: regions by person, scores and ranks on people whose law is known; an assumed camera."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2, spearmanr

from motionlab.contact import with_contacts
from motionlab.observation import look_at
from motionlab.viz.scene import Scene
from studies.nb09_posterior import assumed_camera as assumed
from studies.nb09_posterior import calibration as cal
from studies.nb09_posterior import figures
from studies.nb09_posterior.hidden_people import Clip
from tests.draws import seeded
from tests.fit_inputs import keypoints, side_camera, two_walks

FRAMES = torch.tensor([2, 9, 16])
RIGHT = chi2.ppf([0.5, 0.8, 0.9], 3) ** 0.5


def people(count, wrong=1.0, seed=0):
    """Clips whose draws are right up to a factor on the error: each place with a spread of its own, 2 to 20 cm."""
    generator, found, places = seeded(seed), [], 60
    for k in range(count):
        size = 0.02 + 0.18 * torch.rand(places, 1, generator=generator)
        noise = [torch.randn(n, places, 3, generator=generator) for n in (1, 64)]
        truth = wrong * size * noise[0][0]
        clip = {"fit": torch.zeros(places, 3), "drawn": {1.0: size * noise[1], 10.0: 3 * size * noise[1]}}
        found.append(Clip(f"person {k // 2}", truth, **clip))
    return found


def test_right_regions_hold_what_they_say_and_widened_ones_on_people_who_had_no_say():
    """Where errors are three times as large as the draws say, the radius grows threefold, and new people are held."""
    for level, wide in zip(cal.LEVELS, RIGHT, strict=True):
        assert cal.held(people(20), 1.0, 1e-4, wide).mean() == pytest.approx(level, abs=0.04)
        assert cal.held(people(20, wrong=3.0), 1.0, 1e-4, wide).mean() < level - 0.25  # control
        found = cal.radius(people(60, wrong=3.0, seed=1), 1.0, 1e-4, level)
        assert found == pytest.approx(3 * wide, rel=0.12)
        assert cal.held(people(20, wrong=3.0, seed=2), 1.0, 1e-4, found).mean() == pytest.approx(level, abs=0.06)


def test_likelihood_chooses_the_temperature_that_is_true():
    assert cal.chosen(people(20)) == (1.0, min(cal.FLOORS))
    assert cal.chosen(people(20, wrong=3.0))[0] == 10.0


def test_energy_score_is_least_for_the_right_spread_and_the_error_of_one_answer():
    truth = torch.randn(4000, 3, generator=seeded(5))
    noise = torch.randn(32, 4000, 3, generator=seeded(6))
    right, narrow, wide = (cal.energy_score(s * noise, truth).mean() for s in (1.0, 0.3, 3.0))
    assert right < narrow and right < wide
    assert torch.allclose(cal.energy_score(noise[:1], truth), 100 * (noise[0] - truth).norm(dim=-1))


def test_rank_correlation_is_scipys():
    x = torch.randint(0, 8, (50,), generator=seeded(7)).float()
    y = x + 4 * torch.randn(50, generator=seeded(8))
    assert cal.ranked(x, y).item() == pytest.approx(spearmanr(x.numpy(), y.numpy()).statistic, abs=1e-5)


def test_spread_follows_error_where_it_should_and_not_where_it_cannot():
    found = cal.follows(people(24), 1.0, seeded(9))
    assert found["within a clip"][1] > 0.2
    shuffled = [Clip(c.person, c.truth, c.fit, {1.0: c.drawn[1.0].flip(1)}) for c in people(24)]
    assert abs(cal.follows(shuffled, 1.0, seeded(9))["within a clip"][0]) < 0.15


# ---------------------------------------------------------------------------- five numbers of an assumed camera
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
    true = side_camera()
    low = look_at(torch.tensor([3.5, 2.0, 1.2]), torch.tensor([0.0, 1.5, 0.7]), focal=500.0, width=1280, height=720)
    seen = assumed.view(clip, torch.zeros(8), keypoints(clip, true), low, FRAMES)
    stature, _, zoom, tilt, rise = assumed.true_numbers(seen, clip, true, FRAMES).tolist()
    assert zoom == pytest.approx(math.log(2), abs=1e-3) and rise == pytest.approx(0.2, abs=1e-5)
    assert tilt == pytest.approx(0.0, abs=1e-5) and abs(stature) < 0.2
    pitched = replace(true, rotation=true.rotation.clone())
    pitched.rotation[:, 2] = assumed.turned(low.rotation[:, 2].double(), torch.tensor([0.1]).double())[0].float()
    assert assumed.true_numbers(seen, clip, pitched, FRAMES)[3].item() == pytest.approx(0.1, abs=1e-5)


def test_a_region_has_its_half_axes_moves_and_goes():
    shapes = np.stack([np.diag([0.01, 0.04, 0.09]), np.zeros((3, 3))])
    with Scene((80, 80)) as scene:
        figures.add_region(scene, [[0.0, 0.0, 1.0], [2.0, 0.0, 1.0]], shapes, 1.0)
        mesh = list(scene.plotter.renderer.actors.values())[-1].mapper.dataset
        assert np.allclose(mesh.bounds, (-0.1, 0.1, -0.2, 0.2, 0.7, 1.3), atol=0.01)
        for update in scene._updates:
            update(1.0)
        assert np.allclose(mesh.bounds, (2.0, 2.0, 0.0, 0.0, 1.0, 1.0))
