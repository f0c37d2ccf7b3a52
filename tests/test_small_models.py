"""Small models that differ in one thing: what decides an arm, who it learns from, and measures that tell feet apart."""

import json
from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.bench.person_windows import PersonWindows
from motionlab.diffusion.windows import gather, on_standard
from motionlab.skeleton import STANDARD
from studies.shared import small_measures, small_models
from studies.shared.small_models import SETS, Arm


@pytest.fixture(scope="module")
def walks():
    """Three "people" who walk, the last of them synthetic, and windows (16, 60) of the first."""
    motions = [on_standard(perform_sequence(Corpus(seconds=20.0, seed=seed), 0).motion) for seed in (3, 4, 5)]
    windows = gather(motions, 60, people=["a", "b", "synthetic"])
    return windows, replace(gather(motions[:1], 60, mirrored=False).evenly(16), skeleton=STANDARD)


@pytest.fixture
def data(walks, tmp_path, monkeypatch):
    """What arms learn from and are measured on; their weights and rows go to a folder of the test."""
    windows, clips = walks
    monkeypatch.setattr(small_models, "folder", lambda: tmp_path)
    monkeypatch.setattr(small_models, "RECORDS", tmp_path)
    whose = torch.arange(16) % 2
    held = PersonWindows(clips, whose, torch.zeros(16, 1, len(STANDARD) + 2, dtype=torch.bool))
    return small_models._Data(windows, clips, held)


def tiny(**more):
    return Arm("tiny", replace(small_models.BASE, size="small", steps=4, batch=4, warm_up=1), **more)


def test_an_arm_is_what_decides_its_weights_and_sets_share_them():
    assert {arm.digest for arm in SETS["frames"] if arm.name == "stuck"} == {
        arm.digest for arm in SETS["losses"] if arm.name == "all"
    }
    assert len({arm.digest for arm in SETS["frames"]}) == len(SETS["frames"])
    for name, arms in SETS.items():
        pairs = [(arm.name, arm.recipe.seed) for arm in arms]
        assert len(set(pairs)) == len(pairs), name
        seeds = {arm.name: [a.recipe.seed for a in arms if a.name == arm.name] for arm in arms}
        assert len({tuple(s) for s in seeds.values()}) == 1, f"{name}: arms are not paired by seed"


def test_fewer_people_are_among_more_and_none_is_synthetic(walks):
    windows, _ = walks
    whose = [
        set(windows.people[windows.clip[small_models._of_people(windows, n, 1).begins]].tolist()) for n in (1, 2, 60)
    ]
    assert whose[0] < whose[1] == whose[2] == {0, 1}


def test_an_arm_is_trained_once_and_read_after_that(data, monkeypatch):
    first = small_models.trained(tiny(), data)["tiny"]
    monkeypatch.setattr(small_models, "DenoiserTraining", None)  # nobody may train now
    again = small_models.trained(tiny(), data)["tiny"]
    assert all(torch.equal(x, again.denoiser.state_dict()[k]) for k, x in first.denoiser.state_dict().items())
    assert not list(small_models.folder().glob("*.partial.pt"))


def test_who_stops_keeps_the_best_and_the_last(data, monkeypatch):
    monkeypatch.setattr(small_models, "_JUDGEMENTS", 4)
    monkeypatch.setattr(small_models, "_KEEP", 1)
    errors = iter([0.3, 0.1, 0.2, 0.4])
    monkeypatch.setattr(small_models, "_judge", lambda choose: lambda model: {"x0 error": next(errors)})
    found = small_models.trained(tiny(stops=True, people=1), data)
    assert list(found) == ["tiny, best", "tiny, last"]
    best, last = (model.denoiser.output_process.poseFinal.weight for model in found.values())
    assert not torch.equal(best, last)
    files = sorted(small_models.folder().glob("*.json"))
    assert {json.loads(file.read_text())["best"] for file in files} == {2}


def test_rows_are_kept_as_arms_end_and_not_measured_twice(data, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(small_models, "_data", lambda folder: data)
    monkeypatch.setitem(SETS, "two", [tiny(), replace(tiny(), name="other", recipe=replace(tiny().recipe, seed=1))])
    row = {"estimates": {"x0 error": {"0.4": [0.5]}}, "samples": {"slide": 1.0}}
    monkeypatch.setattr(small_measures, "measured", lambda model, held: row)
    monkeypatch.setattr(small_measures, "plateau", lambda held: {small_measures.PLAIN: {}})
    small_models.run("two", tmp_path, seeds=1)
    assert [row["arm"] for row in small_models.record("two")["rows"]] == ["tiny"]
    small_models.run("two", tmp_path)
    rows = small_models.record("two")["rows"]
    assert [(row["arm"], row["seed"]) for row in rows] == [("tiny", 0), ("other", 1)]
    assert capsys.readouterr().out.count("two: tiny") == 1
    assert small_models.by_seed(rows, "tiny", "slide").tolist() == [1.0]
    assert [row["seed"] for row in small_models.paired("two", ["tiny"])] == [0]
    assert small_models.paired("two", ["tiny", "other"]) == small_models.paired("none", ["tiny"]) == []  # no seed twice


def test_estimates_have_a_number_a_level_and_a_person(data):
    model = small_models.trained(tiny(), data)["tiny"]
    found = small_measures._estimates(model, data.report)
    rows = [{"arm": "tiny", "seed": 0, "estimates": found}]
    for measure in found:
        assert small_models.estimates_by_seed(rows, "tiny", measure).shape == (1, 5, 2), measure
    assert sum(found["x0 error"]["0.8"]) / 2 == pytest.approx(
        model.errors(data.report.motion, torch.Generator().manual_seed(0))["x0 error at t = 799"], rel=1e-3
    )


def test_feet_stand_in_walking_and_slide_where_roots_are_others(walks):
    _, clips = walks
    mixed = small_measures.with_others_roots(clips, torch.Generator().manual_seed(0))
    assert small_measures.skating(clips).mean() < 0.1
    assert small_measures.skating(mixed).mean() > 0.2 + small_measures.skating(clips).mean()
    assert small_measures.driven(clips).nanmean() > 0.9
    assert small_measures.slide_mm(mixed).nanmean() > 2 * small_measures.slide_mm(clips).nanmean()
    still = replace(clips, root=clips.root[:, :1].expand_as(clips.root))
    assert small_measures.driven(still).isnan().all()  # who goes nowhere has none
    assert small_measures.travel(still).max() == 0
