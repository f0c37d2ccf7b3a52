"""Fits that know less and less of their camera: what they are told, and what is measured."""

from types import SimpleNamespace

import pytest
import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.humor import camera_trials


@pytest.fixture(scope="module")
def scene():
    return scenes.film("easy", 3)


def seeded():
    return torch.Generator().manual_seed(0)


def test_a_camera_placed_by_eye_is_a_little_off(scene):
    generator, angles, rises = seeded(), [], []
    for _ in range(200):
        camera = camera_trials.placed_by_eye(scene.cameras[0], generator)
        turn = rotation.log(camera.rotation @ scene.cameras[0].rotation.mT)
        angles.append(torch.rad2deg(turn))
        moved = camera.centre - scene.cameras[0].centre
        assert moved[:2].abs().max() < 1e-4
        rises.append(moved[2])
    assert torch.stack(angles).std() == pytest.approx(camera_trials.TILT, rel=0.1)
    assert torch.stack(rises).std() == pytest.approx(camera_trials.RISE, rel=0.15)


def test_each_fit_is_told_less(scene):
    told = camera_trials.knowledge(scene.cameras, seeded())
    assert [given.get("floor") for given in told.values()] == ["camera", "refine", "guess", None]
    assert told["image size only"]["cameras"] == [None] * 3
    assert told["camera and floor"]["cameras"] == scene.cameras
    assert not torch.equal(told["placed by eye"]["cameras"][0].rotation, scene.cameras[0].rotation)


def test_errors_are_taken_before_the_camera(scene, monkeypatch):
    """A fit that finds the truth and the true camera has no error, whatever it was told; stage 2 has its start's."""

    def found(observation, priors, **how):
        return SimpleNamespace(stages={1: scene.truth, 2: scene.truth, 3: scene.truth}, cameras=list(scene.cameras))

    monkeypatch.setattr(camera_trials, "fit", found)
    errors = camera_trials.errors(scene, scene.truth, None, seeded())
    for name, stages in errors.items():
        assert set(stages) == {2, 3}
        assert all(e.abs().max() < 1e-2 for e in stages[3].values()), name
        wrong = stages[2]["none"].min()
        assert (wrong < 1e-2) if name == "camera and floor" else (wrong > 1), name
