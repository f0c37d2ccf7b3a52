"""What notebook 08's prose counts on its batches, clip by clip: from the record of that run, which must be that run."""

import json

import numpy as np
import pytest

from motionlab.doctor import ROOT

NOTEBOOKS = ROOT / "notebooks"
RECORD = json.loads((NOTEBOOKS / "results" / "long" / "batches.json").read_text())["tasks"]
HIDDEN = RECORD["low joints hidden"]


def near(ends, best):
    best = np.array(best)
    return np.array(ends) - best <= 0.05 * np.abs(best)


@pytest.fixture(scope="module")
def prose():
    cells = json.loads((NOTEBOOKS / "08_fast_testops.ipynb").read_text())["cells"]
    return " ".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def test_the_record_is_of_the_run_that_the_results_are_of():
    found = {row["test"]: row for row in json.loads((NOTEBOOKS / "results" / "08.json").read_text())["findings"]}
    robust = np.concatenate([near(task["ends"]["shooting"], task["best"]) for task in RECORD.values()])
    assert robust.mean() == pytest.approx(found["H22.robust"]["value"]) and len(robust) == found["H22.robust"]["n"]
    arrived = near(RECORD["noisy joints"]["ends"]["single shooting"], RECORD["noisy joints"]["best"]).sum()
    assert f"single shooting arrived on {arrived} of 32 " in found["H22.batch"]["note"]


def test_lower_on_all_clips_but_one(prose):
    lower = [np.less(task["ends"]["shooting"], task["ends"]["single shooting"]) for task in RECORD.values()]
    assert f"lower on {np.sum(lower)} of {np.size(lower)} clips" in prose


def test_what_is_speed_and_not_leaps(prose):
    passes = [np.median([np.inf if s is None else s for s in task["passes"]]) for task in RECORD.values()]
    assert f"passes in {min(passes):.0f} to {max(passes):.0f} seconds where single shooting ends" in prose


def test_the_search_begun_at_the_truth_if_it_counted(prose):
    begun = HIDDEN["ends"]["shooting, begun at the truth"]
    lower = np.less(begun, HIDDEN["best"]).sum()
    assert f"ends lower than the best of all others on {lower} of these {len(begun)} clips" in prose
    ours = HIDDEN["ends"]["shooting"]
    count = [near(ours, best).sum() for best in (np.minimum(HIDDEN["best"], begun), HIDDEN["best"])]
    assert f"within 5 % on {count[0]} of them instead of {count[1]}" in prose


def test_it_is_not_the_other_foot(prose):
    feet = {who: np.array(share) for who, share in HIDDEN["true foot forward"].items()}
    ahead = feet["truth"] > 0
    other = [(feet[who][ahead] < 0.5).sum() for who in ("single shooting", "shooting")]
    assert other == [1, 1] and f"of the {ahead.sum()} clips that have one foot clearly ahead" in prose
    assert f"the truth itself has {100 * feet['truth'].mean():.0f} %" in prose
