"""Contenders of notebook 08: the same energy, honest clocks, and rules that favour nobody."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab import findings
from motionlab.humor import priors, shooting, solver_costs, stages, three_d
from motionlab.humor import solver_trials as trials
from motionlab.humor.solver_trials import Run, Single
from motionlab.humor.weights import JOINTS
from motionlab.humor.windowed import Windows, windowed
from motionlab.viz import solver as draw

FRAMES, CLIPS = 18, 2
PLAN = shooting.Plan(rounds=1, closures=4)
SHORT = Single(iterations=(4, 4, 4))


@pytest.fixture(scope="module")
def task():
    truth = scenes.held_out(CLIPS, seed=5, frames=FRAMES)
    seen = three_d.noisy(truth, torch.Generator().manual_seed(0))
    return trials.prepare("noisy", seen, priors.load("compact"), JOINTS, truth)


@pytest.fixture(scope="module")
def runs(task):
    return {"single": trials.single_shooting(task, SHORT), "shot": trials.shot(task, PLAN)}


def made(energies, seconds, spent=10.0):
    energies = torch.tensor(energies).double()
    return Run(energies, torch.tensor(seconds).double(), {}, energies[-1], spent)


@pytest.mark.parametrize("name", ["single", "shot"])
def test_energy_on_the_way_is_that_of_an_exact_roll_out(runs, name):
    run = runs[name]
    assert torch.allclose(run.energies[-1], run.end, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["single", "shot"])
def test_energies_fall_and_time_goes_on(task, runs, name):
    run = runs[name]
    assert (run.energies.diff(dim=0) <= 0).all()
    assert (run.seconds.diff() > 0).all()
    assert (0 < run.linearised < run.spent) if name == "shot" else run.linearised == 0
    assert 0 < run.seconds[0] < run.seconds[-1] <= run.spent
    assert (run.end < task.energy(task.unknown)).all()


def test_single_shooting_is_stage_3_of_the_library(task, runs):
    found, _ = stages.stage_3(
        task.problem, task.unknown, task.factors, steps=3, short=15, refine=(1, 2), inner=4, tolerance=1e-5
    )
    assert torch.allclose(task.energy(found), runs["single"].end, rtol=1e-4, atol=1e-4)


def test_single_shooting_stops_when_its_time_is_up(task, runs):
    run = trials.single_shooting(task, replace(SHORT, iterations=(4, 4, 400)), seconds=0.01)
    assert len(run.seconds) <= 3  # one closure for each part that sees all frames, and the line search's first
    assert run.end.isfinite().all()
    assert (run.end >= runs["single"].end).all()


def test_a_clip_alone_is_that_clip_in_a_batch(task, runs):
    alone = trials.shot(task.rows([1]), PLAN)
    assert torch.allclose(alone.end, runs["shot"].end[1:], rtol=1e-2, atol=1e-2)
    assert torch.equal(task.rows([1]).truth.root, task.truth.root[1:])


def test_windows_end_in_an_exact_roll_out(task):
    run = windowed(task, Windows(10, 3, SHORT))
    assert run.energies.shape == (1, CLIPS)
    assert run.end.isfinite().all()
    assert run.unknown["z"].shape == task.unknown["z"].shape
    assert torch.allclose(run.end, task.energy(run.unknown))
    polished = windowed(task, Windows(10, 3, SHORT, Single(iterations=(0, 0, 4))))
    assert torch.allclose(polished.energies[0], run.end, rtol=1e-3, atol=1e-3)  # begins where the windows ended
    assert (polished.end < run.end).all()
    assert torch.allclose(polished.end, polished.energies[-1], rtol=1e-4, atol=1e-4)
    assert (polished.seconds.diff() > 0).all() and polished.seconds[-1] <= polished.spent
    hasty = windowed(task, Windows(10, 3, SHORT, Single(iterations=(0, 0, 4))), seconds=0.0)
    assert hasty.energies.shape == (1, CLIPS)  # no time for the polish
    assert (hasty.end >= run.end).all()


def test_windows_share_the_iterations_of_single_shooting():
    for polish in (0.0, 0.5):
        how = Windows.sharing(720, polish, window=30)
        after = sum(how.polish.iterations) if how.polish else 0
        assert (sum(how.inside.iterations) + after, after, how.window) == (720, round(720 * polish), 30)
    assert Single.budget(720) == Single()
    assert sum(Single.budget(7).iterations) == 7


def test_patience_is_stopped_by_time_alone(task, runs):
    waited = trials.single_shooting(task, SHORT.patient, seconds=3 * runs["single"].spent)
    assert len(waited.seconds) > len(runs["single"].seconds)
    assert (waited.end <= runs["single"].end).all()
    assert waited.spent < 6 * runs["single"].spent


def test_error_is_a_distance_in_centimetres(task):
    moved = task.truth.clip(slice(None))
    object.__setattr__(moved, "root", moved.root + torch.tensor([0.03, 0.0, 0.04]))
    assert torch.allclose(task.error(moved), torch.tensor([5.0, 5.0]), atol=1e-3)


def test_within_takes_the_first_time_and_inf_where_never():
    run = made([[10.0, 10.0], [1.04, 3.0], [1.0, 2.0]], [1.0, 2.0, 3.0])
    best = torch.tensor([1.0, 1.0]).double()
    assert run.within(best, 0.05).tolist() == [2.0, float("inf")]
    assert run.within(best, 0.01).tolist() == [3.0, float("inf")]


def test_within_of_a_negative_best_energy_is_above_it():
    run = made([[-0.9], [-0.96], [-1.0]], [1.0, 2.0, 3.0])
    assert run.within(torch.tensor([-1.0]).double(), 0.05).tolist() == [2.0]


def test_within_a_share_of_another_size():
    run = made([[10.0], [1.5], [1.04]], [1.0, 2.0, 3.0])
    best = torch.tensor([1.0]).double()
    assert run.within(best, 0.05, torch.tensor([10.0]).double()).tolist() == [2.0]
    assert run.within(best, 0.05).tolist() == [3.0]  # control


def test_at_is_what_was_known_then():
    run = made([[3.0], [2.0]], [1.0, 2.0])
    assert run.at(0.5).isinf().all()
    assert run.at(1.5).tolist() == [3.0]
    assert run.at(99.0).tolist() == [2.0]


def test_gain_counts_what_never_arrives_against_shooting():
    best = torch.tensor([1.0, 1.0, 1.0]).double()
    slow = made([[1.0, 9.0, 1.0]], [8.0], spent=20.0)
    fast = made([[1.0, 1.0, 9.0]], [2.0], spent=4.0)
    assert solver_costs.gain(slow, fast, best, 0.05).tolist() == [4.0, 10.0, 0.0]
    assert solver_costs.gain(fast, slow, best, 0.05).tolist() == [0.25, 0.0, 0.5]


def test_fallen_is_in_parts_of_the_fall():
    start, best = torch.tensor([11.0]).double(), torch.tensor([1.0]).double()
    assert solver_costs.fallen(made([[2.0]], [1.0]), made([[3.0]], [1.0]), start, best).tolist() == [-0.1]


def test_lowest_knows_ends_and_ways():
    a, b = made([[3.0, 5.0]], [1.0]), made([[4.0, 2.0]], [1.0])
    assert solver_costs.lowest([a, b]).tolist() == [3.0, 2.0]
    broken = Run(a.energies, a.seconds, {}, torch.tensor([float("nan"), -9.0]).double(), 1.0)
    assert solver_costs.lowest([broken, b]).tolist() == [3.0, -9.0]


def test_pooled_keeps_every_clip_s_end_and_its_own_times():
    a, b = made([[3.0], [1.0]], [1.0, 2.0], 2.0), made([[5.0]], [3.0], 3.0)
    both = solver_costs.pooled([a, b])
    assert both.energies.tolist() == [[3.0, 5.0], [1.0, 5.0]]
    assert both.end.tolist() == [1.0, 5.0]
    assert both.spent.tolist() == [2.0, 3.0]
    best = torch.tensor([1.0, 5.0]).double()
    assert both.within(best, 0.05).tolist() == [2.0, 3.0]
    assert both.at(2.5).tolist() == [1.0, float("inf")]
    late = solver_costs.pooled([made([[9.0]], [4.0], 8.0), made([[9.0]], [4.0], 30.0)])
    assert solver_costs.gain(late, both, best, 0.05).tolist() == [4.0, 10.0]  # each with its own whole time


def test_middle_is_that_of_the_findings():
    x = torch.tensor([4.0, 1.0, 3.0, 8.0])
    assert solver_costs.middle(x) == findings.interval(x, "median", torch.Generator())[0] == 3.5
    assert x.median() == 3.0  # control: torch takes the lower one
    half = torch.tensor([1.0, 2.0, float("inf"), float("inf")])
    assert solver_costs.middle(half).isinf() and solver_costs.middle(half[:3]) == 2.0
    assert solver_costs.middle(half[2:]).isinf()
    assert solver_costs.seconds_text(half, 9.0) == "> 9 (2 of 4 never)"
    assert solver_costs.seconds_text(half[:3], 9.0) == "2.0 (1 of 3 never)"


def test_curve_goes_through_what_was_known():
    run = solver_costs.pooled([made([[3.0], [1.0]], [1.0, 4.0]), made([[6.0]], [2.0])])
    times, gaps = solver_costs.curve(run, torch.tensor([1.0, -2.0]).double(), points=3)
    assert times.tolist() == pytest.approx([1.0, 2.0, 4.0])
    assert gaps.tolist() == [[2.0, float("inf")], [2.0, 4.0], [0.0, 4.0]]
    ends = solver_costs.curve(made([[3.0], [1.0]], [0.7, 4.1]), torch.tensor([1.0]), points=2)[1]
    assert ends.tolist() == [[2.0], [0.0]]  # rounded times would miss the first, or the last
    assert len(solver_costs.curve(made([[6.0]], [2.0]), torch.tensor([1.0]))[0]) == 1


def test_table_measures_nearness_in_two_ways():
    runs = {"a": made([[3.0], [1.5]], [1.0, 2.0], 2.0)}
    best, start = torch.tensor([1.0]).double(), torch.tensor([101.0]).double()
    (row,) = solver_costs.times_table(runs, best, start, {"a": torch.tensor([4.0])})
    assert row["s to within 5 %"] == "> 2 (1 of 1 never)"
    assert row["1 % of the fall"] == "2.0"
    assert (row["ends above the best, %"], row["% of the fall"]) == (50.0, 0.5)


def test_cost_of_a_fit_is_by_clip_and_by_second(task, runs):
    row = solver_costs.fit_row(task, runs["shot"])
    assert row["s per clip"] == pytest.approx(row["s"] / CLIPS)
    assert row["s per second of motion"] == pytest.approx(row["s"] / (CLIPS * FRAMES / task.truth.fps))
    assert row["end"] * FRAMES == pytest.approx(runs["shot"].end.mean().item(), rel=1e-4)
    assert row["end"] < row["energy per frame: start"]


def test_log_takes_only_the_rows_it_is_given():
    log = trials.Log(3)
    log.note(torch.tensor([2.0, float("nan")]), torch.tensor([0, 2]))
    log.note(torch.tensor([5.0, 1.0]), torch.tensor([0, 1]))
    assert torch.stack(log.energies).tolist() == [[2.0, float("inf"), float("inf")], [2.0, 1.0, float("inf")]]


@pytest.mark.parametrize("change", [trials.without_feedback, trials.without_shape])
def test_ablations_start_where_shooting_starts(task, change):
    loop = shooting.linearised(task.problem, task.unknown)
    other = change(loop, task.unknown)
    nothing = {"nu": torch.zeros_like(task.unknown["z"][:, 0]), "first": loop.first.new_zeros(loop.first.shape[:2])}
    with torch.no_grad():
        ways = [shooting.opened(task.problem, task.unknown, each, nothing)[1].body.joints for each in (loop, other)]
    assert torch.allclose(*ways, atol=1e-4)
    assert any(not torch.equal(a, b) for a, b in zip(loop, other, strict=True))


def test_a_change_reaches_the_solver(task, runs):
    same = trials.shot(task, PLAN, change=lambda loop, unknown: loop)
    assert torch.equal(same.end, runs["shot"].end)
    lame = trials.shot(task, PLAN, change=trials.without_feedback)
    assert (lame.end > runs["shot"].end).any()  # control


def test_parts_of_a_fit_lie_within_it(task):
    spent = solver_costs.parts_of_a_fit(task.rows([0]), PLAN)
    assert spent["everything"] >= spent["the whole linearisation"] + spent["closures"]
    assert spent["the whole linearisation"] >= spent["Riccati sweep"] > 0
    beside = solver_costs.apart(spent)
    assert sum(beside.values()) == pytest.approx(spent["everything"])
    assert min(beside.values()) >= 0


def test_figures_draw_what_never_arrives(runs):
    best = solver_costs.lowest(list(runs.values()))
    gaps = {n: solver_costs.curve(r, best) for n, r in runs.items()}
    dot = Run(best[None], torch.tensor([3.0]).double(), {}, best, 3.0)
    (axes,) = draw.energy_over_time({"noisy": gaps | {"windows": solver_costs.curve(dot, best - 1)}}).axes
    assert [text.get_text() for text in axes.get_legend().texts] == ["single", "shot", "windows"]
    found = torch.tensor([[0.4, -0.1], [0.2, 0.0]])
    (axes,) = draw.promises({"noisy": (found + 0.1, found)}).axes
    less = found.index_fill(0, torch.tensor([1]), -torch.inf)
    assert len(draw.promises({"noisy": (found, less)}).axes[0].collections[0].get_offsets()) == 2
    assert axes.collections[0].get_offsets().shape == (4, 2) and axes.get_ylim()[0] < -0.1 < 0.5 < axes.get_xlim()[1]


def test_errors_are_compared_clip_by_clip():
    theirs = torch.tensor([1.0, 2.0, 30.0, 4.0, 5.0])
    row = solver_costs.paired(theirs - 0.5, theirs, torch.Generator().manual_seed(0))
    assert row == {"clips": 5, "smaller on": 5, "median": "-0.50 [-0.50, -0.50]", "mean": "-0.50 [-0.50, -0.50]"}
    other = solver_costs.paired(theirs + torch.tensor([1.0, -1, 0, 0, 10]), theirs, torch.Generator().manual_seed(0))
    assert other["smaller on"] == 1 and other["median"].startswith("0.00 [-1.00") and other["mean"].startswith("2.00")
