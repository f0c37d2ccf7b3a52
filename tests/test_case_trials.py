"""Many cases in one fit: every case gets its own clips back, and a perfect fit has no error."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from data_synth import scenes
from motionlab.humor import case_trials, priors
from motionlab.humor.testops import Schedule


@pytest.fixture(scope="module")
def filmed():
    return {"easy": scenes.film("easy", 3), "dance": scenes.film("dance", 2)}


def fake_fit(observation, priors, *, cameras, **how):
    """Root x is the first pixel's x of every frame, the camera the one given: what comes back can be told apart."""
    motion = scenes.held_out(1).clip(0)
    clips = len(cameras)
    root = motion.root.repeat(clips, 1, 1)
    root[..., 0] = observation.keypoints[..., 0, 0]
    skeleton = replace(motion.skeleton, offsets=motion.skeleton.offsets.expand(clips, 1, 22, 3))
    motion = replace(motion, skeleton=skeleton, root=root, rot=motion.rot.expand(clips, -1, -1, -1, -1), contacts=None)
    return SimpleNamespace(
        stages={2: motion}, contacts=torch.zeros(clips, 60, 9), betas=torch.zeros(clips, 8), cameras=cameras,
        results={2: [SimpleNamespace(seconds=1.0)]},
    )  # fmt: skip


def test_every_case_gets_its_own_clips_back(filmed, monkeypatch):
    monkeypatch.setattr(case_trials, "fit", fake_fit)
    found = case_trials.fit_together(filmed, None, batch=2)
    for name, scene in filmed.items():
        assert torch.equal(found[name].stages[2].root[..., 0], scene.observation.keypoints[..., 0, 0])
        assert found[name].cameras == list(scene.cameras)
        assert found[name].stages[2].positions.shape == (len(scene), 60, 22, 3)
    assert sum(f.seconds for f in found.values()) == pytest.approx(3.0)  # three batches of a second


def test_a_perfect_fit_has_no_error_and_a_shifted_one_has_it_in_the_world_only(filmed):
    scene = filmed["easy"]
    exact = case_trials.scores(scene.truth, scene.truth, scene.seen)
    for measure in ("all", "seen", "hidden", "legs", "world", "acceleration"):
        assert exact[measure].nan_to_num().abs().max() < 1e-3, measure
    assert (exact["contact F1"] == 1).all()
    moved = replace(scene.truth, root=scene.truth.root + torch.tensor([0.0, 0.1, 0.0]))
    shifted = case_trials.scores(moved, scene.truth, scene.seen)
    assert shifted["all"].max() < 1e-3 and (shifted["world"] - 10).abs().max() < 1e-3
    sunk = replace(scene.truth, root=scene.truth.root - torch.tensor([0.0, 0.0, 0.2]))
    assert (case_trials.scores(sunk, scene.truth, scene.seen)["under floor"] > 90).all()


def test_hidden_joints_are_the_masked_ones(filmed):
    scene = filmed["easy"]
    bent = scene.truth.rot.clone()
    bent[:, :, scene.truth.skeleton.index("left_knee")] = torch.eye(3)
    fit, seen = replace(scene.truth, rot=bent), torch.ones_like(scene.seen)
    seen[..., scene.truth.skeleton.indices(["left_ankle", "left_foot"])] = False
    found = case_trials.scores(fit, scene.truth, seen)
    assert (found["hidden"] > 0.5).all() and found["seen"].abs().max() < 1e-3


def test_later_error_looks_after_the_gap(filmed):
    truth = filmed["easy"].truth
    step = torch.zeros(60, 1)
    step[31:] = 0.05
    fit = replace(truth, root=truth.root + step * torch.tensor([1.0, 0.0, 0.0]))
    before, after = case_trials.later_error(fit, truth, [30])
    assert before.abs().max() < 1e-3 and (after - 5).abs().max() < 1e-3
    assert (case_trials.later_error(fit, truth, [58, 59])[1] - 5).abs().max() < 1e-3
    assert case_trials.later_error(fit, truth, [0])[0].isnan().all()


def test_smoothing_keeps_what_is_smooth_and_takes_noise_away(filmed):
    motion = filmed["easy"].truth
    assert case_trials.smoothed(motion, 0) is motion
    time = torch.arange(60) / 30
    fall = replace(motion, root=(time.square()[:, None] * torch.tensor([0.3, -0.2, 0.1])).expand(3, 60, 3))
    assert (case_trials.smoothed(fall, 9).root - fall.root).abs().max() < 1e-4  # a parabola, to a parabola's filter
    shaken = replace(
        motion, root=motion.root + 0.02 * torch.randn(3, 60, 3, generator=torch.Generator().manual_seed(0))
    )
    before, after = ((m.root - motion.root).norm(dim=-1).mean() for m in (shaken, case_trials.smoothed(shaken, 9)))
    assert after < 0.6 * before
    turned = case_trials.smoothed(motion, 5).rot
    assert (turned @ turned.mT - torch.eye(3)).abs().max() < 1e-5


def test_two_processes_find_what_one_finds(filmed):
    how = {"schedule": Schedule(steps=(1, 1, 0), inner=3)}
    seen = {"dance": filmed["dance"]}
    one, two = (case_trials.fit_together(seen, priors.load(), workers=n, **how)["dance"] for n in (1, 2))
    assert (one.stages[2].positions - two.stages[2].positions).norm(dim=-1).max() < 1e-3


def test_stage_2_is_tried_with_every_weight_and_filter(filmed, monkeypatch):
    tried = []

    def noted(seen, priors, *, schedule, weights, **how):
        tried.append(weights.joints3d_smooth)
        return {name: SimpleNamespace(stages={2: scene.truth}) for name, scene in seen.items()}

    monkeypatch.setattr(case_trials, "fit_together", noted)
    rows = case_trials.stage_2_rows(filmed, None, Schedule(), smoothness=(7.0, 3.0), filters=(0, 15))
    assert tried == [(7.0, 7.0, 0.0), (3.0, 3.0, 0.0)]
    assert [row["filter, frames"] for row in rows] == [0, 15, 0, 15]
    assert rows[0]["all"] < 1e-3 < rows[1]["all"]  # the truth, and the truth blurred
