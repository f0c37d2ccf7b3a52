"""Jumps between the modes that the components of the first state's mixture make."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from motionlab.humor import feedback_solver, priors, unknowns
from motionlab.humor.coordinates import linearised, mixed_features, unwhiten
from motionlab.humor.feedback_solver import Plan, solve
from motionlab.humor.priors import InitGmm
from motionlab.optimise import BatchFit
from tests.draws import seeded
from tests.rolled_inputs import F64
from tests.test_humor_shooting import CLIPS, made, noisy, nought, of_both, total

ALONE = Plan(rounds=8, closures=20, tolerance=1e-5, mode_jumps=0, trial_rounds=0)


@pytest.fixture(scope="module")
def case(kit):
    """Joints, unknowns, and a mixture of two balls: one around the first states, and one with other velocities, three
    standard deviations of each away and a million million times as likely. Joints weigh enough to hold the pose: stage
    3 has no prior of it, and with 1 a search winds into a mode so thin that rounding says where it ends."""
    problem, unknown = made(smoothed(kit.pose))["joints"]
    first = unknowns.first_state(unknown, problem.priors)
    middle = priors.first_state_features(unknowns.first_state_in_heading_frame(first)).mean(0)
    other = middle.clone()
    other[66:] += noisy(torch.zeros(72, dtype=F64), 0.3, 8)
    balls = 0.1**2 * torch.eye(priors.FIRST_STATE_SIZE, dtype=F64).expand(2, -1, -1)
    mixture = InitGmm(torch.tensor([1e-12, 1 - 1e-12], dtype=F64), torch.stack((middle, other)), balls)
    weights = {"joints3d": 300.0, "init_motion_prior": 0.3, "contact_height": 0.0}
    weights = replace(problem.weights, **{name: (0.0, 0.0, value) for name, value in weights.items()})
    return replace(problem, priors=replace(problem.priors, initial=mixture), weights=weights), unknown


def smoothed(pose):
    """A pose prior without kinks, as the first state's slopes are differences."""
    pose = deepcopy(pose)
    pose.slopes = (1.0, 1.0, 1.0)
    return pose


@pytest.fixture(scope="module")
def settled(case):
    """Where a search without jumps ends."""
    problem, unknown = case
    return solve(problem, unknown, ALONE)[0]


def component(problem, unknown):
    return problem.priors.initial.each(mixed_features(problem, unknown)).argmax(-1)


def test_the_matrix_is_that_of_the_rest_and_of_the_mixture(case):
    """Together they are round, but for the ridge that holds what nothing else does."""
    problem, unknown = case
    with torch.no_grad():
        white = linearised(problem, unknown)
        f = mixed_features(problem, unknown)
        gmm = problem.priors.initial
        share = gmm.each(f).softmax(-1)
        pull = torch.einsum("bk,kij->bij", share, torch.linalg.inv(gmm.covariances))
        weight = problem.weights.of(3, frames=unknown.z.shape[1] + 1)["init_motion_prior"]
        whole = white.rest + weight * white.features.mT @ pull @ white.features
        values = torch.linalg.eigvalsh(whole)
        assert values.max() < 1 + 1e-6 and (values > 0.9).float().mean() > 0.8
        step, way = 1e-5, torch.randn(white.first.shape[0], white.first.shape[2], generator=seeded(3), dtype=F64)
        ends = []
        for s in (step, -step):
            at, _ = unwhiten(problem, unknown, white, nought(white) | {"first": s * way})
            ends.append(mixed_features(problem, at))
        slope = (ends[0] - ends[1]) / (2 * step)
        torch.testing.assert_close((white.features @ way[..., None])[..., 0], slope, atol=1e-3, rtol=1e-3)


def test_coordinates_under_inference_mode_are_those_without_it(case):
    problem, unknown = case
    with torch.inference_mode():
        under = linearised(problem, unknown).features
    torch.testing.assert_close(under, linearised(problem, unknown).features)


def test_where_a_search_has_ended_its_own_mode_promises_nothing(case, settled):
    problem, _ = case
    with torch.no_grad():
        white = linearised(problem, settled)
    energy, gain, *_ = feedback_solver.mixture_modes(problem, settled, white)
    torch.testing.assert_close(energy, total(problem, settled))
    own = component(problem, settled)
    assert (own == 0).all()
    assert gain[:, 0].abs().max() < 0.01 * energy.abs().min()
    assert (gain[:, 1] > 0.1).all()  # and the other much


def test_a_search_that_jumps_ends_in_the_deeper_mode_and_one_that_does_not_stays(case, settled):
    problem, unknown = case
    found, fits = solve(problem, unknown, replace(ALONE, rounds=6, mode_jumps=1))
    assert (component(problem, settled) == 0).all() and (component(problem, found) == 1).all()
    assert (total(problem, found) < total(problem, settled) - 0.1).all()
    torch.testing.assert_close(total(problem, found), fits[-1].energy, atol=0, rtol=1e-9)
    assert all(fit.energy.shape == (CLIPS,) and fit.history.shape[1] == CLIPS for fit in fits)


def test_a_leap_has_coordinates_of_its_own_component(case, settled):
    """They reach the same place, and the matrix of the mode is the identity in them: with another component of other
    widths it is far from that in the coordinates that the search left."""
    problem, _ = case
    gmm, wide = problem.priors.initial, torch.tensor([0.05, 0.2], dtype=F64).repeat(priors.FIRST_STATE_SIZE // 2)
    uneven = InitGmm(gmm.weights, gmm.means, torch.stack((gmm.covariances[0], wide.square().diag())))
    problem = replace(problem, priors=replace(problem.priors, initial=uneven))
    with torch.no_grad():
        white = linearised(problem, settled)
    found = feedback_solver.mixture_modes(problem, settled, white)
    who, which = torch.tensor([1, 0, 1]), torch.tensor([1, 1, 0])
    whitener, begin = feedback_solver.in_mode(white, found, who, which)
    where = white.first[who] @ found.where[who, which, :, None]
    torch.testing.assert_close(whitener @ begin[..., None], where, atol=1e-8, rtol=1e-8)
    inside = torch.linalg.solve(white.first[who], whitener)
    one = inside.mT @ found.matrix[who, which] @ inside
    torch.testing.assert_close(one, torch.eye(one.shape[-1], dtype=F64).expand_as(one), atol=1e-6, rtol=0)
    before = torch.linalg.eigvalsh(found.matrix[[0, 1], 1])  # control
    assert (before[:, -1] > 3).all() and (before[:, 0] < 0.5).all()


def test_a_mixture_without_weight_has_no_modes(case):
    problem, unknown = case
    still = replace(problem, weights=replace(problem.weights, init_motion_prior=(0.0, 0.0, 0.0)))
    with torch.no_grad():
        white = linearised(still, unknown)
    lax, every = Plan(mode_jumps=2, tolerance=-1.0), torch.ones(CLIPS, dtype=torch.bool)
    assert feedback_solver._starts(still, unknown, white, every, lax)[0].tolist() == [0, 1]
    assert feedback_solver._starts(problem, unknown, white, every, lax)[0].tolist() == [0, 1, 0, 0, 1, 1]  # control
    once = replace(lax, mode_jumps=1)
    assert feedback_solver._starts(problem, unknown, white, every, once)[0].tolist() == [0, 1, 0, 1]
    only = feedback_solver._starts(problem, unknown, white, torch.tensor([False, True]), once)[0]
    assert only.tolist() == [0, 1, 1]


def test_a_person_who_stops_one_row_stops_its_clip_and_what_is_not_finite_is_nobodys():
    history = torch.tensor([[3.0, 5.0, torch.nan], [2.0, 5.0, 4.0]])
    energy, reasons = history.nan_to_num(nan=torch.inf).amin(0), ["no decrease", "gradient", "interrupted"]
    rows = BatchFit({}, energy, history, 1.0, reasons)
    best, fit = feedback_solver._of_clips(rows, torch.tensor([0, 1, 0]))
    assert best.tolist() == [0, 1] and fit.reasons == ["interrupted", "gradient"]
    assert fit.history.tolist() == [[3.0, 5.0], [2.0, 5.0]] and fit.energy.tolist() == [2.0, 5.0]


def test_a_leap_to_nowhere_leaves_the_clip_where_it_was(case, monkeypatch):
    """Not a number, or so far that nothing is finite."""
    problem, unknown = case
    once = replace(ALONE, rounds=1, closures=8)
    alone, _ = solve(problem, unknown, once)

    def nowhere(problem, unknown, white, jumping, plan):
        stay = torch.arange(CLIPS).repeat(3)
        first = torch.zeros(3 * CLIPS, white.first.shape[1], dtype=F64)
        first[CLIPS : 2 * CLIPS], first[2 * CLIPS :] = torch.nan, 1e30
        return stay, white.first[stay], first

    monkeypatch.setattr(feedback_solver, "_starts", nowhere)
    found, fits = solve(problem, unknown, replace(once, mode_jumps=2))
    torch.testing.assert_close(total(problem, found), total(problem, alone), rtol=1e-9, atol=0)
    assert fits[0].history.isfinite().all()


def rows_of_searches(monkeypatch):
    """How many rows every search has, as they come."""
    sizes, plain = [], feedback_solver.minimise_batch

    def noted(energy, start, **how):
        sizes.append(len(start["nu"]))
        return plain(energy, start, **how)

    monkeypatch.setattr(feedback_solver, "minimise_batch", noted)
    return sizes


def test_of_searches_that_race_the_lowest_goes_on_alone(case, settled, monkeypatch):
    """It ends in the mode that all of them together end in, and goes on from where the race left it."""
    problem, _ = case
    sizes = rows_of_searches(monkeypatch)
    plan = replace(ALONE, rounds=3, mode_jumps=1)
    found, fits = solve(problem, settled, replace(plan, halving_after=4))
    assert sizes[:2] == [2 * CLIPS, CLIPS]
    together, _ = solve(problem, settled, plan)
    leapt = component(problem, found) == 1
    assert leapt.any() and torch.equal(leapt, component(problem, together) == 1)
    assert (total(problem, found) < total(problem, settled) - 0.1)[leapt].all()
    torch.testing.assert_close(total(problem, found), fits[-1].energy, atol=0, rtol=1e-9)
    first = fits[0].history
    assert 4 < len(first) <= ALONE.closures and (first[4] < first[0])[leapt].all()


@pytest.mark.parametrize("race", [0, 3])
def test_who_stays_after_a_race_jumps_no_more(case, monkeypatch, race):
    """Leaps into nowhere: a race that they lose is the last; without races they are tried in every round."""
    problem, unknown = case
    asked = []

    def astray(problem, unknown, white, jumping, plan):
        asked.append(plan.mode_jumps * int(jumping.any()))
        every = torch.arange(len(white.first)).repeat(1 + asked[-1])
        first = torch.zeros(len(every), white.first.shape[-1], dtype=F64)
        first[CLIPS:] = 30.0
        return every, white.first[every], first

    monkeypatch.setattr(feedback_solver, "_starts", astray)
    plan = replace(ALONE, rounds=3, closures=6, mode_jumps=1, halving_after=race, tolerance=0.0)
    _, fits = solve(problem, unknown, plan)
    assert len(fits) == 3 and asked == ([1, 0, 0] if race else [1, 1, 1])


def test_a_plan_says_when_jumps_begin_how_sure_the_matrix_is_and_what_gain_is_none(case, monkeypatch):
    problem, unknown = case
    asked, ridges, plain = [], [], feedback_solver._starts

    def starts(problem, unknown, white, jumping, plan):
        asked.append(plan.mode_jumps * int(jumping.any()))
        return plain(problem, unknown, white, jumping, plan)

    def linearise(problem, unknown, *, ridge, stride):
        ridges.append(ridge)
        return linearised(problem, unknown, ridge=ridge, stride=stride)

    monkeypatch.setattr(feedback_solver, "_starts", starts)
    plan = replace(ALONE, rounds=4, closures=5, mode_jumps=1, trial_rounds=2, tolerance=0.0)
    plan = replace(plan, damping=(0.1, 0.02), ridge=0.01)
    _, fits = solve(problem, unknown, plan, linearise=linearise)
    assert asked == [0, 0, 1, 1] and ridges == [0.1, 0.02, 0.01, 0.01] and len(fits) == 4
    gained = float((fits[2].energy - fits[3].energy).max())
    plan = replace(plan, rounds=9, min_gain=1.01 * gained / (unknown.z.shape[1] + 1))
    _, fewer = solve(problem, unknown, plan, linearise=linearise)
    assert len(fewer) <= 4 and torch.equal(fewer[0].energy, fits[0].energy)
    for wrong in ({"halving_after": -1}, {"halving_after": 29}, {"trial_rounds": -1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Plan(**wrong)


def test_of_a_batch_one_clip_may_leap_on(case, settled, monkeypatch):
    """The other, which stayed after its race, is not asked again. A second start that a plan leaves out is not used."""
    problem, unknown = case
    mixed = of_both(settled.rows(slice(0, 1)), unknown.rows(slice(1, 2)))
    rows, starts, search = [], feedback_solver._starts, feedback_solver.minimise_from

    def forced(problem, unknown, white, jumping, plan):
        """A leap for each, of the second clip into nowhere."""
        who, whitener, first = starts(problem, unknown, white, jumping, replace(plan, tolerance=-1e9))
        return who, whitener, torch.where((who[:, None] == 1) & (torch.arange(len(who)) >= CLIPS)[:, None], 30.0, first)

    def noted(problem, unknown, white, who, *args, **how):
        rows.append(who.tolist())
        return search(problem, unknown, white, who, *args, **how)

    monkeypatch.setattr(feedback_solver, "_starts", forced)
    monkeypatch.setattr(feedback_solver, "minimise_from", noted)
    plan = replace(ALONE, rounds=2, mode_jumps=1, halving_after=4, tolerance=0.0)
    solve(problem, mixed, plan, second_start=mixed)
    assert rows == [[0, 1, 0, 1], [0, 1], [0, 1, 0], [0, 1]]


@pytest.mark.parametrize("at", [2, 5, 9])
def test_ctrl_c_in_a_race_or_behind_it_keeps_the_best(case, settled, monkeypatch, at):
    problem, _ = case
    calls, plain = [], feedback_solver.rolled_terms

    def interrupted(*args):
        calls.append(1)
        if len(calls) == at + 1:  # the first is of ``mixture_modes``
            raise KeyboardInterrupt
        return plain(*args)

    monkeypatch.setattr(feedback_solver, "rolled_terms", interrupted)
    found, fits = solve(problem, settled, replace(ALONE, mode_jumps=1, halving_after=4))
    assert fits[-1].reasons == ["interrupted"] * CLIPS and len(fits) == 1
    assert (total(problem, found) <= total(problem, settled) + 1e-9).all()
