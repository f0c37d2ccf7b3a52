from dataclasses import replace

import pytest

from data_synth import clips
from motionlab.humor import compiled, stages
from studies.shared import profiling, savings
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


def test_last_rung_is_what_every_fit_uses_and_the_first_is_the_faithful_mode(work, monkeypatch):
    monkeypatch.setattr(compiled, "FEW", 0)  # in tensors
    for on, form in ((LEAN, {}), (FAITHFUL, savings.OFFICIAL)):
        unknown = work.unknowns(WHOLE, on)
        with savings.weights_of(work.problem.priors, on):
            theirs = stages.motion_terms(replace(work.problem, **form), unknown)
        ours = savings.terms(work.problem, unknown, on)
        assert apart(ours, theirs) < 1e-6
        assert abs(nodes(work, ours) - nodes(work, theirs)) <= 0.01 * nodes(work, theirs)
