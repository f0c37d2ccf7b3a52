"""Notebook 08's search is that of the library."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab.footage.scene_fit import FULL_WORK
from motionlab.humor import pretrained, testops
from motionlab.humor.energies import JOINTS
from studies.nb08_fast import trials
from studies.shared import joints


def test_our_search_is_that_of_the_product():
    truth = scenes.held_out(1, seed=5, frames=18)
    seen = joints.noisy(truth, torch.Generator().manual_seed(0))
    work = replace(FULL_WORK, steps=(1, 1, 3), inner=3, shooting=replace(FULL_WORK.shooting, rounds=2, closures=8))
    begun = trials.prepare("noisy", seen, pretrained.load_priors(), JOINTS, truth, schedule=work)
    fitted = testops.fit(seen, begun.problem.priors, schedule=work, solver="shooting")
    run = trials.shooting(begun, work)
    assert run.end == pytest.approx(sum(fitted.energies[3].values()).item(), rel=1e-4, abs=1e-4)
    assert begun.energy(run.at(run.spent)).item() == pytest.approx(run.end, rel=1e-4, abs=1e-4)
