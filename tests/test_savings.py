"""The closures of notebook 06 and the search of notebook 08 are those of the library."""

from dataclasses import replace

import pytest
import torch

from data_synth import clips, scenes
from motionlab.footage.scene_fit import FULL_WORK
from motionlab.humor import pretrained, stages, testops
from motionlab.humor.energies import JOINTS
from studies.nb08_fast import trials
from studies.shared import joints, profiling, savings
from studies.shared.savings import FAITHFUL, LEAN
from studies.shared.workload import Part, random_priors, workload
from tests.draws import seeded

FRAMES = 6
WHOLE = Part(3, FRAMES)


@pytest.fixture(scope="module")
def work():
    priors = random_priors(seeded(), width=32)
    walk = clips.draw(1, seeded(), actions=("walk",))[0].motion
    return workload(walk.cut(0, FRAMES), priors, seeded(), batch=2)


def apart(found, other):
    assert found.keys() == other.keys()
    return max(((found[n] / other[n]) - 1).abs().max().item() for n in other)


def nodes(work, found):
    return profiling.graph_nodes(sum(found.values()))


def test_last_rung_is_what_every_fit_uses_and_the_first_is_the_faithful_mode(work):
    for on, form in ((LEAN, {}), (FAITHFUL, savings.OFFICIAL)):
        unknown = work.unknowns(WHOLE, on)
        with savings.weights_of(work.problem.priors, on):
            theirs = stages.motion_terms(replace(work.problem, **form), unknown)
        ours = savings.terms(work.problem, unknown, on)
        assert apart(ours, theirs) < 1e-6
        assert abs(nodes(work, ours) - nodes(work, theirs)) <= 0.01 * nodes(work, theirs)


def test_our_search_is_that_of_the_product():
    truth = scenes.held_out(1, seed=5, frames=18)
    seen = joints.noisy(truth, torch.Generator().manual_seed(0))
    work = replace(FULL_WORK, steps=(1, 1, 3), inner=3, shooting=replace(FULL_WORK.shooting, rounds=2, closures=8))
    begun = trials.prepare("noisy", seen, pretrained.load_priors(), JOINTS, truth, schedule=work)
    fitted = testops.fit(seen, begun.problem.priors, schedule=work, solver="shooting")
    run = trials.shooting(begun, work)
    assert run.end == pytest.approx(sum(fitted.energies[3].values()).item(), rel=1e-4, abs=1e-4)
    assert begun.energy(run.at(run.spent)).item() == pytest.approx(run.end, rel=1e-4, abs=1e-4)
