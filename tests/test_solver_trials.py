"""Notebook 08's own form of single shooting is that of the library."""

import pytest
import torch

from data_synth import scenes
from motionlab.humor import pretrained, stages
from motionlab.humor.energies import JOINTS
from studies.nb08_fast import trials
from studies.nb08_fast.trials import Single
from studies.shared import joints


@pytest.fixture(scope="module")
def task():
    truth = scenes.held_out(2, seed=5, frames=18)
    seen = joints.noisy(truth, torch.Generator().manual_seed(0))
    return trials.prepare("noisy", seen, pretrained.load_priors("compact"), JOINTS, truth)


def test_single_shooting_is_stage_3_of_the_library(task):
    run = trials.single_shooting(task, Single(iterations=(4, 4, 4)))
    found, _ = stages.stage_3(
        task.problem, task.unknown, task.factors, steps=3, short=15, refine=(1, 2), inner=4, tolerance=1e-5
    )
    assert torch.allclose(task.energy(found), run.end, rtol=1e-4, atol=1e-4)
