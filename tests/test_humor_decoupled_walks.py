"""The walks of notebook 07 in little; their record, and the record that the notebook reads."""

import json
from dataclasses import replace

import pytest

from motionlab import run_tuning
from motionlab.doctor import ROOT
from motionlab.errors import DataError
from motionlab.humor.decoupled import trials, tuning, walks
from motionlab.humor.decoupled.tuning import Choice
from motionlab.humor.decoupled.walks import FIXED, GIVEN, STAGE_2, Recipe

NOTEBOOKS = ROOT / "notebooks"
RECORD = NOTEBOOKS / "results" / "long" / "tuning.json"
LITTLE = Recipe(
    seed=1, clips=1, frames=12, short=11, long=13, schedule="quick", search=2, fixed=3, rounds=1, steps=(1, 2)
)  # fmt: skip


def test_every_search_of_the_notebook_has_a_walk_from_either_z():
    found = walks.searches(run_tuning.RECIPE)
    ways = {*tuning.TURNS}
    assert {name for z, name in found if z == STAGE_2} == {*tuning.SEARCHES, *ways} | {
        f"L1, K = {k}" for k in (2, 5, 10)
    }
    assert {name for z, name in found if z == GIVEN} == {"L1", "L1, z detached"} | ways
    assert {name for z, name in found if z == FIXED} == {"30", "100"}
    for key, search in found.items():
        if key[0] != FIXED:  # a step each, of turns and of more decoding steps as well
            assert ("rate_x" in search.begin) == ("rate_z" in search.begin) == ("L-BFGS" not in key[1])
        assert all(set(s) == set(search.begin) for s in search.also)


def test_from_a_good_z_searches_are_those_from_stage_2_but_for_where_they_begin():
    for name, search in tuning.GOOD_Z.items():
        other = (tuning.SEARCHES | tuning.TURNS)[name]
        assert replace(search, begin=other.begin, also=()) == other


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """A run that is stopped after three walks, and goes on."""
    path = tmp_path_factory.mktemp("walks") / "long" / "tuning.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_tuning.walks, "save", stop_after(walks.save, 3))
        with pytest.raises(KeyboardInterrupt):
            run_tuning.main(path, recipe=LITTLE, workers=1)
    early = walks.load(path, LITTLE)
    run_tuning.main(path, recipe=LITTLE, workers=1)
    return path, early


def stop_after(save, times):
    calls = []

    def saved(*arguments):
        save(*arguments)
        calls.append(1)
        if len(calls) == times:
            raise KeyboardInterrupt

    return saved


def test_a_run_that_is_stopped_goes_on_where_it_was(tuned):
    path, early = tuned
    found = walks.load(path, LITTLE)
    assert len(early) == 3 and set(found) == set(walks.searches(LITTLE))
    for key, choice in early.items():
        assert found[key] == choice  # its seconds, too: not walked again
    for (z, name), choice in found.items():
        assert len(choice.rows) >= 3 and choice.seconds > 0, (z, name)


def test_walks_begin_at_the_z_that_they_say(tuned):
    """A row of a walk, searched alone from that z, has the measure on record; from another z it has not."""
    found, fitted = walks.load(tuned[0], LITTLE), run_tuning.practised(LITTLE)
    practice = fitted(frames=LITTLE.frames, solver="rollout")
    starts = {STAGE_2: practice.start, GIVEN: practice.start | {"z": trials.reference(practice)["z"]}}
    for (z, start), other in zip(starts.items(), reversed(starts.values()), strict=True):
        key = z, "L1"
        assert near(key, found[key], practice, LITTLE.search, start)
        assert not near(key, found[key], practice, LITTLE.search, other)
    for frames in (LITTLE.short, LITTLE.long):
        case, key = fitted(frames=frames, solver="shooting"), (FIXED, str(frames))
        start = case.start | {"z": trials.reference(case)["z"]}
        assert near(key, found[key], case, LITTLE.fixed, start)
        assert not near(key, found[key], case, LITTLE.fixed, case.start | {"z": case.start["z"] + 0.3})
        assert not near(key, found[key], case, LITTLE.fixed - 2, start)


def near(key, walk, case, evaluations, start):
    search, row = walks.searches(LITTLE)[key], walk.rows[2]  # the longer step of x
    again = tuning.again(case, search, Choice({n: row[n] for n in search.begin}, [], True), evaluations, start)
    return again[search.measure] == pytest.approx(row[search.measure], rel=1e-4, abs=1e-3)


def test_with_all_on_record_nothing_is_fitted(tuned, monkeypatch, capsys):
    path, before = tuned[0], tuned[0].read_bytes()
    monkeypatch.setattr(run_tuning, "RECIPE", LITTLE)
    monkeypatch.setattr(run_tuning, "practised", None)  # not to be called
    run_tuning.command([str(path), "--workers", "1"])
    assert path.read_bytes() == before and "20 of 20 walks are on record" in capsys.readouterr().out
    with pytest.raises(TypeError):  # control: one is missing
        path_of_few = path.with_name("few.json")
        walks.save(path_of_few, LITTLE, dict(list(walks.load(path, LITTLE).items())[:-1]))
        run_tuning.command([str(path_of_few)])


def test_what_is_known_is_not_walked_and_strangers_are_left_out(tuned):
    found = walks.load(tuned[0], LITTLE)
    stranger = {("nowhere", "L1"): found[STAGE_2, "L1"]}
    assert walks.walks(LITTLE, None, None, known=found | stranger) == found


def test_a_record_of_another_recipe_is_not_used(tuned):
    path, _ = tuned
    for other in ({"seed": 2}, {"search": 3}, {"steps": (1, 2, 3)}, {"scene": "sitting"}, {"prior": "another"}):
        assert walks.load(path, replace(LITTLE, **other)) == {}
    assert walks.load(path.with_name("none.json"), LITTLE) == {}


def test_numbers_that_are_not_finite_survive_a_record(tmp_path):
    path, rows = tmp_path / "tuning.json", [{"weight": 1.0, "energy": 2.0}, {"weight": 3.0, "energy": float("inf")}]
    kept = {(STAGE_2, "L1, L-BFGS"): Choice({"weight": 1.0}, rows, True, 1.5)}
    walks.save(path, LITTLE, kept | {("nowhere", "L1"): kept[STAGE_2, "L1, L-BFGS"]})  # a stranger is left out
    assert walks.load(path, LITTLE) == kept
    json.loads(path.read_text(), parse_constant=pytest.fail)  # JSON, not Python's


def broken(record, change):
    change(record)
    return json.dumps(record)


def better(walk):
    """Something else that was tried is made the best."""
    other = next(row for row in walk["tried"] if any(row[n] != x for n, x in walk["chosen"].items()))
    other.update({m: -1e9 for m in ("energy", "kept legs")})


CHANGES = {
    "no recipe": lambda r: r.pop("recipe"),
    "a recipe with less": lambda r: r["recipe"].pop("seed"),
    "steps of another kind": lambda r: r["recipe"].update(steps=1),
    "walks of another kind": lambda r: r.update(walks=[1]),
    "chosen, never tried": lambda r: r["walks"][0]["chosen"].update(weight=77.0),
    "chosen nothing": lambda r: r["walks"][0].update(chosen={}),
    "chosen, but not the best": lambda r: better(r["walks"][0]),
    "without the measure": lambda r: [r["walks"][0]["tried"][0].pop(m) for m in ("energy", "kept legs")],
    "ended, in words": lambda r: r["walks"][0].update(ended="yes"),
    "no seconds": lambda r: r["walks"][0].pop("seconds"),
    "tried nothing": lambda r: r["walks"][0].update(tried=[]),
    "words for numbers": lambda r: r["walks"][0]["tried"][0].update(energy="low"),
}


@pytest.mark.parametrize("what", [*CHANGES, "half", "empty", "a list"])
def test_a_record_that_is_none_is_refused(tuned, tmp_path, what):
    text = tuned[0].read_text()
    plain = {"half": text[: len(text) // 2], "empty": "", "a list": "[]"}
    path = tmp_path / "tuning.json"
    path.write_text(plain[what] if what in plain else broken(json.loads(text), CHANGES[what]))
    place = "recipe" if "recipe" in what or "steps" in what or what in plain else "walk 0"
    with pytest.raises(DataError, match=rf"tuning\.json, {place}.*remedy.*delete it and run.*run_tuning"):
        walks.load(path, LITTLE)
    path.unlink()
    assert walks.load(path, LITTLE) == {}  # the remedy is one


def test_the_record_is_of_the_recipe_that_command_and_notebook_have():
    """Budgets of the notebook, read from its cell, are those of the record; every walk is on it, and ended."""
    cells = {c["id"]: "".join(c["source"]) for c in json.loads((NOTEBOOKS / "07_decoupled.ipynb").read_text())["cells"]}
    said = {}
    exec(cells["c01"], said)
    b, recipe = said["BUDGETS"]["full"], run_tuning.RECIPE
    assert recipe.seed == said["SEED"] + 1 and recipe.clips == b["practice"]
    assert all(
        getattr(recipe, n) == b[n]
        for n in ("frames", "short", "long", "schedule", "search", "fixed", "rounds", "steps")
    )
    found = walks.load(RECORD, recipe)
    assert set(found) == set(walks.searches(recipe))
    assert f'"{run_tuning.RECIPE.scene}"' in cells["c02"]


def test_on_record_every_chosen_setting_is_the_best_of_its_neighbours():
    found = walks.load(RECORD, run_tuning.RECIPE)
    for key, search in walks.searches(run_tuning.RECIPE).items():
        choice = found[key]
        tried = {tuple(row[n] for n in search.begin): row[search.measure] for row in choice.rows}
        around = [tuple(s[n] for n in search.begin) for s in search.neighbours(choice.setting)]
        assert choice.ended and len(around) == 2 * len(search.begin), key
        chosen = tried[tuple(choice.setting[n] for n in search.begin)]
        assert chosen == tuning.least(choice, search.measure) and all(tried[s] >= chosen for s in around), key
        assert all(tuple(s[n] for n in search.begin) in tried for s in (search.begin, *search.also)), key
