"""Widths that a transition prior cannot have; and the command that trains what is small."""

from unittest.mock import Mock

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import checkpoint, splits
from motionlab.__main__ import main
from motionlab.errors import ShapeError
from motionlab.humor import pretrained
from motionlab.humor.priors import Cvae
from motionlab.training import recipes


@pytest.mark.parametrize("width", [0, 16, 48, 100])
def test_widths_that_the_norms_cannot_have(width):
    with pytest.raises(ShapeError, match="multiple of 32"):
        Cvae(width)


# -------------------------------------------------------------------------------------------------- command
@pytest.mark.parametrize("steps", ["0", "-3", "many"])
def test_the_command_wants_steps_that_can_be_counted(steps, capsys):
    with pytest.raises(SystemExit):
        main(["train", "small", f"--steps={steps}"])
    assert "above 0" in capsys.readouterr().err


def test_the_command_trains_the_small_priors(motions, tmp_path, monkeypatch):
    """End to end with little data: both checkpoints load, and their recipes say what they are."""
    some = [m for seed in (1, 2) for m in (perform_sequence(Corpus(seconds=6.0, seed=seed), 0).motion, *motions)]
    taken = {"train": [Mock(motion=m, missing=("left_foot",)) for m in some], "val": [Mock(motion=motions[0])]}
    monkeypatch.setattr(recipes, "sources", lambda folder: (Mock(part=taken.get), []))
    assert main(["train", "small", "--steps", "3", "--seed", "2", "--out", str(tmp_path)]) == 0
    pose = pretrained.load_pose_prior(str(tmp_path / "pose_prior_real"))
    initial = pretrained.load_initial(str(tmp_path / "init_gmm_real"))
    turns = pose.decode(torch.zeros(2, 32))
    assert torch.allclose(turns @ turns.mT, torch.eye(3).expand_as(turns), atol=1e-5)
    features = recipes._first_states(motions[:1], 20)
    assert initial.log_prob(features).isfinite().all() and initial.means.shape == (12, 138)
    made = [checkpoint.read_recipe(tmp_path / f"{name}_real") for name in ("pose_prior", "init_gmm")]
    command = "python -m motionlab train small --data FOLDER"
    assert [recipe["command"] for recipe in made] == [f"{command} --steps 3 --seed 2", f"{command} --seed 2"]
    assert made[0]["data"] == made[1]["data"] == {splits.RECORDED: sum(m.frames for m in some), splits.SYNTHETIC: 0}
    assert made[0]["steps"] == 3 and made[0]["held out"]["validation people"]["degrees"] > 0
    held = made[1]["held-out log-likelihood, nats per frame"]["validation people"]
    assert held["frames"] == -(-motions[0].frames // 3)
