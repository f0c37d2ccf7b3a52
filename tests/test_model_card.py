"""The table of models says what the recipes say."""

import torch

from motionlab import checkpoint
from motionlab.humor.priors import Cvae, official_weights
from motionlab.training import model_card


def test_the_table_says_what_the_recipes_say(tmp_path, monkeypatch):
    """Of a folder of weights with one small prior in it."""
    monkeypatch.setattr(checkpoint, "SHIPPED", tmp_path)
    torch.manual_seed(0)
    found = {"standard body: kl, nats": {"mean": 3.14159, "low": 3.0, "high": 3.25, "people": 17}, "not shown": {}}
    recipe = {"made by": "a test", "people": 2, "minutes of motion, before mirroring": {"recordings": 90.0}}
    recipe |= {model_card.REPORT: found}
    checkpoint.save(tmp_path / "humor_tiny", official_weights(Cvae(64, skip=True).frozen()), recipe)
    model_card.run(None)
    text = (tmp_path / "README.md").read_text()
    assert "| humor_tiny | " in text and "1.5" in text and "EIA-0196217" in text
    assert "| standard body: kl, nats | 3.14 [3, 3.25] |" in text and "not shown" not in text
