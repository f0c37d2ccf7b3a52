"""A record goes stale when its code measures otherwise, and not when the code is moved, renamed or reworded."""

import json
import math
from dataclasses import replace

import pytest

from motionlab import checkpoint
from motionlab.files import source_hash
from suite import findings, notebook, staleness
from suite.staleness import Mark


def ledger(**tests: str) -> str:
    """A ledger of one claim and its tests; what else a test says, by its name."""
    head = '[[claim]]\nid = "H00"\nsection = "1"\ntitle = "t"\nthesis = "words"\nnotebook = "02"\n'
    same = 'definition = "d"\nunit = "m"\nrelation = "<="\nbound = 1.0\nbaseline = "b"\n'
    return head + "".join(f"[claim.test.{name}]\n{same}{more}\n" for name, more in tests.items())


CELLS = [
    "from suite.notebook import setup",
    "found = lengths()",
    "lab.record('H00.length', found, baseline=[1.0])\nlab.record('H00.time', [CLOCK])",
    "lab.fingerprint('longest', max(found))",
]


@pytest.fixture
def suite(tmp_path, monkeypatch):
    """A notebook that measures with a library whose ``step`` may change; run as the smoke run of `make test` is."""
    (tmp_path / "claims.toml").write_text(ledger(length="", time="clock = true"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MOTIONLAB_VERIFY", "1")
    for name in ("MOTIONLAB_PROFILE", "MOTIONLAB_DATA", "MOTIONLAB_RESULTS"):
        monkeypatch.delenv(name, raising=False)
    write_cells(tmp_path, CELLS)

    def run(profile="smoke", cells=CELLS, clock=1.0, step=0.5):
        lab = notebook.setup("02_x", profile=profile, seed=0, budgets={"smoke": {}, "full": {}})
        exec("\n".join(cells), {"lab": lab, "CLOCK": clock, "lengths": lambda: [step * k for k in range(6)]})
        lab.close()
        return lab

    return run


def write_cells(folder, cells):
    book = {"cells": [{"cell_type": "code", "source": [cell], "outputs": []} for cell in cells]}
    (folder / "02_x.ipynb").write_text(json.dumps(book))


def stamped(run, folder, monkeypatch):
    """The record of a full run with the fingerprint of a smoke run."""
    with monkeypatch.context() as patch:
        patch.delenv("MOTIONLAB_VERIFY")
        for name, profile in (("results", "full"), ("smoke", "smoke")):
            patch.setenv("MOTIONLAB_RESULTS", str(folder / name))
            run(profile)
    path = folder / "results/02.json"
    record, smoke = findings.load_record(path), findings.load_record(folder / "smoke/02.json")
    findings.save_record(path, replace(record, fingerprint=smoke.fingerprint))
    return path


def test_control_the_same_code_is_not_stale(suite, tmp_path, monkeypatch):
    stamped(suite, tmp_path, monkeypatch)
    assert suite(clock=99.0).stale() == []  # what the clock decides is no part of it


def test_a_changed_constant_of_the_library_makes_the_record_stale(suite, tmp_path, monkeypatch):
    path = stamped(suite, tmp_path, monkeypatch)
    before = path.read_bytes()
    with pytest.raises(staleness.StaleRecord) as caught:
        suite(step=0.51)
    text = str(caught.value)
    assert "H00.length was 1.25, is 1.275" in text and "longest was 2.5, is 2.55" in text and "H00.time" not in text
    assert "make full NOTEBOOKS=02 (1 min when last run)" in text
    assert path.read_bytes() == before


def test_a_test_that_is_not_measured_any_more_makes_it_stale(suite, tmp_path, monkeypatch):
    stamped(suite, tmp_path, monkeypatch)
    with pytest.raises(staleness.StaleRecord, match="longest is not measured any more"):
        suite(cells=CELLS[:3])


def test_moving_renaming_and_rewording_do_not(suite, tmp_path, monkeypatch):
    path = stamped(suite, tmp_path, monkeypatch)
    cells = [CELLS[0].replace("setup", "setup as begin"), *CELLS[1:]]
    write_cells(tmp_path, cells)
    suite(cells=cells)
    code = findings.load_record(path).source_hash
    assert code == staleness.code_hash(tmp_path / "02_x.ipynb")
    write_cells(tmp_path, [*cells[:3], cells[3].replace("max", "min")])  # control
    assert code != staleness.code_hash(tmp_path / "02_x.ipynb")


def test_a_record_without_fingerprint_says_how_to_take_it(suite, tmp_path, monkeypatch):
    monkeypatch.setenv("MOTIONLAB_RESULTS", str(tmp_path / "results"))
    suite("full")
    monkeypatch.delenv("MOTIONLAB_RESULTS")
    with pytest.raises(staleness.StaleRecord, match="regenerate --fingerprints 02"):
        suite()


def test_outside_of_make_test_a_difference_is_only_said(suite, tmp_path, monkeypatch, capsys):
    stamped(suite, tmp_path, monkeypatch)
    monkeypatch.delenv("MOTIONLAB_VERIFY")
    assert suite(cells=[*CELLS[:3], "lab.fingerprint('longest', 9.0)"]).stale() == [
        "longest was 2.5, is 9 (may differ by 0.009)"
    ]


# ---------------------------------------------------------------------------------------------------------- the marks
def test_marks_agree_within_the_size_of_the_number_or_of_its_bound():
    assert staleness.mark(1.0).agrees(staleness.mark(1.0009))
    assert not staleness.mark(1.0).agrees(staleness.mark(1.002))
    assert staleness.mark(1e-15, scale=1e-10).agrees(staleness.mark(5e-15, scale=1e-10))  # rounding, beside its bound
    assert staleness.mark(1e-15).agrees(staleness.mark(5e-15))  # rounding by itself
    assert not staleness.mark(1e-5).agrees(staleness.mark(2e-5))
    assert staleness.mark(math.nan).agrees(staleness.mark(None)) and not staleness.mark(None).agrees(Mark(0.0, 1.0))


def test_runs_under_other_arithmetic_say_how_far_rounding_moves_a_number():
    first = {"steady": staleness.mark(1.0), "rough": staleness.mark(2.0), "chaotic": staleness.mark(3.0)}
    second = {"steady": staleness.mark(1.0), "rough": staleness.mark(2.02), "chaotic": staleness.mark(5.0)}
    found, unsteady = staleness.merged([first, second])
    assert unsteady == ["chaotic"] and found["steady"] == first["steady"]
    assert found["rough"].value == 2.0 and found["rough"].within == pytest.approx(0.1)
    assert staleness.merged([first, {"steady": first["steady"]}])[1] == ["rough", "chaotic"]


def test_recordings_decide_what_must_be_measured_again():
    marks = {"walks": staleness.mark(1.0), "mixed": staleness.mark(2.0)}
    on_cmu = {"mixed": staleness.mark(3.0), "cmu": staleness.mark(4.0)}
    record = findings.Record("02", "x", (), {}, marks, on_cmu, recordings={"cmu_amc": "a"})
    assert record.expected({}) == marks
    assert record.expected({"cmu_amc": "a", "more": "b"}) == marks | on_cmu
    assert record.expected({"cmu_amc": "other"}) == {"walks": marks["walks"]}


# ------------------------------------------------------------------------------------------------ hashes of the code
LIBRARY = 'STEP = 0.5\n\n\ndef of_walks():\n    """Six lengths."""\n    return [STEP * k for k in range(6)]\n'


@pytest.mark.parametrize(
    ("other", "same"),
    [
        (LIBRARY.replace("Six lengths", "Half a dozen"), True),
        (LIBRARY.replace("\n\n\n", "\n  # a comment\n\n\n"), True),
        ("import math\n" + LIBRARY, True),
        (LIBRARY.replace("0.5", "0.25"), False),
    ],
)
def test_documentation_and_layout_are_no_part_of_the_hash_of_a_module(other, same):
    assert (source_hash(other) == source_hash(LIBRARY)) is same


def test_lists_of_recordings_are_told_apart_by_source(tmp_path):
    assert staleness.recordings_digest(None) == {}
    (tmp_path / "cmu_amc").mkdir()
    (tmp_path / "cmu_amc/a.amc").write_text("1")
    first = staleness.recordings_digest(tmp_path)
    (tmp_path / "mine").mkdir()
    assert staleness.recordings_digest(tmp_path)["cmu_amc"] == first["cmu_amc"]
    (tmp_path / "cmu_amc/b.amc").write_text("1")
    assert staleness.recordings_digest(tmp_path)["cmu_amc"] != first["cmu_amc"]


def test_weights_are_part_of_it(suite, tmp_path, monkeypatch):
    path = stamped(suite, tmp_path, monkeypatch)
    record = findings.load_record(path)
    findings.save_record(path, replace(record, weights={"humor_real": "0" * 12}))
    monkeypatch.setattr(checkpoint, "_LOADED", {"humor_real": "1" * 12})
    with pytest.raises(staleness.StaleRecord, match="humor_real are other weights"):
        suite()
