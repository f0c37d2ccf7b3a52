"""Notebook 08's rules: what counts as near, sooner and lower, whoever it is; and its own form of single shooting."""

import pytest
import torch

from data_synth import scenes
from motionlab import findings
from motionlab.humor import pretrained, stages
from motionlab.humor.energies import JOINTS
from motionlab.humor.shooting import coordinates
from motionlab.humor.unknowns import Unknowns
from studies.nb08_fast import costs, trials
from studies.nb08_fast.trials import Run, Single
from studies.shared import joints, statistics


@pytest.fixture(scope="module")
def task():
    truth = scenes.held_out(2, seed=5, frames=18)
    seen = joints.noisy(truth, torch.Generator().manual_seed(0))
    return trials.prepare("noisy", seen, pretrained.load_priors("compact"), JOINTS, truth)


def made(energies, seconds, spent=10.0):
    energies = torch.tensor(energies).double()
    return Run(energies, torch.tensor(seconds).double(), Unknowns(*3 * [energies[-1]]), energies[-1], spent)


def test_single_shooting_is_stage_3_of_the_library(task):
    run = trials.single_shooting(task, Single(iterations=(4, 4, 4)))
    found, _ = stages.stage_3(
        task.problem, task.unknown, task.factors, steps=3, short=15, refine=(1, 2), inner=4, tolerance=1e-5
    )
    assert torch.allclose(task.energy(found), run.end, rtol=1e-4, atol=1e-4)


def test_within_takes_the_first_time_and_inf_where_never():
    run = made([[10.0, 10.0], [1.04, 3.0], [1.0, 2.0]], [1.0, 2.0, 3.0])
    best = torch.tensor([1.0, 1.0]).double()
    assert run.within(best, 0.05).tolist() == [2.0, float("inf")]
    assert run.within(best, 0.01).tolist() == [3.0, float("inf")]


def test_within_of_a_negative_best_energy_is_above_it():
    run = made([[-0.9], [-0.96], [-1.0]], [1.0, 2.0, 3.0])
    assert run.within(torch.tensor([-1.0]).double(), 0.05).tolist() == [2.0]


def test_at_is_what_was_known_then():
    run = made([[3.0], [2.0]], [1.0, 2.0])
    assert run.at(0.5).isinf().all()
    assert run.at(1.5).tolist() == [3.0]
    assert run.at(99.0).tolist() == [2.0]


def test_gain_counts_what_never_arrives_against_shooting():
    best = torch.tensor([1.0, 1.0, 1.0]).double()
    slow = made([[1.0, 9.0, 1.0]], [8.0], spent=20.0)
    fast = made([[1.0, 1.0, 9.0]], [2.0], spent=4.0)
    assert costs.gain(slow, fast, best, 0.05).tolist() == [4.0, 10.0, 0.0]
    assert costs.gain(fast, slow, best, 0.05).tolist() == [0.25, 0.0, 0.5]


def test_fallen_is_in_parts_of_the_fall():
    start, best = torch.tensor([11.0]).double(), torch.tensor([1.0]).double()
    assert costs.fallen(made([[2.0]], [1.0]), made([[3.0]], [1.0]), start, best).tolist() == [-0.1]


def test_lowest_knows_ends_and_ways():
    a, b = made([[3.0, 5.0]], [1.0]), made([[4.0, 2.0]], [1.0])
    assert costs.lowest([a, b]).tolist() == [3.0, 2.0]
    broken = Run(a.energies, a.seconds, None, torch.tensor([float("nan"), -9.0]).double(), 1.0)
    assert costs.lowest([broken, b]).tolist() == [3.0, -9.0]


def test_middle_is_that_of_the_findings():
    x = torch.tensor([4.0, 1.0, 3.0, 8.0])
    assert statistics.middle(x) == findings.interval(x, "median", torch.Generator())[0] == 3.5
    assert x.median() == 3.0  # control: torch takes the lower one
    half = torch.tensor([1.0, 2.0, float("inf"), float("inf")])
    assert statistics.middle(half).isinf() and statistics.middle(half[:3]) == 2.0
    assert statistics.middle(half[2:]).isinf()
    assert costs.seconds_text(half, 9.0) == "> 9 (2 of 4 never)"
    assert costs.seconds_text(half[:3], 9.0) == "2.0 (1 of 3 never)"


@pytest.mark.parametrize("change", [trials.without_feedback, trials.without_shape])
def test_ablations_start_where_shooting_starts(task, change):
    loop = coordinates.linearised(task.problem, task.unknown)
    other = change(loop, task.unknown)
    nothing = {"nu": torch.zeros_like(task.unknown.z[:, 0]), "first": loop.first.new_zeros(loop.first.shape[:2])}
    with torch.no_grad():
        ways = [coordinates.opened(task.problem, task.unknown, each, nothing)[1].body.joints for each in (loop, other)]
    assert torch.allclose(*ways, atol=1e-4)
    assert any(not torch.equal(a, b) for a, b in zip(loop, other, strict=True))
