"""The record of hours of search that notebook 08 reads: of the recipe that the code has, and refused if not."""

import json
from dataclasses import asdict, replace

import pytest
import torch

from motionlab.doctor import ROOT
from motionlab.errors import DataError
from motionlab.humor import stages
from motionlab.humor.shooting.feedback_solver import Plan
from motionlab.humor.testops import Schedule
from studies.nb08_fast import make_record as official_command
from studies.nb08_fast.official_schedule import in_full, load, table
from studies.official import unknowns as official_unknowns
from studies.official.rollout import rollout
from studies.shared.savings import exact_alignment

NOTEBOOKS = ROOT / "notebooks"
OFFICIAL = NOTEBOOKS / "results" / "long" / "faithful.json"


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
