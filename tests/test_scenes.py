"""Scenes with truth: legs are hidden indeed, the truth stays outside, a failure changes nothing but the detections."""

from dataclasses import fields, is_dataclass
from functools import cache

import pytest
import torch

from data_synth import corpus, scenes
from motionlab import metrics
from motionlab.motion import Motion
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


def test_the_failure_changes_detections_and_nothing_else(shot):
    clean, failed = shot("walking, legs hidden"), shot("walking, two legs from one")
    assert torch.equal(clean.truth.root, failed.truth.root) and torch.equal(clean.truth.rot, failed.truth.rot)
    assert torch.equal(clean.seen, failed.seen) and torch.equal(clean.pixels, failed.pixels)
    same = ~failed.wrong
    assert torch.equal(clean.observation.keypoints[same], failed.observation.keypoints[same])
    assert failed.wrong.flatten(1).any(1).all() and failed.wrong[:, 45:].sum() == 0
    assert failed.wrong[..., LEGS].sum() > 0.7 * failed.wrong.sum()


@pytest.mark.parametrize(("case", "of"), [("limb flips", "walking"), ("false detections", "easy")])
def test_corruption_is_of_the_same_truth(case, of, shot):
    bad, good = shot(case), shot(of)
    assert torch.equal(bad.truth.root, good.truth.root)
    assert torch.equal(bad.observation.keypoints[~bad.wrong], good.observation.keypoints[~bad.wrong])
    error = (bad.observation.keypoints - bad.pixels).norm(dim=-1)[bad.wrong]
    assert error.median() > 10  # pixels: it is wrong, not noisy


def test_truth_is_not_inside_the_observation(shot):
    def parts(value):
        yield value
        if is_dataclass(value):
            for f in fields(value):
                yield from parts(getattr(value, f.name))

    scene = shot("dance")
    inside = [*parts(scene.observation), *parts(scene.clip(1))]
    assert not any(isinstance(x, Motion) for x in inside)
    exact = (scene.observation.keypoints - scene.pixels).norm(dim=-1)[scene.observation.visible]
    assert (exact == 0).sum() == 0 and exact.median() < 15  # noisy, but of this person


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


def test_held_out_clips_differ():
    motion = scenes.held_out(4, frames=30)
    assert motion.root.shape == (4, 30, 3) and motion.contacts.shape == (4, 30, 9)
    assert torch.equal(scenes.held_out(2, frames=30).root, motion.root[:2])


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
