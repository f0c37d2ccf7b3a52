"""The official start: one place for every frame, seen or not, on the axis of the camera and upright before it."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab.humor.body_shape import landmarks
from motionlab.humor.evidence import evidence
from motionlab.humor.start import start_facing
from motionlab.observation import project
from motionlab.skeleton import STANDARD, UPRIGHT, fk


@pytest.fixture(scope="module")
def start():
    scene = scenes.without(scenes.film("facing the camera", 2), [0, 30])
    rest, turns = fk(STANDARD, torch.zeros(3), torch.eye(3).expand(22, 3, 3))
    marks = landmarks(rest[None, None], turns[None, None], torch.zeros(1, 8))[0, 0]
    return scene, *start_facing(evidence(scene.observation, cameras=scene.cameras), marks)


def test_every_frame_starts_at_one_place(start):
    _, place, turn = start
    assert place.shape == (2, 60, 3) and turn.shape == (2, 60, 3, 3)
    assert (place == place[:, :1]).all() and (turn == turn[:, :1]).all()
    assert not torch.allclose(place[0], place[1])


def test_on_the_axis_upright_facing_the_camera(start):
    scene, place, turn = start
    for i, camera in enumerate(scene.cameras):
        pixel, depth = project(camera, place[i, 0])
        assert (pixel - torch.tensor([camera.width / 2, camera.height / 2])).abs().max() < 0.1
        distance = (scene.truth.root[i, 0] - camera.centre).norm()
        assert 0.5 * distance < depth < 2.5 * distance
        assert turn[i, 0, 2, 1] > 0.9  # up is up, but for the camera's tilt
        towards = camera.centre - scene.truth.root[i].mean(0)
        assert (turn[i, 0, :2, 2] * towards[:2]).sum() > 0  # forward looks at the camera
        angle = ((turn[i, 0].trace() - 1) / 2).clamp(-1, 1).arccos()
        assert torch.rad2deg(angle) > 150 and UPRIGHT.trace() == -1  # near the cut of the rotation vector


def test_half_a_person_starts_too_far_away(start):
    scene, place, _ = start
    observation = scene.observation
    hidden = observation.confidence.clone()
    hidden[..., 8:15] = 0
    rest, turns = fk(STANDARD, torch.zeros(3), torch.eye(3).expand(22, 3, 3))
    marks = landmarks(rest[None, None], turns[None, None], torch.zeros(1, 8))[0, 0]
    far, _ = start_facing(evidence(replace(observation, confidence=hidden), cameras=scene.cameras), marks)
    for i, camera in enumerate(scene.cameras):
        assert (far[i, 0] - camera.centre).norm() > 1.2 * (place[i, 0] - camera.centre).norm()
