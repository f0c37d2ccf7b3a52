import math
from dataclasses import replace

import pytest
import torch

from motionlab import metrics
from motionlab.errors import DataError
from suite import findings, staleness
from suite.findings import FAILS, HOLDS, UNJUDGED, Criterion, Finding, Record
from tests.draws import seeded
from tests.test_staleness import ledger


def criterion(relation=">=", bound=1.0, **kw):
    return Criterion("H00.x", "a definition", "mm", relation, bound, "nothing", **kw)


def finding(verdict, source="synthetic", test="H00.x"):
    return Finding(test, source, 1.0, 0.5, 1.5, 9, "mm", "mean", ">= 1 mm", verdict, "00", "full")


@pytest.mark.parametrize(
    ("relation", "low", "high", "expected"),
    [
        (">=", 1.0, 2.0, HOLDS),
        (">=", 0.9, 2.0, UNJUDGED),  # the interval crosses the bound: not enough evidence either way
        (">=", 0.0, 0.9, FAILS),
        ("<=", 0.0, 1.0, HOLDS),
        ("<=", 1.1, 2.0, FAILS),
        (">=", math.nan, 2.0, UNJUDGED),
        ("to", 1.0, 1.5, HOLDS),
        ("to", 0.4, 0.9, FAILS),
        ("to", 1.4, 1.7, UNJUDGED),
        ("to", 1.6, 2.0, FAILS),
    ],
)
def test_the_whole_interval_must_meet_the_bound(relation, low, high, expected):
    band = [criterion(">=", 1.0, other=1.5), criterion("<=", 1.5, other=1.0)]  # two ends, either first
    assert {rule.bound_text() for rule in band} == {"1 to 1.5 mm"}
    for rule in band if relation == "to" else [criterion(relation)]:
        assert findings.judge(rule, low, high, n=30) == expected
        assert findings.judge(replace(rule, least=31), low, high, n=30) == UNJUDGED  # too few samples


def test_interval_covers_the_true_mean_as_often_as_it_says():
    generator = torch.Generator().manual_seed(0)
    trials, hits = 300, 0
    for _ in range(trials):
        _, low, high = metrics.interval(torch.randn(40, generator=generator) + 5.0, "mean", generator, draws=400)
        hits += low <= 5.0 <= high
    # percentile bootstrap at n = 40 covers about 93-94 %; 300 trials have a standard error of 1.4 %
    assert 0.89 <= hits / trials <= 0.98
    same, again, other = (metrics.interval(torch.arange(9.0), "median", seeded(seed)) for seed in (3, 3, 4))
    assert same == again != other


def test_share_matches_the_published_wilson_interval():
    # Wilson 95 % interval of 0 of 20: [0, 0.161]; of 10 of 20: [0.299, 0.701] (Newcombe 1998, method 3)
    _, low, high = metrics.interval(torch.zeros(20), "share", torch.Generator())
    assert (low, round(high, 3)) == (0.0, 0.161)
    half = torch.cat((torch.zeros(10), torch.ones(10)))
    value, low, high = metrics.interval(half, "share", torch.Generator())
    assert (value, round(low, 3), round(high, 3)) == (0.5, 0.299, 0.701)


def test_record_round_trip(tmp_path):
    marks = {"a": staleness.mark(1 / 3), "none": staleness.mark(None), "n": staleness.Mark(8, 0)}
    more = {"torch": "2"}, marks, {}, {"weights": "1"}, {"cmu": "2"}
    record = Record("02_x", "abc", (finding(HOLDS), finding(FAILS, "cmu_amc")), *more)
    findings.save_record(tmp_path / "02.json", record)
    assert findings.load_record(tmp_path / "02.json") == record
    assert findings.load_results(tmp_path) == list(record.findings)
    assert not list(tmp_path.glob("*.part"))


def test_nothing_measured_is_json_and_comes_back_as_nan(tmp_path):
    nothing = replace(finding(UNJUDGED), value=math.nan, low=math.nan, high=math.nan, n=0)
    findings.save_record(tmp_path / "02.json", Record("02_x", "abc", (nothing, finding(HOLDS))))
    text = (tmp_path / "02.json").read_text()
    assert "NaN" not in text and text.count('"value": null') == 1
    back, other = findings.load_record(tmp_path / "02.json").findings
    assert all(math.isnan(x) for x in (back.value, back.low, back.high)) and other == finding(HOLDS)


WHOLE = '{"notebook": "x", "source_hash": "", "findings": [], "fingerprint": {"n": [8, 0%s]}}'


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"findings": [{"test": 1}]}', '{"notebook": "x"', WHOLE % ", 1"])
def test_a_broken_record_names_the_file(tmp_path, text):
    (tmp_path / "02.json").write_text(WHOLE % "")  # control
    assert findings.load_record(tmp_path / "02.json").fingerprint["n"].value == 8
    (tmp_path / "02.json").write_text(text)
    with pytest.raises(DataError, match=r"02\.json"):
        findings.load_record(tmp_path / "02.json")


CLAIM, WHOLE_CLAIM = ledger(), ledger(x="")


@pytest.mark.parametrize(
    "text",
    [
        "[[claim",
        CLAIM + CLAIM,
        CLAIM.replace("title", "headline"),
        WHOLE_CLAIM.replace("<=", "<"),
        WHOLE_CLAIM.replace('unit = "m"\n', ""),
        ledger(x='role = "jury"'),
        WHOLE_CLAIM.replace("[claim.test", 'carriers = ["y"]\n[claim.test'),
    ],
    ids=["not TOML", "id twice", "unknown field", "unknown relation", "no unit", "unknown role", "unknown carrier"],
)
def test_a_broken_ledger_names_the_file(tmp_path, text):
    (tmp_path / "claims.toml").write_text(text)
    with pytest.raises(DataError, match=r"claims\.toml"):
        findings.load_claims(tmp_path / "claims.toml")
