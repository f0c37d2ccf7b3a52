"""Stage 3 by multiple shooting: derivatives at free states, the step, and exact roll-outs at the end."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab.errors import NotConverged, ShapeError
from motionlab.humor import free_states, multiple, multiple_trials, priors, shooting, solver_trials, three_d, variables
from motionlab.humor.free_states import Penalty, Point, derived, freedom, measured, merit, retracted
from motionlab.humor.multiple import Plan, Report, modelled, start, steered, swept
from motionlab.humor.slopes import between, own
from motionlab.humor.weights import JOINTS
from tests.rolled_inputs import F64
from tests.test_humor_shooting import CLIPS, FRAMES, made, noisy, one, seed, total

KINDS = ("joints", "free")
PLAN = Plan(stiffness=(0.3, 30.0))


@pytest.fixture(scope="module")
def cases(kit):
    """By name: a problem without kinks in the first state's slopes, unknowns, and states beside their roll-out."""
    pose, found = deepcopy(kit.pose), {}
    pose.slopes = (1.0, 1.0, 1.0)
    for kind, (problem, unknown) in made(pose).items():
        with torch.no_grad():
            states = variables.roll(unknown, problem.priors, problem.evidence).states
        found[kind] = problem, unknown, states
    return found


def beside(states, scale=0.02):
    """States of which none follows from another, in float64."""
    change = noisy(torch.zeros(*states.shape[:2], 210, dtype=F64), scale, 11)
    return retracted(states, change)


def placed(cases, kind, rho=2.0, scale=0.02):
    """A problem, a point with gaps, and a penalty with multipliers."""
    problem, unknown, states = cases[kind]
    point = Point(unknown, beside(states[:, 1:], scale) if scale else states[:, 1:])
    penalty = Penalty.of(problem, point)._replace(rho=rho)
    return (
        problem,
        point,
        penalty._replace(multipliers=noisy(penalty.multipliers, 1.0, 12) if scale else 0 * point.states[..., :210]),
    )


# --------------------------------------------------------------------------------------------------- states and gaps
def test_a_change_that_is_made_is_the_change_between(cases):
    """To second order, where it stays in the state's own frame; with the root's turn about z left out it does not."""
    _, _, states = cases["joints"]
    free = freedom(own(states)[0], 210)
    change = (free @ noisy(torch.zeros(*states.shape[:2], 207, 1, dtype=F64), 1.0, 13))[..., 0]

    def missed(change):
        return [(between(retracted(states, s * change), states) / s - change).abs().max() for s in (1e-3, 1e-5)]

    coarse, fine = missed(change)
    assert fine < 1e-3 and fine < 0.05 * coarse
    wrong = change.clone()
    wrong[..., free_states._YAW] = 0.0
    assert missed(wrong)[1] > 20 * fine
    assert not between(states, states).abs().max() > 1e-12
    assert free.shape[-1] == 207 and torch.linalg.matrix_rank(free).eq(207).all()


def test_states_that_follow_have_no_gaps_and_the_roll_outs_energy(cases):
    for problem, unknown, states in cases.values():
        with torch.no_grad():
            found = measured(problem, Point(unknown, states[:, 1:]))
        assert found.gaps.abs().max() < 1e-10
        torch.testing.assert_close(found.energy, total(problem, unknown), atol=0, rtol=1e-9)


def test_what_gaps_cost_and_how_multipliers_take_it_over():
    """rho / 2 |c|^2_W + lambda . c, whose slope is the next lambda."""
    draw = torch.randn(4, 2, 3, 210, generator=seed(17), dtype=F64)
    gaps, penalty = draw[0].requires_grad_(), Penalty(draw[1, 0, 0].square(), 3.0, draw[2])
    by_hand = [sum(1.5 * w * c * c + m * c for w, c, m in zip(penalty.white.repeat(3), c, m, strict=True))
               for c, m in zip(gaps.flatten(1), draw[2].flatten(1), strict=True)]  # fmt: skip
    torch.testing.assert_close(penalty.cost(gaps), torch.stack(by_hand))
    (slope,) = torch.autograd.grad(penalty.cost(gaps).sum(), gaps)
    torch.testing.assert_close(penalty.raised(gaps).multipliers, slope)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_at_free_states_are_finite_differences(cases, kind):
    problem, point, penalty = placed(cases, kind)
    slopes, found, value = derived(problem, point, penalty)
    assert found.gaps.abs().max() > 1e-3
    with torch.no_grad():
        torch.testing.assert_close(value, merit(problem, point, penalty))
        for name, slope in slopes._asdict().items():
            way = torch.randn(slope.shape, generator=seed(14), dtype=F64)
            ways = [way if n == name else torch.zeros_like(x) for n, x in slopes._asdict().items()]
            up, down = (merit(problem, point.moved(*(s * x for x in ways)), penalty) for s in (1e-6, -1e-6))
            torch.testing.assert_close((slope * way).flatten(1).sum(1), (up - down) / 2e-6, rtol=1e-4, atol=1e-3)


def test_gaps_change_as_the_model_has_it(cases):
    """c' = c + y' - A y - B dz, where there are none yet."""
    problem, point, _ = placed(cases, "joints", scale=0.0)
    with torch.no_grad():
        model = modelled(problem, point, measured(problem, point), 1)
        w = noisy(torch.zeros(CLIPS, FRAMES - 1, 207, 1, dtype=F64), 1.0, 15)
        y, dz = (model.free @ w)[..., 0], noisy(torch.zeros(CLIPS, FRAMES - 1, 48, dtype=F64), 1.0, 16)
        nothing = y.new_zeros(CLIPS, 118)
        up, down = (measured(problem, point.moved(nothing, s * y[..., :210], s * dz)).gaps for s in (1e-6, -1e-6))
        before = torch.cat((torch.zeros_like(y[:, :1]), y[:, :-1]), 1)
        claimed = y - (model.a @ before[..., None])[..., 0] - (model.b @ dz[..., None])[..., 0]
    torch.testing.assert_close((up - down) / 2e-6, claimed[..., :210], atol=1e-4, rtol=1e-4)


# ------------------------------------------------------------------------------------------------------------ the step
@pytest.mark.parametrize("kind", KINDS)
def test_a_short_step_is_the_one_that_the_sweep_walks(cases, kind):
    """By the feedback roll-out, gaps and all; and along it the merit falls as its gradient has it."""
    problem, point, penalty = placed(cases, kind, scale=1e-4)
    penalty = penalty._replace(multipliers=0 * penalty.multipliers)
    slope, found, before = derived(problem, point, penalty)
    model, short = modelled(problem, point, found, 1), 1e-5
    way = swept(problem, point, model, slope, penalty, before.new_full((CLIPS,), 1e-2))
    first = multiple.loop.first_slopes(problem, point.unknown, way.change.shape[1])
    y, controls = way.swept.walked(
        model.a, torch.cat((model.b, model.free), -1), (first @ way.change[..., None])[..., 0]
    )
    (new,) = steered(problem, point, model, way, found.gaps, (short,))
    ours = between(new.states, point.states) / short
    assert (ours - y[:, 1:, :210]).norm() < 2e-2 * y.norm()
    dz = (new.unknown["z"] - point.unknown["z"])[:, 0] / short
    assert (dz - controls[..., :48]).norm() < 2e-2 * controls[..., :48].norm()
    falls = sum(
        (a * b).flatten(1).sum(1) for a, b in zip(slope, (way.change, y[:, 1:, :210], controls[..., :48]), strict=True)
    )
    with torch.no_grad():
        gone = (merit(problem, new, penalty) - before) / short
        torch.testing.assert_close(gone, falls, rtol=0.05, atol=1e-3)
        assert (falls < 0).all()
        back = way._replace(change=-way.change, swept=way.swept._replace(offsets=-way.swept.offsets))
        (wrong,) = steered(problem, point, model, back, found.gaps, (short,))
        assert (merit(problem, wrong, penalty) > before).all()  # control: the other way it rises


@pytest.mark.parametrize("kind", KINDS)
def test_without_gaps_stiff_dynamics_step_as_the_loop_does(cases, kind, monkeypatch):
    """Where the energy's matrix is the identity, Newton's step is minus its gradient."""
    monkeypatch.setattr(multiple, "_INFORMATION", 0.0)
    problem, point, penalty = placed(cases, kind, rho=1e7, scale=0.0)
    unknown, short = point.unknown, 1e-4
    slope, found, before = derived(problem, point, penalty)
    model = modelled(problem, point, found, 1)
    way = swept(problem, point, model, slope, penalty, torch.zeros_like(before))
    (ours,) = steered(problem, point, model, way, None, (short,))
    loop = shooting.linearised(problem, unknown, stride=1)
    new = {"nu": torch.zeros_like(loop.base), "first": torch.zeros_like(loop.first[..., 0])}
    leaves = {n: x.requires_grad_() for n, x in new.items()}
    energy = sum(shooting.rolled_terms(problem, *shooting.opened(problem, unknown, loop, leaves)).values())
    pulls = torch.autograd.grad(energy.sum(), leaves.values())
    with torch.no_grad():
        at, rolled = shooting.opened(problem, unknown, loop, {n: -short * g for n, g in zip(new, pulls, strict=True)})
        theirs = {**at, "z": rolled.rollout.z[:, None]}
        for name in ("z", "trans", "betas"):
            way_ours, way_theirs = ours.unknown[name] - unknown[name], theirs[name] - unknown[name]
            assert (way_ours - way_theirs).norm() < 2e-2 * way_theirs.norm(), name
        soft = swept(problem, point, model, slope, penalty._replace(rho=1e-2), torch.zeros_like(before))
        (loose,) = steered(problem, point, model, soft, found.gaps, (short,))
        assert (loose.unknown["z"] - ours.unknown["z"]).norm() > 0.1 * (ours.unknown["z"] - unknown["z"]).norm()


# ---------------------------------------------------------------------------------------------------------- the search
@pytest.fixture
def merits(monkeypatch):
    """Of every iteration the merit before and after it."""
    noted, real = [], multiple._lower

    def watched(problem, point, model, slope, found, before, penalty, *rest):
        new, damping = real(problem, point, model, slope, found, before, penalty, *rest)
        with torch.no_grad():
            noted.append((before, merit(problem, new, penalty)))
        return new, damping

    monkeypatch.setattr(multiple, "_lower", watched)
    return noted


@pytest.mark.parametrize(("kind", "multipliers"), [("joints", False), ("free", True)])
def test_it_ends_lower_in_an_exact_roll_out(cases, merits, kind, multipliers):
    problem, unknown, states = cases[kind]
    kept, report = {n: x.clone() for n, x in unknown.items()}, Report()
    found = start(problem, unknown, beside(states), replace(PLAN, multipliers=multipliers), report)
    assert found.keys() == unknown.keys() and all(found[n].shape == unknown[n].shape for n in unknown)
    torch.testing.assert_close(total(problem, found), report.end, atol=0, rtol=1e-9)
    assert (report.end < 0.9 * total(problem, unknown)).all()
    assert all(torch.equal(unknown[n], kept[n]) for n in kept)
    assert len(report.energies) == len(report.gaps) == len(report.seconds) == len(PLAN.stiffness) + 1
    assert (report.gaps[-1] < 0.3 * report.gaps[0]).all() and all(e.shape == (CLIPS,) for e in report.energies)
    assert len(merits) == len(PLAN.stiffness) and all((after < before).all() for before, after in merits)


def test_clips_do_not_see_each_other_not_even_one_that_is_not_finite(cases):
    """Which stays where it is."""
    problem, unknown, states = cases["joints"]
    rough, quick = beside(states), Plan(stiffness=(1.0,))
    alone = start(*one(problem, unknown, [0]), rough[:1], quick)
    together = start(problem, unknown, rough, quick)
    assert not torch.equal(together["z"][1], unknown["z"][1])
    rough[1, 2] = torch.nan
    found = start(problem, unknown, rough, quick)
    for name in unknown:
        torch.testing.assert_close(alone[name][0], together[name][0], atol=1e-6, rtol=1e-6)
        torch.testing.assert_close(found[name][0], together[name][0], atol=1e-6, rtol=1e-6)
        assert torch.equal(found[name][1], unknown[name][1])
    with pytest.raises(NotConverged, match="finite"):
        start(problem, unknown, torch.full_like(rough, torch.nan), quick)


def test_what_it_cannot_take_is_named(cases):
    problem, unknown, states = cases["joints"]
    with pytest.raises(ShapeError, match="states"):
        start(problem, unknown, states[..., :-1])
    with pytest.raises(ShapeError, match="frames"):
        start(problem, unknown, states[:, :-1])
    with pytest.raises(ShapeError, match="frames"):
        start(problem, {**unknown, "z": unknown["z"][:, :, :0]}, states[:, :1])
    with pytest.raises(ShapeError, match="window"):
        start(problem, {**unknown, "z": unknown["z"].expand(-1, 2, -1, -1)}, states)
    for wrong in ({"stiffness": ()}, {"stiffness": (0.0,)}, {"attempts": 0}, {"stride": 0}):
        with pytest.raises(ValueError, match="above nought"):
            Plan(**wrong)


def test_among_the_solvers_its_energies_are_those_of_exact_roll_outs():
    truth = scenes.held_out(1, seed=5, frames=8)
    seen = three_d.noisy(truth, seed(0))
    task = solver_trials.prepare("noisy", seen, priors.load("compact"), JOINTS, truth)
    run = multiple_trials.shot(task, Plan(stiffness=(1.0,)), shooting.Plan(rounds=1, closures=3))
    assert torch.allclose(run.energies[-1], run.end, rtol=1e-4, atol=1e-4) and (run.energies.diff(dim=0) <= 0).all()
    assert len(run.energies) == len(run.seconds) and (run.seconds.diff() > 0).all()
    assert 0 < run.linearised < run.seconds[-1] <= run.spent
    assert (run.end < task.energy(task.unknown)).all()
