"""Records of hours of search that notebooks 07 and 08 read: of the recipe that the code has, and refused if not."""

import json
from dataclasses import asdict, replace

import pytest
import torch

from motionlab.doctor import ROOT
from motionlab.errors import DataError
from motionlab.humor import stages
from motionlab.humor.shooting.feedback_solver import Plan
from motionlab.humor.testops import Schedule
from studies.nb07_decoupled import make_record as tuning_command
from studies.nb07_decoupled import tuning, tuning_record
from studies.nb08_fast import make_record as official_command
from studies.nb08_fast.official_schedule import in_full, load, table
from studies.official import unknowns as official_unknowns
from studies.official.rollout import rollout
from studies.shared.savings import exact_alignment

NOTEBOOKS = ROOT / "notebooks"
TUNING, OFFICIAL = (NOTEBOOKS / "results" / "long" / f"{name}.json" for name in ("tuning", "faithful"))


# --------------------------------------------------------------------------------------------- how 07's searches walked
def test_budgets_of_the_notebook_are_those_of_the_record_and_every_walk_ended():
    cells = {c["id"]: "".join(c["source"]) for c in json.loads((NOTEBOOKS / "07_decoupled.ipynb").read_text())["cells"]}
    said = {}
    exec(cells["c01"], said)
    b, recipe = said["BUDGETS"]["full"], tuning_command.RECIPE
    assert recipe.seed == said["SEED"] + 1 and recipe.clips == b["practice"] and f'"{recipe.scene}"' in cells["c02"]
    same = ("frames", "short", "long", "schedule", "search", "fixed", "rounds", "steps")
    assert all(getattr(recipe, n) == b[n] for n in same)
    assert set(tuning_record.load(TUNING, recipe)) == set(tuning_record.searches(recipe))


def test_every_chosen_setting_is_the_best_of_its_neighbours():
    found = tuning_record.load(TUNING, tuning_command.RECIPE)
    for key, search in tuning_record.searches(tuning_command.RECIPE).items():
        choice = found[key]
        tried = {tuple(row[n] for n in search.begin): row[search.measure] for row in choice.rows}
        around = [tuple(s[n] for n in search.begin) for s in search.neighbours(choice.setting)]
        assert choice.ended and len(around) == 2 * len(search.begin), key
        chosen = tried[tuple(choice.setting[n] for n in search.begin)]
        assert chosen == tuning.least(choice, search.measure) and all(tried[s] >= chosen for s in around), key
        assert all(tuple(s[n] for n in search.begin) in tried for s in (search.begin, *search.also)), key


def test_a_record_of_another_recipe_is_not_used(tmp_path):
    for other in ({"seed": 2}, {"search": 3}, {"steps": (1, 2, 3)}, {"scene": "sitting"}, {"prior": "another"}):
        assert tuning_record.load(TUNING, replace(tuning_command.RECIPE, **other)) == {}
    assert tuning_record.load(tmp_path / "none.json", tuning_command.RECIPE) == {}


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
def test_a_record_of_walks_that_is_none_is_refused(tmp_path, what):
    text = TUNING.read_text()
    record = json.loads(text)
    plain = {"half": text[: len(text) // 2], "empty": "", "a list": "[]"}
    if what in CHANGES:
        CHANGES[what](record)
    path = tmp_path / "tuning.json"
    path.write_text(plain.get(what, json.dumps(record)))
    place = "recipe" if "recipe" in what or "steps" in what or what in plain else "walk 0"
    with pytest.raises(DataError, match=rf"tuning\.json, {place}.*remedy.*delete it and run.*make_record"):
        tuning_record.load(path, tuning_command.RECIPE)
    path.unlink()
    assert tuning_record.load(path, tuning_command.RECIPE) == {}  # the remedy is one


# ---------------------------------------------------------------------------------------- the official schedule, in 08
def test_the_record_is_of_the_recipe_that_the_code_has_and_the_notebook_says_what_is_in_it():
    assert json.loads(OFFICIAL.read_text(encoding="utf-8"))["recipe"] == official_command.RECIPE
    assert not official_command.FULL.guesses
    rows = load(OFFICIAL)
    plan = json.loads(json.dumps(asdict(Plan())))
    assert (plan["least"], plan["race"], plan["damped"], plan["second"]) == (0, 0, [], True)  # later, and off
    assert all(plan | row["shooting"]["plan"] == plan for row in rows)
    assert [row["task"] for row in rows] == ["noisy joints", "low joints hidden", official_command.WALK]
    assert all(len(row["faithful"]["energy"]) == official_command.CLIPS for row in rows)
    notebook = next(NOTEBOOKS.glob("08*.ipynb")).read_text(encoding="utf-8")
    for line in table(rows).splitlines():
        assert json.dumps(line, ensure_ascii=False)[1:-1] in notebook
    assert "ends higher on all nine clips, and farther from the truth on all nine" in notebook
    times = [round(row["faithful"]["seconds"] / row["shooting"]["seconds"]) for row in rows]
    assert "{1}, {0} and {2} times shooting's seconds".format(*times) in notebook
    for what in ("energy", "error"):
        assert all(a > b for row in rows for a, b in zip(row["faithful"][what], row["shooting"][what], strict=True))


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"tasks": [{}]}', '{"tasks": [{"faithful": 1}]}',
                                  '{"tasks": [{"faithful": {"energy": []}, "shooting": {"energy": []}}]}'])  # fmt: skip
def test_a_record_of_another_kind_is_refused(tmp_path, text):
    path = tmp_path / "faithful.json"
    with pytest.raises(DataError, match=r"faithful\.json.*remedy"):
        load(path)
    path.write_text(text)
    with pytest.raises(DataError, match=r"faithful\.json.*remedy"):
        load(path)


def test_forms_differ_by_the_official_headings_error_and_by_nothing_else(monkeypatch):
    """Its acos turns a clip that faces ahead by as much as a thousandth, of which the roll-out makes what it can."""
    task = next(official_command.tasks(1, frames=18))
    unknown, closures = in_full(task, Schedule(steps=(1, 1, 3), refine=(1, 2), inner=3))
    assert unknown.orient.shape[-1] == 3 and closures == 3 * 3
    lean, official = task.energy(unknown), replace(task.problem, mode="official", form=official_unknowns.FAITHFUL)

    def off():
        with torch.no_grad():
            return (sum(stages.motion_terms(official, unknown).values()) / lean - 1).abs().max().item()

    assert 1e-5 < off() < 1e-2
    monkeypatch.setitem(rollout.__kwdefaults__, "align", exact_alignment)
    assert off() < 1e-5
