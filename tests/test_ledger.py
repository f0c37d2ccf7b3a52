"""What findings say of a claim: the rule of the verdict on cases made by hand, and the answers of the real ledger."""

from dataclasses import replace

import pytest

from motionlab.errors import DataError
from suite import ledger
from suite.findings import FAILS, HOLDS, UNJUDGED, Claim, Criterion, Finding, load_results
from suite.ledger import CONDITION, CONFIRMED, CONSTRUCTION, OPEN, REFUTED, SILENT, UNDECIDED, VOID
from tests.test_claims import CLAIMS, NOTEBOOKS

FOUND = load_results(NOTEBOOKS / "results")
TEST = Criterion("X01.a", "size", "cm", ">=", 2.0, "a held pose")
ROW = Finding("X01.a", "synthetic", 4.0, 3.0, 5.0, 9, "cm", "mean", ">= 2 cm", HOLDS, "01", "full", baseline_value=1.0)


def claim(*tests, **more):
    return Claim("X01", "3", "Size", "it is 7 cm", "01", tests=tests or (TEST,), **more)


def rows(*verdicts, **more):
    return [replace(ROW, verdict=each, source=f"source {k}", **more) for k, each in enumerate(verdicts)]


CASES = {
    CONFIRMED: [[HOLDS, HOLDS]],
    REFUTED: [[FAILS, FAILS], [FAILS, FAILS, UNJUDGED]],
    CONDITION: [[HOLDS, FAILS]],
    OPEN: [[]],
    UNDECIDED: [[UNJUDGED], [HOLDS, UNJUDGED], [FAILS, UNJUDGED]],  # half is not most
}


@pytest.mark.parametrize("expected", CASES)
def test_the_verdict_is_that_of_the_claim_tests(expected):
    assert {ledger.verdict(claim(), rows(*verdicts)) for verdicts in CASES[expected]} == {expected}


def test_only_claim_tests_decide():
    others = [replace(TEST, id=f"X01.{role}", role=role) for role in ("apparatus", "beyond")]
    failed = [replace(ROW, test=each.id, verdict=FAILS) for each in others]
    assert [ledger.verdict(claim(TEST, *others), rows(*some) + failed) for some in ([HOLDS], [])] == [CONFIRMED, OPEN]
    built, tool = [replace(ROW, test="X01.apparatus")], claim(others[0])
    assert ledger.verdict(tool, built) == CONSTRUCTION != ledger.verdict(tool, failed[:1])


def test_a_bound_that_its_baseline_passes_says_nothing():
    passes = rows(HOLDS, baseline_value=2.1)
    assert ledger.weigh(claim(), passes)[0].says == SILENT and ledger.verdict(claim(), passes) == UNDECIDED
    at = rows(HOLDS, baseline_value=2.0)  # the bound: a paired difference, whose rival is named or decides nothing
    assert [ledger.verdict(claim(replace(TEST, rival=r)), at) for r in ("", "ridge")] == [UNDECIDED, CONFIRMED]
    assert ledger.verdict(claim(replace(TEST, reference=True)), passes) == CONFIRMED
    band = claim(replace(TEST, other=6.0))  # a baseline beyond the other end does not pass
    assert [ledger.verdict(band, rows(HOLDS, baseline_value=b)) for b in (5.0, 7.0)] == [UNDECIDED, CONFIRMED]


def test_where_a_control_fails_the_tests_beside_it_are_void():
    both = claim(TEST, replace(TEST, id="X01.c", role="control"))
    found = [*rows(HOLDS, HOLDS), replace(ROW, test="X01.c", source="source 0", verdict=FAILS)]
    assert [w.says for w in ledger.weigh(both, found)][:2] == [VOID, HOLDS]


def test_a_few_samples_decide_nothing_and_one_is_a_count():
    assert [ledger.verdict(claim(), rows(HOLDS, n=n)) for n in (1, 7, 8)] == [CONFIRMED, UNDECIDED, CONFIRMED]
    rounds = claim(replace(TEST, clock=True))
    assert [ledger.verdict(rounds, rows(HOLDS, n=n)) for n in (4, 5)] == [UNDECIDED, CONFIRMED]


def test_real_and_synthetic_apart_and_what_a_verdict_asks_for():
    found = [replace(ROW), replace(ROW, source="CMU, report people", verdict=FAILS)]
    assert ledger.apart(claim(), found) == {"synthetic": CONFIRMED, "real": REFUTED}
    assert ledger.spoken(claim(condition="they walk"), found) == "true when they walk"
    assert ledger.spoken(claim(needs="people"), rows(UNJUDGED)) == "undecided: needs people"


def test_carriers_refute_what_others_only_add_to():
    tests, found = (TEST, replace(TEST, id="X01.b")), [*rows(FAILS), replace(ROW, test="X01.b")]
    assert ledger.verdict(claim(*tests, carriers=("a",)), found) == REFUTED
    assert ledger.verdict(claim(*tests), found) == CONDITION


def test_an_answer_has_the_numbers_of_its_findings_and_no_others():
    said = "On stage 3, in 6D: {a.value:.1f} cm of 7, or {a[source 0].baseline:.0%}, n = {a.n}"
    assert ledger.answer(claim(answer=said), rows(HOLDS)) == "On stage 3, in 6D: 4.0 cm of 7, or 100%, n = 9"
    for wrong in ("{b.value}", "{a[cmu].value}", "{a.mode}", "4 cm", "{a.value:q}", "{a.high}"):
        with pytest.raises(DataError, match="answer of X01"):
            ledger.answer(claim(answer=wrong), rows(HOLDS, high=float("nan")))
    with pytest.raises(DataError, match="2 sources"):
        ledger.answer(claim(answer="{a.value}"), rows(HOLDS, FAILS))


@pytest.mark.parametrize("each", CLAIMS.values(), ids=CLAIMS)
def test_every_claim_is_answered_and_says_what_its_verdict_asks_for(each):
    said, (shown,) = ledger.verdict(each, FOUND), NOTEBOOKS.glob(f"{each.notebook}_*.ipynb")
    assert f"**Figure {each.figure}.**" in shown.read_text(encoding="utf-8")
    assert ledger.answer(each, FOUND) and bool(each.condition) == (said == CONDITION)
    assert bool(each.needs) == (said == UNDECIDED) and said != OPEN
