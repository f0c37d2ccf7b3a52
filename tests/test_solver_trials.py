"""Notebook 08's solvers are those of the library."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab.humor import pretrained, stages, testops
from motionlab.humor import start as starts
from motionlab.humor.energies import JOINTS
from motionlab.scene_fit import FULL_WORK
from studies.nb08_fast import trials
from studies.nb08_fast.trials import Single
from studies.shared import joints


@pytest.fixture(scope="module")
def truth():
    return scenes.held_out(1, seed=5, frames=18)


@pytest.fixture(scope="module")
def seen(truth):
    return joints.noisy(truth, torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def task(truth, seen):
    return trials.prepare("noisy", seen, pretrained.load_priors(), JOINTS, truth)


def test_single_shooting_is_stage_3_of_the_library(task):
    run = trials.single_shooting(task, Single(iterations=(4, 4, 4), eager=starts.CALM))
    found, _ = stages.stage_3(
        task.problem, task.unknown, task.factors, steps=3, short=15, refine=(1, 2), inner=4, tolerance=1e-5
    )
    assert task.energy(found).item() == pytest.approx(run.end, rel=1e-4, abs=1e-4)
    assert task.energy(run.kept[-1][1]).item() == pytest.approx(run.end, rel=1e-4, abs=1e-4)


def test_our_search_is_that_of_the_product(truth, seen):
    work = replace(FULL_WORK, steps=(1, 1, 3), inner=3, shooting=replace(FULL_WORK.shooting, rounds=2, closures=8))
    begun = trials.prepare("noisy", seen, pretrained.load_priors(), JOINTS, truth, schedule=work)
    fitted = testops.fit(seen, begun.problem.priors, schedule=work, solver="shooting")
    run = trials.shooting(begun, work)
    assert run.end == pytest.approx(sum(fitted.energies[3].values()).item(), rel=1e-4, abs=1e-4)
    assert begun.energy(run.at(run.spent)).item() == pytest.approx(run.end, rel=1e-4, abs=1e-4)
    assert run.until(run.end) <= run.spent and run.until(run.end - 1) == float("inf")
