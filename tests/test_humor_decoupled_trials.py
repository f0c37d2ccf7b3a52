"""What the decoupled stage 3 is tried on and judged by."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab import profiling
from motionlab.humor import decoupled_trials as trials
from motionlab.humor import decoupled_tuning as tuning
from motionlab.humor import state
from motionlab.humor.decoupled import Form, to_persistent, to_states
from motionlab.humor.decoupled_search import Plan, Z, adam
from motionlab.humor.rollout import infer
from motionlab.humor.testops import Schedule


@pytest.fixture(scope="module")
def known(kit):
    film = scenes.film("sitting, legs hidden", 2, seed=5, frames=24)
    return trials.case(film, kit, Schedule.quick(), frames=16, whole=True)


def test_a_case_is_stage_2_and_its_latents(known, kit):
    assert len(known) == 2 and known.truth.frames == known.stage_2.frames == 16
    states = state.from_motion(known.stage_2)
    torch.testing.assert_close(to_states(known.start["x"]), states, atol=1e-5, rtol=0)
    with torch.no_grad():
        torch.testing.assert_close(known.start["z"], infer(kit.motion, states)[0].mean)
    assert known.seconds > 0 and known.model is kit.motion
    # the shape is that of stage 2, not of stage 3
    assert not torch.equal(known.start["betas"], known.fitted.betas)


def test_the_reference_has_the_energy_that_the_fit_reports(known):
    found = trials.judged(known, trials.reference(known))
    torch.testing.assert_close(found["energy"], sum(known.fitted.energies[3].values()), atol=0.05, rtol=1e-3)
    assert (found["gap"] < 0.01).all()
    torch.testing.assert_close(found["legs"], found["kept legs"], atol=0.02, rtol=0)


def test_truth_sits_and_the_judge_sees_it(kit):
    film = scenes.film("sitting, legs hidden", 2, seed=5, frames=40)
    known = trials.case(film, kit, Schedule.quick(), frames=40)
    states = state.from_motion(film.truth)
    with torch.no_grad():
        z = infer(kit.motion, states)[0].mean
    found = trials.judged(known, {**known.start, "x": to_persistent(states), "z": z})
    assert found["kept sits"].all() and (found["kept legs"] < 5).all()
    assert found["gap"].min() > 0.1  # its latents do not lead there exactly
    truth, stage_2 = (trials.bending(known.model, s, z, known) for s in (states, state.from_motion(known.stage_2)))
    assert (truth > 60).all() and (truth > stage_2 - 60).all()


def test_tolerance():
    history = torch.tensor([[10.0, 4.0], [5.0, 4.0], [6.0, 2.0], [0.1, 0.0], [0.0, 0.0]])
    assert trials.to_tolerance(history).tolist() == [4, 4]
    assert trials.to_tolerance(history, 0.5).tolist() == [2, 3]


def test_tuning_takes_the_best_of_the_grid(known):
    def make(rate, weight):
        return Plan(Form(1, weight), rate_x=rate, rate_z=rate)

    search = tuning.Search(make, {"rate": (1e-6, 3e-3, 0.3), "weight": (1.0, 10.0)})
    best, rows = tuning.tune(known, search, 12)
    assert len(rows) == 6
    assert best == {n: min(rows, key=lambda r: r["energy"])[n] for n in ("rate", "weight")}
    assert best["rate"] != 0.3
    alone = adam(known.problem, known.start, make(**best), 12)
    mean = trials.judged(known, alone.unknown)["energy"].mean().item()
    assert min(r["energy"] for r in rows) == pytest.approx(mean, rel=1e-2, abs=1.0)


@pytest.mark.parametrize("name", [*tuning.SEARCHES, "fixed z"])
def test_every_search_makes_a_plan_of_numbers_and_of_tensors(known, name):
    search = tuning.SEARCHES.get(name, tuning.FIXED_Z)
    least = {n: values[:1] for n, values in search.grid.items()}
    best, rows = tuning.tune(known, replace(search, grid=least), 2)
    assert len(rows) == 1 and best == {n: v[0] for n, v in least.items()}
    plan = search.make(**best)
    assert plan.form.detached == ("detached" in name) and (plan.share == 1) == (name == "copy")
    assert ("z" in plan.moving) != (name == "fixed z")


def test_turns_and_lbfgs_are_chosen_by_energy(known):
    way, rows = tuning.best_turns(known, Plan(Form(1, 3.0), rate_x=0.01, rate_z=0.01), 8)
    assert way in tuning.TURNS and len(rows) == len(tuning.TURNS)
    assert {n: min(rows, key=lambda r: r["energy"])[n] for n in way} == way
    plan, rows = tuning.best_lbfgs(known, 6, (1.0, 10.0))
    assert plan.form.weight == min(rows, key=lambda r: r["energy"])["weight"]


def test_everything_is_tuned_and_told(known, monkeypatch):
    least = {name: replace(s, grid={n: v[:1] for n, v in s.grid.items()}) for name, s in tuning.SEARCHES.items()}
    monkeypatch.setattr(tuning, "SEARCHES", least)
    monkeypatch.setattr(tuning, "TURNS", tuning.TURNS[:1])
    found = tuning.tune_all(known, 2)
    assert list(found.plans) == list(least) and found.way == tuning.TURNS[0]
    assert [row["search"] for row in found.rows] == [*least, "L1, L-BFGS", "z and x in turns"]
    assert {len(row) for row in found.rows} == {6}
    assert tuning.text({"a": (1.0, 0.03), "b": "x"}) == "a 1; 0.03, b x"


def test_closures_are_timed_in_turns(known):
    found = trials.closures(known, {"1": Form(1), "4": Form(4)}, 3)
    assert {n: x.shape for n, x in found.items()} == {"1": (3,), "4": (3,)}
    assert found["4"].median() > found["1"].median()


@pytest.mark.parametrize("form", ["official", "lean"])
def test_both_forms_decode_the_same(known, form):
    states = to_states(known.start["x"])[:1, :8]
    z = known.start["z"][:1, :7]
    with torch.no_grad():
        one, chain = (trials.decodes(known.model, states, z, k, trials.FORMS[form])() for k in (1, None))
        other = trials.decodes(known.model, states, z, 1, trials.FORMS["lean" if form == "official" else "official"])()
    torch.testing.assert_close(one, other, rtol=2e-3, atol=0)
    assert (one - chain).abs() > 1e-3 * chain.abs()


def test_costs_count_nodes_and_rounds(known):
    found = trials.costs(known.model, to_states(known.start["x"])[:1], (1, 2), (1, 2), rounds=2)
    assert len(found.seconds) == len(found.nodes) == 2 * 2 * 3
    assert found.gain("official", 1, 1).shape == (2,)
    assert found.nodes["official", 1, None] > 3 * found.nodes["official", 1, 1]
    assert found.nodes["official", 1, 2] > found.nodes["official", 1, 1]
    value = trials.decodes(known.model, to_states(known.start["x"])[:1], known.start["z"][:1], None, trials.LEAN)()
    assert found.nodes["lean", 1, None] == profiling.graph_nodes(value)


def test_latents_go_towards_the_reference(known):
    found, error = trials.towards(known, Plan(Form(1, 1.0), moving=Z, rate_z=0.01), 30, (0, 30))
    wanted = (known.start["z"] - known.fitted.z[:, 0]).abs().mean((-1, -2))
    torch.testing.assert_close(error[0], wanted)
    assert torch.equal(found.unknown["x"], trials.reference(known)["x"])
    assert (error[1] != error[0]).all()
