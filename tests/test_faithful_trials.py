"""The faithful schedule beside shooting, in little; and its record."""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest
import torch

from motionlab import run_faithful
from motionlab.doctor import ROOT
from motionlab.errors import DataError
from motionlab.humor import faithful_trials, stages
from motionlab.humor.faithful import rollout
from motionlab.humor.faithful_trials import compared, in_full, load, table
from motionlab.humor.ladder import exact_alignment
from motionlab.humor.shooting import Plan
from motionlab.humor.testops import Schedule

FEW = Schedule(steps=(1, 1, 3), refine=(1, 2), inner=3)
PLAN = Plan(rounds=2, closures=8, trial=1)
RECORD = ROOT / "notebooks" / "results" / "long" / "faithful.json"


@pytest.fixture(scope="module")
def task():
    return next(run_faithful.tasks(1, frames=18))


def test_the_faithful_form_lowers_the_energy_that_all_solvers_lower(task):
    """From the same stage 2, in rotation vectors."""
    unknown, closures = in_full(task, FEW)
    assert unknown["orient"].shape[-1] == 3 and closures == 3 * 3
    more, _ = in_full(task, Schedule(steps=(1, 1, 6), refine=(1, 2), inner=3))
    begun, _ = in_full(task, Schedule(steps=(1, 1, 1), refine=(0, 0), inner=1))
    assert task.energy(more) < task.energy(unknown) < task.energy(begun)


def test_both_are_measured_on_the_same_clips(task):
    row = compared(task, FEW, PLAN)
    assert row["task"] == "noisy joints" and row["shooting"]["energy"][0] < row["faithful"]["energy"][0]
    assert row["start"]["error"] == pytest.approx(task.error(task.rough).tolist(), abs=1e-3)
    assert all(len(row[who]["energy"]) == len(row[who]["error"]) == 1 for who in ("faithful", "shooting", "start"))


def test_forms_differ_by_the_official_headings_error_and_by_nothing_else(task, monkeypatch):
    """Its acos turns a clip that faces ahead by as much as a thousandth, of which the roll-out makes what it can."""
    unknown, _ = in_full(task, FEW)
    lean, faithful = task.energy(unknown), replace(task.problem, mode="faithful")

    def off():
        with torch.no_grad():
            return (sum(stages.motion_terms(faithful, unknown).values()) / lean - 1).abs().max().item()

    assert 1e-5 < off() < 1e-2
    monkeypatch.setitem(rollout.__kwdefaults__, "align", exact_alignment)
    assert off() < 1e-5


def test_a_faithful_fit_is_not_run_again_where_it_began_alike(task, tmp_path, monkeypatch):
    """A record of the same recipe gives its faithful part; one of another start or schedule does not."""
    first = compared(task, FEW, PLAN)
    monkeypatch.setattr(faithful_trials, "in_full", None)  # not to be called
    again = compared(task, FEW, replace(PLAN, rounds=1), before=first)
    assert again["faithful"] == first["faithful"]
    assert again["shooting"]["energy"] != first["shooting"]["energy"]
    with pytest.raises(TypeError):
        compared(task, FEW, PLAN, before={**first, "start": {**first["start"], "energy": [0.0]}})
    path = tmp_path / "faithful.json"
    for recipe, known in ((run_faithful.RECIPE, ["noisy joints"]), (run_faithful.RECIPE | {"clips": 1}, [])):
        path.write_text(json.dumps({"recipe": recipe, "tasks": [first]}))
        assert list(run_faithful.earlier(path)) == known
    assert run_faithful.earlier(tmp_path / "none.json") == {}


def test_a_run_replaces_rows_one_by_one_and_keeps_those_that_it_has_not_reached(tmp_path, monkeypatch):
    """So that a run that is stopped loses no faithful fit."""
    path = tmp_path / "faithful.json"
    ends = {"energy": [1.0], "error": [1.0], "seconds": 1.0, "closures": 1}
    old = [{"task": name, "faithful": ends, "shooting": ends, "start": ends} for name in ("a", "b")]
    path.write_text(json.dumps({"recipe": run_faithful.RECIPE, "tasks": old}))

    def stopped(task, *_, before, **__):
        if task.name == "b":
            raise KeyboardInterrupt
        return before | {"shooting": ends | {"energy": [0.5]}}

    monkeypatch.setattr(run_faithful, "compared", stopped)
    monkeypatch.setattr(run_faithful, "tasks", lambda: [SimpleNamespace(name=n) for n in ("a", "b")])
    with pytest.raises(KeyboardInterrupt):
        run_faithful.main(path)
    assert [(row["task"], row["shooting"]["energy"]) for row in load(path)] == [("a", [0.5]), ("b", [1.0])]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"tasks": [{}]}',
        '{"tasks": [{"faithful": 1}]}',
        '{"tasks": [{"faithful": {"energy": []}, "shooting": {"energy": []}}]}',
    ],
)
def test_a_record_of_another_kind_is_refused(tmp_path, text):
    path = tmp_path / "faithful.json"
    with pytest.raises(DataError, match=r"faithful\.json.*remedy"):
        load(path)
    path.write_text(text)
    with pytest.raises(DataError, match=r"faithful\.json.*remedy"):
        load(path)


def test_the_record_is_of_the_recipe_that_the_code_has():
    assert json.loads(RECORD.read_text(encoding="utf-8"))["recipe"] == run_faithful.RECIPE
    rows = load(RECORD)
    assert all(row["shooting"]["plan"] == asdict(Plan()) for row in rows)
    assert [row["task"] for row in rows] == ["noisy joints", "low joints hidden", run_faithful.WALK]
    assert all(len(row["faithful"]["energy"]) == run_faithful.CLIPS for row in rows)
    notebook = next((ROOT / "notebooks").glob("08*.ipynb")).read_text(encoding="utf-8")
    for line in table(rows).splitlines():
        assert json.dumps(line, ensure_ascii=False)[1:-1] in notebook
    assert "ends higher on all nine clips, and farther from the truth on all nine" in notebook
    times = [round(row["faithful"]["seconds"] / row["shooting"]["seconds"]) for row in rows]
    assert "{1}, {0} and {2} times shooting's seconds".format(*times) in notebook
    for what in ("energy", "error"):
        assert all(a > b for row in rows for a, b in zip(row["faithful"][what], row["shooting"][what], strict=True))


def test_a_command_without_a_path_says_what_it_wants(capsys):
    with pytest.raises(SystemExit) as stop:
        run_faithful.command([])
    assert stop.value.code == 2 and "record" in capsys.readouterr().err
