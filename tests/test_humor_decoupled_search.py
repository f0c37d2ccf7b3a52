"""The searches over decoupled unknowns: against torch's own Adam, and what each of them must not do."""

import time
from dataclasses import replace

import pytest
import torch

from motionlab.humor import state
from motionlab.humor.decoupled import search
from motionlab.humor.decoupled.energy import Form, terms, to_persistent, to_states
from motionlab.humor.decoupled.search import BOTH, Plan, X, Z, adam, alternate, lbfgs
from motionlab.humor.observed import evidence
from motionlab.humor.rollout import infer
from motionlab.humor.stages import Problem
from motionlab.humor.weights import KEYPOINTS
from tests.fit_inputs import joints


@pytest.fixture(scope="module")
def short(walk):
    return walk.cut(0, 10)


@pytest.fixture(scope="module")
def problem(kit, short):
    return Problem(evidence(joints(short)), kit, KEYPOINTS)


@pytest.fixture(scope="module")
def start(kit, short):
    states = state.from_motion(short)
    with torch.no_grad():
        z = infer(kit.motion, states)[0].mean
    noise = torch.Generator().manual_seed(1)
    x = to_persistent(states)
    x = x + 0.01 * torch.randn(x.shape, generator=noise)
    return {"x": x, "z": z + 0.1 * torch.randn(z.shape, generator=noise), "betas": torch.zeros(2, 8)}


def repeated(problem, start, times):
    every = torch.arange(2).repeat(times)
    return problem.rows(every), {n: x[every] for n, x in start.items()}


def total(problem, unknown, form):
    with torch.no_grad():
        return sum(terms(problem, unknown, form)[0].values())


def test_adam_is_torchs(problem, start):
    form = Form(1, 2.0)
    found = adam(problem, start, Plan(form, rate_x=0.01, rate_z=0.03, settle=False), 4)
    point = {n: x.clone().requires_grad_() for n, x in start.items()}
    other = torch.optim.Adam(
        [{"params": [point["x"], point["betas"]], "lr": 0.01}, {"params": [point["z"]], "lr": 0.03}]
    )
    for k in range(4):
        other.zero_grad()
        value = sum(terms(problem, point, form)[0].values())
        torch.testing.assert_close(found.history[k], value.detach(), rtol=1e-4, atol=1e-3)
        value.sum().backward()
        other.step()
    for n, x in point.items():
        torch.testing.assert_close(found.unknown[n], x.detach(), atol=2e-4, rtol=1e-3)
    assert found.evaluations == 4 and found.seconds > 0


@pytest.mark.parametrize("moving", [X, Z, BOTH])
def test_what_is_fixed_stays(problem, start, moving):
    for run in (lambda p: adam(problem, start, p, 3), lambda p: lbfgs(problem, start, p, 6)):
        found = run(Plan(moving=moving)).unknown
        for n, x in start.items():
            assert torch.equal(found[n], x) == (n not in moving), n


def test_both_methods_lower_the_energy(problem, start):
    form = Form(1, 3.0)
    before = total(problem, start, form)
    for found in (
        adam(problem, start, Plan(form, rate_x=0.003, rate_z=0.01), 40),
        lbfgs(problem, start, Plan(form), 40),
    ):
        assert (total(problem, found.unknown, form) < before).all()


def test_a_share_of_one_copies(problem, start):
    plan = Plan(Form(1, 0.0), rate_x=1e-9, rate_z=1e-9, share=1.0)
    found = adam(problem, start, plan, 1).unknown
    with torch.no_grad():
        decoded = terms(problem, start, plan.form)[1]
    torch.testing.assert_close(to_states(found["x"])[:, 1:], decoded.states[:, 0, 1:], atol=1e-5, rtol=0)
    torch.testing.assert_close(found["x"][:, 0], start["x"][:, 0], atol=1e-6, rtol=0)
    half = adam(problem, start, replace(plan, share=0.5), 1).unknown["x"]
    torch.testing.assert_close(half, (found["x"] + start["x"]) / 2, atol=1e-5, rtol=0)


def test_copying_alone_becomes_the_roll_out_one_frame_at_a_time(problem, start):
    """No steps, only copies: after n of them the first n frames are the exact roll-out, the next is not."""
    plan = Plan(Form(1, 0.0), rate_x=0.0, rate_z=0.0, share=1.0)
    form = Form(9)
    with torch.no_grad():
        rolled = terms(problem, start, form)[1].states[:, -1]
    for n in (1, 4):
        x = to_states(adam(problem, start, plan, n).unknown["x"])
        away = (x - rolled).abs().amax((0, 2))
        assert (away[: n + 1] < 1e-4).all() and (away[n + 1 :] > 1e-3).all()


def test_every_row_may_have_settings_of_its_own(problem, start):
    settings = {"rate_x": (0.003, 0.01), "rate_z": (0.01, 0.02), "weight": (1.0, 10.0), "share": (0.0, 0.5)}

    def plan(k):
        at = (lambda n: torch.tensor(settings[n]).repeat_interleave(2)) if k is None else lambda n: settings[n][k]
        return Plan(Form(1, at("weight")), rate_x=at("rate_x"), rate_z=at("rate_z"), share=at("share"))

    many, twice = repeated(problem, start, 2)
    together = adam(many, twice, plan(None), 3).unknown
    for k in (0, 1):
        alone = adam(problem, start, plan(k), 3).unknown
        for n, x in alone.items():
            torch.testing.assert_close(together[n][2 * k : 2 * k + 2], x, atol=1e-4, rtol=1e-3)


def test_lbfgs_takes_a_weight_per_row(problem, start):
    many, twice = repeated(problem, start, 2)
    form = Form(1, torch.tensor([1.0, 1.0, 10.0, 10.0]))
    found = lbfgs(many, twice, Plan(form), 8)
    assert found.history.shape == (8, 4)
    assert (total(many, found.unknown, form) < total(many, twice, form)).all()


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
@pytest.mark.parametrize("first", ["x", "z"])
def test_flip_flop_never_rises(problem, start, method, first):
    """Also where the steps are far too long."""
    form = Form(1, 3.0)
    plan = Plan(form, rate_x=0.3, rate_z=3.0)
    found = alternate(problem, start, plan, turns=2, inner=5, method=method, first=first)
    assert found.history.shape == (5, 2)
    assert (found.history.diff(dim=0) <= 0).all()
    torch.testing.assert_close(found.history[-1], total(problem, found.unknown, form), rtol=1e-4, atol=1e-3)


def test_control_adam_alone_does_rise_with_such_steps(problem, start):
    found = adam(problem, start, Plan(Form(1, 3.0), rate_x=0.3, rate_z=3.0), 10)
    assert (found.history[1:].amax(0) > found.history[0]).any()


def test_a_clip_that_is_not_finite_does_not_hurt_its_neighbour(problem, start):
    bad = {**start, "z": start["z"].clone()}
    bad["z"][0, 0, 0] = torch.nan
    found = adam(problem, bad, Plan(), 3).unknown
    good = adam(problem, start, Plan(), 3).unknown
    torch.testing.assert_close(found["x"][1], good["x"][1], atol=1e-4, rtol=1e-3)
    assert torch.equal(found["x"][0], start["x"][0])


def test_watching_costs_no_time_and_changes_nothing(problem, start):
    seen = adam(problem, start, Plan(), 4, watch=lambda u: {"z": u["z"].clone()}, at=(0, 2, 4))
    plain = adam(problem, start, Plan(), 4)
    assert list(seen.watched) == [0, 2, 4]
    assert torch.equal(seen.watched[0]["z"], start["z"]) and torch.equal(seen.watched[4]["z"], seen.unknown["z"])
    assert torch.equal(seen.unknown["x"], plain.unknown["x"])


@pytest.mark.parametrize("run", [adam, lbfgs])
def test_watching_is_not_timed(problem, start, run):
    def burn(_):
        began = time.process_time()
        while time.process_time() - began < 1.0:
            pass
        return {}

    plain, seen = run(problem, start, Plan(), 4), run(problem, start, Plan(), 4, watch=burn, at=(0, 1, 2, 4))
    assert list(seen.watched) == [0, 1, 2, 4] and 0 < seen.seconds < plain.seconds + 1.0


def test_lbfgs_shows_the_lowest_point_so_far_on_the_way(problem, start):
    seen = lbfgs(problem, start, Plan(), 8, watch=lambda u: {n: x.clone() for n, x in u.items()}, at=(0, 3, 5))
    assert list(seen.watched) == [0, 3, 5, 8]
    for n, unknown in seen.watched.items():
        alone = lbfgs(problem, start, Plan(), n).unknown if n else start
        for name, x in alone.items():
            torch.testing.assert_close(unknown[name], x, atol=1e-5, rtol=1e-4)
    assert not torch.equal(seen.watched[3]["z"], seen.watched[8]["z"])


def test_lbfgs_that_is_stopped_is_no_result(problem, start, monkeypatch):
    calls, whole = [], search.terms

    def stopped(*arguments):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return whole(*arguments)

    monkeypatch.setattr(search, "terms", stopped)
    with pytest.raises(KeyboardInterrupt):
        lbfgs(problem, start, Plan(), 8)
    assert len(calls) == 3


@pytest.mark.parametrize("steps", [1, 3])
def test_news_travels_no_faster_than_its_steps(problem, start, steps):
    """A nudge of the first state reaches no frame that is farther than K + 1 frames per iteration."""
    nudged = {**start, "x": start["x"].clone()}
    nudged["x"][:, 0, :3] += 0.05
    plan = Plan(Form(steps), moving=("x", "z"))
    moved = search.reach(problem, start, plan, nudged, 2)
    assert moved.shape == (3, 10)
    for n in range(3):
        arrived = moved[n].nonzero().flatten()
        assert arrived.max() <= n * (steps + 1)
    assert moved[1, 1] > 0
