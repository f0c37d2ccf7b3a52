"""What the decoupled stage 3 is tried on and judged by."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from data_synth import scenes
from motionlab import profiling
from motionlab.humor import state
from motionlab.humor.decoupled import costs, trials, tuning
from motionlab.humor.decoupled.energy import Form, to_persistent, to_states
from motionlab.humor.decoupled.search import BOTH, Plan, X, Z, adam
from motionlab.humor.rollout import infer
from motionlab.humor.testops import Schedule


@pytest.fixture(scope="module")
def known(kit):
    film = scenes.film("sitting, legs hidden", 2, seed=5, frames=24)
    return trials.case(film, kit, Schedule.quick(), frames=16, solver="rollout")


def test_a_case_is_stage_2_and_its_latents(known, kit):
    assert len(known) == 2 and known.truth.frames == known.stage_2.frames == 16
    states = state.from_motion(known.stage_2)
    torch.testing.assert_close(to_states(known.start["x"]), states, atol=1e-5, rtol=0)
    with torch.no_grad():
        torch.testing.assert_close(known.start["z"], infer(kit.motion, states)[0].mean)
    assert known.seconds > 0 and known.model is kit.motion
    # the shape is that of stage 2, not of stage 3
    assert not torch.equal(known.start["betas"], known.fitted.betas)


def test_a_fit_that_is_stopped_is_no_case(kit, monkeypatch):
    whole, seen = trials.testops.fit, []

    def stopped(*arguments, **how):
        found = whole(*arguments, **how)
        seen.append(found.results)
        if len(seen) == 2:
            report = found.results[3][-1]
            found.results[3][-1] = replace(report, reasons=["interrupted", *report.reasons[1:]])
        return found

    film = scenes.film("sitting, legs hidden", 2, seed=5, frames=24)
    monkeypatch.setattr(trials.testops, "fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        trials.case(film, kit, Schedule.quick(), frames=16, solver="rollout")
    assert len(seen) == 2


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
    own, stage_2 = trials.bending(known, z, states), trials.bending(known, z)
    assert (own > 60).all() and (stage_2 > trials.ENCODES).all()
    assert (trials.bending(known, known.start["z"]) < stage_2 - 10).all()  # control: the z of legs that stand


def test_tolerance():
    history = torch.tensor([[10.0, 4.0], [5.0, 4.0], [6.0, 2.0], [0.1, 0.0], [0.0, 0.0]])
    assert trials.to_tolerance(history).tolist() == [4, 4]
    assert trials.to_tolerance(history, 0.5).tolist() == [2, 3]


def both(rate, weight):
    return Plan(Form(1, weight), rate_x=rate, rate_z=rate)


def test_a_walk_ends_where_no_neighbour_is_better(known):
    search = tuning.Search(both, {"rate": 0.1, "weight": 10.0})
    found = tuning.tune(known, search, 6, rounds=8)
    assert found.ended and found.setting["rate"] < 0.1 and found.seconds > 0
    tried = {(r["rate"], r["weight"]): r["energy"] for r in found.rows}
    best = tuple(found.setting.values())
    around = [tuple(s.values()) for s in search.neighbours(found.setting)]
    assert len(around) == 4 and all(tried[best] <= tried[s] for s in around)
    alone = adam(known.problem, known.start, both(*best), 6)
    mean = trials.judged(known, alone.unknown)["energy"].mean().item()
    assert tuning.least(found) == tried[best] == pytest.approx(mean, rel=1e-2, abs=1.0)
    again = tuning.again(known, search, found, 6)
    assert again["energy"] == pytest.approx(mean, rel=1e-2, abs=1.0)
    elsewhere = {**known.start, "z": known.start["z"] + 1.0}
    assert tuning.again(known, search, found, 6, elsewhere)["energy"] > again["energy"] + 10


def test_control_a_walk_that_is_cut_off_says_so(known):
    """From steps so long that nothing good is near, one look finds a better neighbour and nothing of its own."""
    found = tuning.tune(known, tuning.Search(both, {"rate": 30.0, "weight": 10.0}), 4, rounds=1)
    assert not found.ended and len(found.rows) == 5


def test_a_walk_goes_on_from_the_best_of_several_places(known):
    """From steps so long that nothing good is near; a place elsewhere finds the way, one that is worse does not."""
    search = tuning.Search(both, {"rate": 30.0, "weight": 10.0})
    near, far = {"weight": 10.0, "rate": 0.003}, {"rate": 300.0, "weight": 300.0}  # in any order of their names
    lost = tuning.tune(known, search, 4, rounds=2)
    several = replace(search, also=(near, far, {"rate": 10.0, "weight": 10.0}))
    found = tuning.tune(known, several, 4, rounds=2)
    assert found.setting["rate"] <= 0.01 < 1.0 <= lost.setting["rate"]
    assert len(found.rows) == 5 + 2 + 4  # the third is a neighbour of the beginning: tried once
    least = [min(row["energy"] for row in walk.rows) for walk in (found, lost)]
    assert least[0] < least[1]


@pytest.mark.parametrize("steps", [1, 3])
def test_more_steps_are_tuned_as_they_are_searched(known, steps):
    search = tuning.l1_of(steps)
    row = tuning.tune(known, search, 4, rounds=1).rows[0]
    plan = search.make(**search.begin)
    assert plan.form.steps == steps and plan.moving == BOTH
    one = search.make(rate_x=0.003, rate_z=0.02, weight=7.0)
    assert (one.rate_x, one.rate_z, one.form.weight) == (0.003, 0.02, 7.0)
    found = {k: adam(known.problem, known.start, replace(plan, form=replace(plan.form, steps=k)), 4) for k in (1, 3)}
    means = {k: trials.judged(known, run.unknown)["energy"].mean().item() for k, run in found.items()}
    assert row["energy"] == pytest.approx(means.pop(steps), rel=1e-2, abs=1.0)
    assert row["energy"] != pytest.approx(*means.values(), rel=1e-2, abs=1.0)


def test_a_ladder_ends():
    search = tuning.Search(both, {"rate": 1.0, "weight": 1.0}, ladders={"rate": (0.1, 1.0)})
    assert [s["rate"] for s in search.neighbours({"rate": 1.0, "weight": 1.0})] == [0.1, 1.0, 1.0]
    every = search.neighbours({"rate": 0.1, "weight": tuning.LADDER[0]})
    assert list(every) == [{"rate": 1.0, "weight": 1e-6}, {"rate": 0.1, "weight": 3e-6}]


def test_control_a_choice_at_a_ladders_end_has_not_ended(known):
    search = tuning.Search(both, {"rate": 0.003, "weight": 10.0}, ladders={"rate": (0.003,), "weight": (10.0,)})
    found = tuning.tune(known, search, 2)
    assert not found.ended and len(found.rows) == 1


def test_a_walk_searches_from_where_it_is_told(known):
    still = tuning.Search(
        lambda rate, weight: Plan(Form(1, weight), rate_x=0.0, rate_z=0.0), {"rate": 1.0, "weight": 1.0}
    )
    moved = {**known.start, "z": known.start["z"] + 1.0}
    for start in (known.start, moved):
        row = tuning.tune(known, still, 1, rounds=1, start=start).rows[0]
        assert row["energy"] == pytest.approx(trials.judged(known, start)["energy"].mean().item(), rel=1e-3)


@pytest.mark.parametrize("name", [*tuning.SEARCHES, "fixed z"])
def test_every_search_makes_a_plan_of_numbers_and_of_tensors(known, name):
    search = tuning.SEARCHES.get(name, tuning.FIXED_Z)
    found = tuning.tune(known, search, 2, rounds=1)
    assert len(found.rows) == 1 + 2 * len(search.begin)  # it begins at the end of no ladder
    plan = search.make(**found.setting)
    assert plan.form.detached == ("detached" in name) and (plan.share == 1) == (name == "copy")
    assert ("z" in plan.moving) != (name == "fixed z")


@pytest.mark.parametrize("way", tuning.TURNS)
def test_turns_are_tuned_in_one_batch_as_each_alone(known, way):
    search = tuning.TURNS[way]
    # few evaluations: later, rounding decides where lines end and which blocks are kept
    found = tuning.tune(known, search, 8, rounds=1)
    assert len(found.rows) == 1 + 2 * len(search.begin)
    row = found.rows[1]  # a shorter step of x than of z, where either has one
    assert "rate_x" not in row or row["rate_x"] < row["rate_z"]
    alone = search.method(known.problem, known.start, search.make(**{n: row[n] for n in search.begin}), 8)
    mean = trials.judged(known, alone.unknown)["energy"].mean().item()
    assert row["energy"] == pytest.approx(mean, rel=1e-2, abs=1.0)
    assert len({round(row["energy"], 2) for row in found.rows}) == len(found.rows)  # settings matter


def test_the_best_of_the_chosen_is_that_with_the_least_energy():
    def chose(*energies):
        return tuning.Choice({}, [{"energy": x} for x in energies], True)

    assert tuning.best({"a": chose(3.0, 2.0), "b": chose(5.0, 1.0), "c": chose(1.5)}) == "b"


@pytest.mark.parametrize(
    "inner, evaluations, looks", [(2, 8, [0, 2, 4, 6, 8]), (3, 8, [0, 3, 6]), (0, 8, [0, 4, 8]), (25, 8, [0, 4, 8])]
)
def test_turns_begin_where_they_are_told_and_are_looked_at_after_every_block(known, inner, evaluations, looks):
    plan = Plan(Form(1, 3.0), rate_x=0.01, rate_z=0.01)
    begun = known.start | {"z": known.start["z"] + 0.1}
    method = partial(tuning.in_turns, method="adam", inner=inner, first="z")
    found = trials.searched(known, begun, plan, evaluations, method=method)
    assert list(found.watched) == looks
    for at, unknown in ((0, begun), (looks[-1], found.unknown)):
        torch.testing.assert_close(found.watched[at]["energy"], trials.judged(known, unknown)["energy"])
    assert not method(known.problem, begun, plan, evaluations).watched


def test_a_step_for_z_is_chosen_by_the_energy_that_it_lowers(known):
    found = tuning.rate_of_z(known, Form(2, 1.0), 20)
    assert list(found) == list(tuning.RATES)
    best = min(found, key=found.get)
    start = {**trials.reference(known), "z": known.start["z"]}
    for rate in (best, tuning.RATES[0]):
        alone = adam(known.problem, start, Plan(Form(2, 1.0), moving=Z, rate_z=rate, settle=False), 20)
        assert found[rate] == pytest.approx(alone.history[-2:].mean().item(), rel=1e-2)
    assert found[best] < 0.9 * found[tuning.RATES[0]]


def test_what_is_told_of_a_walk(known):
    search = tuning.SEARCHES["copy"]
    row = tuning.told("copy", tuning.tune(known, search, 2, rounds=1))
    assert row["search"] == "copy" and row["settings tried"] == 5
    assert row["energy"] <= row["next best"] <= row["worst"]
    assert tuning.text({"a": 0.03, "b": "x"}) == "a 0.03, b x"


@pytest.mark.parametrize("name", ["L1", "L1, L-BFGS"])
def test_a_search_is_looked_at(known, name):
    search = tuning.SEARCHES[name]
    plan = search.make(**search.begin)
    found = trials.searched(known, known.start, plan, 6, method=search.method, at=(0, 3, 6))
    assert list(found.watched) == [0, 3, 6]
    for at, unknown in ((0, known.start), (6, found.unknown)):
        torch.testing.assert_close(found.watched[at]["energy"], trials.judged(known, unknown)["energy"])
    blind = search.method(known.problem, known.start, plan, 6)
    assert not blind.watched and torch.equal(blind.unknown["z"], found.unknown["z"])  # looking changes nothing


def test_how_far_on_the_way():
    seen = {0: [10.0, 10.0, 10.0], 5: [8.0, 9.0, torch.nan], 20: [4.0, 9.5, 12.0]}
    watched = {n: {"energy": torch.tensor(x)} for n, x in seen.items()}
    goal = torch.tensor([0.0, 0.0, 0.0])
    inf = torch.inf
    for share, after in ((0.1, [5, 5, inf]), (0.2, [5, inf, inf]), (0.5, [20, inf, inf]), (0.9, [inf] * 3)):
        assert trials.gone(watched, goal, share).tolist() == after
    assert trials.gone(watched, torch.full((3,), 20.0), 0.5).tolist() == [0, 0, 0]  # no way to go


def test_energies_of_the_whole_fit_end_where_it_does(known):
    found = trials.whole_energies(known)
    *early, last = known.fitted.results[3]
    assert list(found)[-1] == sum(r.closures for r in early) + len(last.history)
    lowest = torch.stack([x["energy"] for x in found.values()])
    torch.testing.assert_close(lowest[-1], sum(known.fitted.energies[3].values()), atol=0.05, rtol=1e-3)
    assert (lowest[1:].diff(dim=0) <= 0).all()
    goal = trials.judged(known, trials.reference(known))["energy"]
    assert trials.gone(found, goal, 0.5).isfinite().all()


def test_with_z_fixed_only_x_moves_and_the_first_frames_are_seen(known):
    z = known.start["z"] + 0.1
    plan = tuning.FIXED_Z.make(rate_x=0.01, weight=1.0)
    found = trials.with_z_fixed(known, z, plan, 3, (0, 3), 6)
    assert torch.equal(found.unknown["z"], z) and not torch.equal(found.unknown["x"], known.start["x"])
    kept = trials.motions(known, found.unknown)["kept"]
    torch.testing.assert_close(found.watched[3]["first legs"], trials.legs(known, kept, 6))
    torch.testing.assert_close(found.watched[3]["kept legs"], trials.legs(known, kept))
    assert not torch.allclose(found.watched[3]["first legs"], found.watched[3]["kept legs"])
    assert trials.legs(known, known.truth).max() < 1e-4


def test_closures_are_timed_in_turns(known):
    plans = {(k, moving): Plan(Form(k), moving=moving) for k in (1, 4) for moving in (BOTH, X, Z)}
    found = costs.closures(known, plans, 3)
    assert {n: x.shape for n, x in found.items()} == dict.fromkeys(plans, (3,))
    assert all(found[4, moving].median() > found[1, moving].median() for moving in (BOTH, X, Z))


@pytest.mark.parametrize("form", ["official", "lean"])
def test_both_forms_decode_the_same(known, form):
    states = to_states(known.start["x"])[:1, :8]
    z = known.start["z"][:1, :7]
    with torch.no_grad():
        one, chain = (costs.decodes(known.model, states, z, k, costs.FORMS[form])() for k in (1, None))
        other = costs.decodes(known.model, states, z, 1, costs.FORMS["lean" if form == "official" else "official"])()
    torch.testing.assert_close(one, other, rtol=2e-3, atol=0)
    assert (one - chain).abs() > 1e-3 * chain.abs()


def test_costs_count_nodes_and_rounds(known):
    found = costs.costs(known.model, to_states(known.start["x"])[:1], (1, 2), (1, 2), rounds=2)
    assert len(found.seconds) == len(found.nodes) == 2 * 2 * 3
    assert found.gain("official", 1, 1).shape == (2,)
    assert found.nodes["official", 1, None] > 3 * found.nodes["official", 1, 1]
    assert found.nodes["official", 1, 2] > found.nodes["official", 1, 1]
    value = costs.decodes(known.model, to_states(known.start["x"])[:1], known.start["z"][:1], None, costs.LEAN)()
    assert found.nodes["lean", 1, None] == profiling.graph_nodes(value)


def test_latents_go_towards_the_reference(known):
    found, error = trials.towards(known, Plan(Form(1, 1.0), moving=Z, rate_z=0.01), 30, (0, 30))
    solution = known.fitted.z[:, 0]
    torch.testing.assert_close(error[0, 0], (known.start["z"] - solution).abs().mean((-1, -2)))
    assert torch.equal(found.unknown["x"], trials.reference(known)["x"])
    assert (error[:, 1] != error[:, 0]).all()
    # control: each of the two clips against the other's solution
    torch.testing.assert_close(error[1, 1], (found.unknown["z"] - solution.flip(0)).abs().mean((-1, -2)))
    assert (trials.latent_error(solution, torch.stack((solution, solution.flip(0)))) > 0).tolist() == [
        [False] * 2,
        [True] * 2,
    ]


def test_from_a_good_z_short_steps_keep_what_longer_ones_lose(known):
    """Notebook 07, H17: from single shooting's z short steps with a small weight do not raise the roll-out's energy;
    longer ones with a large weight do."""
    given = known.start | {"z": trials.reference(known)["z"]}
    begun, bad = (trials.judged(known, u)["energy"] for u in (given, known.start))

    def ends(rate, weight):
        plan = tuning.SEARCHES["L1"].make(rate_x=rate, rate_z=rate, weight=weight)
        return trials.judged(known, trials.searched(known, given, plan, 100).unknown)["energy"]

    assert (begun < bad).all() and (ends(1e-4, 1.0) <= begun).all()
    assert (ends(0.01, 30.0) > begun + 20).all()
