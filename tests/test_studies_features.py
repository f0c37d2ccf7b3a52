"""Features that generated motion is judged in: what they see, how they are trained and kept."""

import json
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion.windows import gather, on_standard
from motionlab.heading import Frame, local_to_world
from motionlab.metrics import frechet
from motionlab.motion import mirror
from motionlab.rotation import rotation_about
from motionlab.skeleton import STANDARD
from motionlab.training import recipes
from studies.shared import feature_training

TINY = feature_training.EncoderRecipe(frames=12, size=6, width=8, steps=120, batch=8, lr=5e-3, seed=3)
PARTS = list(feature_training.FEATURE_GROUPS.values())


@pytest.fixture(scope="module")
def motions():
    return [perform_sequence(Corpus(seconds=8.0, seed=3), index).motion for index in (0, 1)]


@pytest.fixture(scope="module")
def data(motions):
    return gather([on_standard(m) for m in motions], TINY.frames)


@pytest.fixture(scope="module")
def some(data):
    return replace(data.evenly(40), skeleton=STANDARD)


@pytest.fixture(scope="module")
def trained(data, some):
    return feature_training.train_encoder(data, TINY, some)


def test_signals_do_not_know_place_or_heading(some):
    elsewhere = local_to_world(Frame(rotation_about("z", torch.tensor(1.1)), torch.tensor([3.0, -2.0, 0.0])), some)
    torch.testing.assert_close(feature_training.signals(elsewhere), feature_training.signals(some), atol=2e-3, rtol=0)


def test_signals_show_a_drift_and_the_sliding_of_feet_that_stand(some):
    drift = torch.arange(12) / 30 * 0.2
    slid = replace(some, root=some.root + torch.stack((drift, 0 * drift, 0 * drift), -1))
    was, now = (feature_training.signals(m).split(PARTS, -1) for m in (some, slid))
    assert (now[0] - was[0]).norm(dim=-1)[:, -1].sub(0.2 * 11 / 30).abs().max() < 1e-4
    torch.testing.assert_close(now[1], was[1], atol=1e-5, rtol=0)  # joints about the root
    stands = was[3] < 0.1  # slower than about 5 mm/s, or not low
    low = some.positions[..., STANDARD.indices(feature_training.FEET), 2] < 0.03
    assert (stands & low).sum() > 100
    assert now[3][stands & low].median() > 10 * was[3][stands & low].median().clamp(min=0.01)


def test_a_foot_high_above_the_floor_does_not_slide(some):
    up = replace(some, root=some.root + torch.tensor([0.0, 0.0, 0.5]))
    assert feature_training.signals(up).split(PARTS, -1)[3].max() < 1e-4


def test_training_learns_and_is_the_same_again(data, some, trained):
    features, curve = trained
    assert curve[-1]["loss"] < 0.8 * curve[0]["loss"] and curve[-1]["place"] < 0.3
    assert curve[-1]["joints"] < curve[0]["joints"]
    again, _ = feature_training.train_encoder(data, TINY, some)
    assert torch.equal(again(some), features(some))
    other, _ = feature_training.train_encoder(data, replace(TINY, seed=4))
    assert not torch.allclose(other(some), features(some))


def test_features_are_of_unit_size_on_training_motion_and_see_a_spoilt_one(data, trained, generator):
    features, _ = trained
    x, y = (replace(data.draw(256, generator), skeleton=STANDARD) for _ in range(2))
    z = features(x)
    assert z.shape == (256, 6) and z.dtype == torch.float64
    assert z.std(0).sub(1).abs().max() < 0.4 and z.mean(0).abs().max() < 0.4
    shaken = replace(y, root=y.root + 0.05 * torch.randn(y.root.shape, generator=generator))
    floor, spoilt = frechet(features(y), z), frechet(features(shaken), z)
    assert spoilt > 3 * floor
    assert frechet(features(replace(mirror(y), contacts=None)), z) < 3 * floor


def test_what_is_missed_is_all_of_it_for_a_network_that_says_the_mean(some):
    features = feature_training.MotionEncoder(TINY)
    with torch.no_grad():
        features.network["decoder"][-1].weight.zero_()
        features.network["decoder"][-1].bias.copy_(feature_training.signals(some).mean((0, 1)))
    assert set(feature_training.share_missed(features, some)) == set(feature_training.FEATURE_GROUPS)
    assert all(abs(share - 1) < 1e-3 for share in feature_training.share_missed(features, some).values())


def test_kept_features_are_the_same_bit_for_bit(trained, some, tmp_path):
    features, _ = trained
    feature_training.save_encoder(tmp_path / "f", features, {"what": "a test"})
    found = feature_training.motion_encoder(tmp_path / "f")
    assert torch.equal(found(some), features(some))
    assert found.recipe == TINY


def test_it_trains_on_the_people_who_train(motions, tmp_path, monkeypatch):
    """And watches what is missed of validation people."""
    asked, train_encoder = [], feature_training.train_encoder

    def trained(windows, recipe, held, **how):
        asked.append((windows.digest, held))
        return train_encoder(windows, recipe, held, **how)

    taken = {"train": [Mock(motion=motions[0])], "val": [Mock(motion=motions[1])]}
    monkeypatch.setattr(recipes, "sources", lambda folder: (Mock(part=taken.get), []))
    monkeypatch.setattr(feature_training, "train_encoder", trained)
    feature_training.make_encoder("x", tmp_path / "f", replace(TINY, frames=60, steps=3, seed=2))
    about = json.loads((tmp_path / "f.json").read_text())
    (digest, held), (mine, other) = asked[0], (gather([on_standard(m)], 60) for m in motions)
    assert digest == mine.digest and torch.equal(held.root, other.evenly(256).root)
    assert about["command"].endswith("FOLDER --steps 3 --seed 2")
    assert about["curve"][-1]["step"] == 3 and about["recipe"]["seed"] == 2
