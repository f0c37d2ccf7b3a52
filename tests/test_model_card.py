"""The table of models: measured on the test people alone, each counted alike, and kept in the recipe."""

import json

import pytest
import torch

from data_synth import scenes
from motionlab import checkpoint, corpus
from motionlab.contact import with_contacts
from motionlab.errors import DataError
from motionlab.humor import pretrained
from motionlab.humor.priors import Cvae, official_weights
from motionlab.training import model_card


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """A folder of weights with one small causal prior in it."""
    monkeypatch.setattr(checkpoint, "SHIPPED", tmp_path)
    torch.manual_seed(0)
    model = Cvae(64, skip=True).frozen()
    recipe = {"made by": "a test", "people": 2, "minutes of motion, before mirroring": {"recordings": 90.0}}
    checkpoint.save(tmp_path / "humor_tiny", official_weights(model), recipe)
    yield tmp_path
    pretrained.load_motion_prior.cache_clear()


def takes(*people):
    motions = scenes.held_out(len(people), frames=61)
    found = []
    for i, person in enumerate(people):
        motion = motions.clip(i)
        motion = with_contacts(type(motion)(corpus.STANDARD, motion.root, motion.rot, motion.fps))
        found.append(corpus.Take(motion, "a/b", "cmu_library", person, "walk", 24.0, ()))
    return corpus.Corpus(tuple(found), ())


def test_only_people_of_the_report_count_and_each_alike(shipped, tmp_path, monkeypatch):
    monkeypatch.setattr(model_card.splits, "real_sources", lambda folder: ["cmu_library"])
    monkeypatch.setattr(model_card.corpus, "assemble", lambda *_, **__: takes("cmu_05", "cmu_01", "cmu_16", "cmu_111"))
    found = model_card.judge_prior("humor_tiny", tmp_path)
    assert found["one step, hold, cm"]["people"] == 2  # cmu_01 trains, cmu_111 chooses
    kept = json.loads((tmp_path / "humor_tiny.json").read_text())
    assert kept[model_card.REPORT] == json.loads(json.dumps(found)) and kept["made by"] == "a test"
    assert checkpoint.load(tmp_path / "humor_tiny")[0]  # the recipe still belongs to its tensors
    monkeypatch.setattr(model_card.corpus, "assemble", lambda *_, **__: takes("cmu_01"))
    with pytest.raises(DataError, match="test"):
        model_card.judge_prior("humor_tiny", tmp_path)


def test_the_table_says_what_the_recipes_say(shipped):
    text = model_card.write_readme().read_text()
    assert "| humor_tiny | " in text and "1.5" in text and "EIA-0196217" in text
