"""Scenes with truth: legs are hidden indeed, the truth stays outside, a failure changes nothing but the detections."""

from functools import cache

import pytest
import torch

from data_synth import corpus, scenes
from motionlab import metrics
from motionlab.observation import BODY_25, project

LEGS = [BODY_25.index(f"{s}_{p}") for s in ("left", "right") for p in ("knee", "ankle", "heel", "big_toe")]
KNEES, HIPS = (["left_knee", "right_knee"], ["left_hip", "right_hip"])


@pytest.fixture(scope="module")
def shot():
    return cache(lambda case, count=3: scenes.film(case, count))


@pytest.mark.parametrize("case", scenes.CASES)
def test_shapes_and_finite(case, shot):
    scene = shot(case)
    assert scene.truth.root.shape == (3, 60, 3) and scene.observation.keypoints.shape == (3, 60, 25, 2)
    assert len(scene) == len(scene.occluders) == 3 and scene.seen.shape == (3, 60, 22)
    assert scene.truth.positions.isfinite().all() and scene.observation.keypoints.isfinite().all()
    assert scene.truth.fps == scene.observation.fps == 30.0
    assert (scene.truth.positions[..., 2] > -0.01).all()
    lengths = scene.truth.skeleton.offsets[:, 0, 1:].norm(dim=-1)
    assert ((lengths[0] - lengths[1]).abs() > 1e-3).any()  # different people


def test_cameras_show_the_truth_where_the_pixels_say(shot):
    scene = shot("easy")
    knee = scene.truth.positions[:, :, scene.truth.skeleton.index("left_knee")]
    for i, camera in enumerate(scene.cameras):
        pixels, _ = project(camera, knee[i])
        assert (pixels - scene.pixels[i, :, BODY_25.index("left_knee")]).abs().max() < 0.01


def test_people_are_not_in_the_corpus():
    known = {s.name for s in corpus.SUBJECTS} - {corpus.Recipe().heldout_subject}
    people = [scenes.person(i, torch.Generator().manual_seed(i)) for i in range(6)]
    assert people[0].name == corpus.Recipe().heldout_subject and not known & {p.name for p in people}
    trained = [s.skeleton.offsets for s in corpus.SUBJECTS if s.name in known]
    assert all((p.skeleton.offsets - o).abs().max() > 1e-3 for p in people for o in trained)


def test_sitting_hides_the_legs_from_the_first_frame_and_ends_on_the_seat(shot):
    scene = shot("sitting, legs hidden")
    assert not scene.observation.visible[..., LEGS].any()
    assert not scene.seen[..., scene.truth.skeleton.indices(KNEES)].any()
    assert scene.observation.visible[..., BODY_25.index("neck")].all()
    tilt, bend = (angle.mean(-1) for angle in metrics.tilt_and_bend(scene.truth))
    assert (tilt[:, -10:] > 60).all() and (bend[:, -10:] > 60).all()
    assert (tilt[:, :3] < 30).all()


def test_passing_shows_the_legs_first_and_hides_them_later(shot):
    scene = shot("walking, legs hidden", 4)
    visible = scene.observation.visible[..., LEGS].float()
    assert visible[:, :15].mean() > 0.8 and visible[:, 35:].mean() < 0.05
    leads = visible[:, 15:40].view(4, 25, 2, 4).mean(-1)  # one leg vanishes before the other in some frame
    assert ((leads[..., 0] - leads[..., 1]).abs() > 0.7).any(1).float().mean() > 0.7


TWO_LEGS = "walking, two legs from one"
CHANGED = [(TWO_LEGS, "walking, legs hidden"), ("limb flips", "walking"), ("false detections", "easy")]


@pytest.mark.parametrize(("case", "of"), CHANGED)
def test_the_failure_changes_detections_of_the_same_truth_and_nothing_else(case, of, shot):
    bad, good = shot(case), shot(of)
    assert torch.equal(good.truth.root, bad.truth.root) and torch.equal(good.truth.rot, bad.truth.rot)
    assert torch.equal(good.seen, bad.seen) and torch.equal(good.pixels, bad.pixels)
    assert torch.equal(bad.observation.keypoints[~bad.wrong], good.observation.keypoints[~bad.wrong])
    assert (bad.observation.keypoints - bad.pixels).norm(dim=-1)[bad.wrong].median() > 10  # wrong, not noisy
    if case == TWO_LEGS:
        assert bad.wrong.flatten(1).any(1).all() and bad.wrong[:, 45:].sum() == 0
        assert bad.wrong[..., LEGS].sum() > 0.7 * bad.wrong.sum()


def test_without_drops_whole_frames_and_keeps_the_rest(shot):
    scene = shot("easy")
    gap = scenes.without(scene, [29, 30, -1])
    assert not gap.observation.visible[:, [29, 30, 59]].any() and not gap.seen[:, [29, 30, 59]].any()
    kept = [t for t in range(60) if t not in (29, 30, 59)]
    assert torch.equal(gap.observation.keypoints[:, kept], scene.observation.keypoints[:, kept])
    assert scene.observation.visible[:, 29].any()  # the original is untouched


def test_clips_do_not_depend_on_the_count_or_on_the_call(shot):
    one, three = scenes.film("dance", 1), shot("dance")
    assert torch.equal(one.observation.keypoints[0], three.observation.keypoints[0])
    assert not torch.equal(scenes.film("dance", 1, seed=1).truth.rot, one.truth.rot)


def test_tumble_goes_head_over_heels(shot):
    truth = shot("tumble").truth
    head = truth.positions[..., truth.skeleton.index("head"), 2] - truth.root[..., 2]
    assert (head.amin(1) < -0.2).all() and (head[:, 0] > 0.3).all()
    low = truth.positions[..., 2].amin(-1)
    assert (low > 0.0).all() and (low < 0.15).all()  # it stays on the floor


def test_recorded_motion_is_filmed_with_one_camera_in_every_view():
    motions = [scenes.held_out(2, frames=30).clip(i) for i in range(2)]
    found = {view: scenes.film_recorded(view, motions) for view in scenes.VIEWS}
    plain = found["plain view"]
    assert torch.equal(plain.truth.root, torch.stack([m.root for m in motions]))
    for view, scene in found.items():
        assert torch.equal(scene.pixels, plain.pixels) and all(scene.occluders) == (view != "plain view")
    front = scenes.film_recorded("plain view", motions, facing=True).cameras
    assert all((c.centre - m.root[15])[:2] @ m.rot[15, 0, :2, 2] > 0 for c, m in zip(front, motions, strict=True))
    hidden = {view: 1 - scene.observation.visible[..., LEGS].float().mean() for view, scene in found.items()}
    assert hidden["legs behind a desk"] > 0.9 and hidden["plain view"] < 0.3
