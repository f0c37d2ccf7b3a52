"""Notebook 08's rules: what counts as near, sooner and lower; and its own form of single shooting."""

import pytest
import torch

from data_synth import scenes
from motionlab.humor import pretrained, stages
from motionlab.humor.energies import JOINTS
from motionlab.humor.unknowns import Unknowns
from studies.nb08_fast import costs, trials
from studies.nb08_fast.trials import Run, Single
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


def made(energies, seconds, spent=10.0):
    energies = torch.tensor(energies).double()
    return Run(energies, torch.tensor(seconds).double(), Unknowns(*3 * [energies[-1]]), energies[-1], spent)


def test_within_takes_the_first_time_and_inf_where_never():
    run = made([[10.0, 10.0], [1.04, 3.0], [1.0, 2.0]], [1.0, 2.0, 3.0])
    best = torch.tensor([1.0, 1.0]).double()
    assert run.within(best, 0.05).tolist() == [2.0, float("inf")]
    assert run.within(best, 0.01).tolist() == [3.0, float("inf")]


def test_gain_counts_what_never_arrives_against_shooting():
    best = torch.tensor([1.0, 1.0, 1.0]).double()
    slow = made([[1.0, 9.0, 1.0]], [8.0], spent=20.0)
    fast = made([[1.0, 1.0, 9.0]], [2.0], spent=4.0)
    assert costs.gain(slow, fast, best, 0.05).tolist() == [4.0, 10.0, 0.0]
    assert costs.gain(fast, slow, best, 0.05).tolist() == [0.25, 0.0, 0.5]
