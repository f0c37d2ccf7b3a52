"""The ledger, the notebooks and the records must agree: a finding is as old as the notebook that found it."""

import json
import re
from pathlib import Path

import pytest

from suite import findings, staleness

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
CLAIMS = findings.load_claims(NOTEBOOKS / "claims.toml")
RECORDS = sorted((NOTEBOOKS / "results").glob("*.json"))


@pytest.mark.parametrize("path", RECORDS, ids=lambda p: p.stem)
def test_record_belongs_to_the_code_and_its_verdicts_to_the_ledger(path):
    record, tests = findings.load_record(path), findings.all_tests(CLAIMS)
    code = staleness.code_hash(NOTEBOOKS / f"{record.notebook}.ipynb")
    assert record.source_hash == code, f"{record.notebook}: the code is newer than its record; run `make full`"
    assert record.provenance["profile"] == "full"
    for f in record.findings:
        rule = tests[f.test]
        assert f.bound == rule.bound_text(), f"{f.test}: the bound was changed after the measurement"
        assert f.verdict == findings.judge(rule, f.low, f.high, f.n), f.test
        assert CLAIMS[f.claim].notebook == staleness.number_of(f.notebook)


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("[0-9]*.ipynb")), ids=lambda p: p.stem)
def test_every_test_of_a_written_notebook_was_measured(path):
    due = {t.id for claim in CLAIMS.values() if claim.notebook == staleness.number_of(path.stem) for t in claim.tests}
    done = {f.test for f in findings.record_of(path).findings}
    assert due <= done, f"{path.stem}: not measured: {sorted(due - done)}"


_NUMBER = re.compile(r"(?<![\w.])\d+(?:[.,]\d+)*(?![\w-]*D\b)")


def typed_in(cells):
    """Numbers in what a notebook opens with, from its answer on, that no output prints."""
    text = "".join(cells[0]["source"])
    opening = text[text.index("**Answer.**") :].partition("**Run time.**")[0]
    outputs = [o.get("data", {}) for cell in cells for o in cell.get("outputs", [])]
    printed = " ".join("".join(data.get(kind, "")) for data in outputs for kind in ("text/markdown", "text/plain"))
    return sorted(set(_NUMBER.findall(opening)) - set(_NUMBER.findall(printed)))


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("[0-9]*.ipynb")), ids=lambda p: p.stem)
def test_numbers_of_an_opening_are_measured_below_it(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    if "**Answer.**" in "".join(cells[0]["source"]):
        assert not typed_in(cells)


def test_control_a_number_that_nothing_prints_is_found():
    cells = [{"source": ["**Answer.** 6D gives 4.5 cm of 30."]}]
    cells.append({"source": "", "outputs": [{"data": {"text/markdown": "30 people"}}]})
    assert typed_in(cells) == ["4.5"]
