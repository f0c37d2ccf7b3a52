"""The record of hours of search that notebook 08 reads: of the recipe that the code has, and refused if not."""

import json
from dataclasses import asdict, replace

import torch

from motionlab.commands.doctor import ROOT
from motionlab.humor import stages
from motionlab.humor.shooting.feedback_solver import Plan
from motionlab.humor.testops import Schedule
from studies.nb08_fast import official_schedule
from studies.nb08_fast.official_schedule import in_full, load, table
from studies.shared import savings

NOTEBOOKS = ROOT / "notebooks"
OFFICIAL = NOTEBOOKS / "results" / "long" / "faithful.json"


# ---------------------------------------------------------------------------------------- the official schedule, in 08
def test_the_record_is_of_the_recipe_that_the_code_has_and_the_notebook_shows_it():
    assert json.loads(OFFICIAL.read_text(encoding="utf-8"))["recipe"] == official_schedule.RECIPE
    assert not official_schedule.FULL.guesses
    rows = load(OFFICIAL)
    plan = json.loads(json.dumps(asdict(Plan())))
    assert all(row["shooting"]["plan"] == plan for row in rows)
    assert [row["task"] for row in rows] == ["noisy joints", "low joints hidden", official_schedule.WALK]
    assert all(len(row["faithful"]["energy"]) == official_schedule.CLIPS for row in rows)
    notebook = next(NOTEBOOKS.glob("08*.ipynb")).read_text(encoding="utf-8")
    for row in table(rows):
        assert f"| {row['task']} | {row['clips']} | " in notebook and f" | {row['times']:.3g} | " in notebook


def test_forms_differ_by_the_official_headings_error_and_by_nothing_else(monkeypatch):
    """Its acos turns a clip that faces ahead by as much as a thousandth, of which the roll-out makes what it can."""
    task = next(official_schedule.tasks(1, frames=18))
    unknown, closures = in_full(task, Schedule(steps=(1, 1, 3), refine=(1, 2), inner=3))
    assert unknown.orient.shape[-1] == 3 and closures == 3 * 3
    how = {"mode": "official", "parametrisation": savings.OFFICIAL}
    lean, official = task.energy(unknown), replace(task.problem, **how)

    def off():
        with torch.no_grad():
            return (sum(stages.motion_terms(official, unknown).values()) / lean - 1).abs().max().item()

    assert 1e-5 < off() < 1e-2
    monkeypatch.setattr(savings, "alignment", savings.exact_alignment)
    assert off() < 1e-5
