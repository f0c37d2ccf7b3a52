import matplotlib.pyplot as plt
import pytest
import torch

from motionlab.errors import DataError
from suite import findings, notebook
from suite.findings import FAILS, HOLDS, UNJUDGED
from tests.test_staleness import ledger, write_cells

LEDGER = ledger(quick="", slow='needs = ["full"]').replace("<=", ">=")
BUDGETS = {"smoke": {"clips": 2}, "full": {"clips": 20}}


@pytest.fixture
def bench(tmp_path, monkeypatch):
    (tmp_path / "claims.toml").write_text(LEDGER)
    write_cells(tmp_path, ["x = 1"])
    monkeypatch.chdir(tmp_path)
    for name in ("MOTIONLAB_PROFILE", "MOTIONLAB_DATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MOTIONLAB_RESULTS", str(tmp_path / "results"))
    return lambda profile, **how: notebook.setup("02_x", profile=profile, budgets=BUDGETS, **{"seed": 0} | how)


def verdict_of(lab):
    return {(f.test, f.source): f.verdict for f in lab.settled()}


def test_profile_comes_from_argument_then_environment_then_full(bench, monkeypatch):
    assert bench(None).profile == "full"
    monkeypatch.setenv("MOTIONLAB_PROFILE", "smoke")
    assert bench(None).budget.clips == 2
    assert bench("full").budget.clips == 20


@pytest.mark.parametrize("kw", [{"profile": "fast"}, {"profile": "smoke", "data": "no/such/folder"}])
def test_unknown_surroundings_are_refused(bench, kw):
    with pytest.raises(DataError):
        bench(**kw)


def test_generators_depend_on_seed_and_salt_only(bench):
    draw = lambda lab, salt: torch.rand(3, generator=lab.generator(salt)).tolist()  # noqa: E731
    assert draw(bench("smoke"), "a") == draw(bench("full"), "a")
    assert draw(bench("smoke"), "a") != draw(bench("smoke"), "b")
    assert draw(bench("smoke"), "a") != draw(bench("smoke", seed=1), "a")


def test_record_judges_against_the_ledger(bench):
    lab = bench("full")
    assert lab.record("H00.quick", [5.0, 6.0, 7.0], baseline=[0.0]).verdict == HOLDS
    assert lab.record("H00.quick", [0.1, 0.2, 0.3]).verdict == FAILS  # measuring again replaces
    empty = lab.record("H00.quick", [], statistic="share", baseline=[])
    assert empty.verdict == UNJUDGED and empty.baseline_value is None
    assert len(lab.found) == 1
    with pytest.raises(DataError, match=r"H00\.quick"):
        lab.record("H00.quik", [1.0])


def test_smoke_repeats_what_only_a_full_run_may_judge(bench, tmp_path):
    full = bench("full", data=str(tmp_path))
    full.record("H00.quick", [5.0, 5.0])
    full.record("H00.slow", [5.0, 5.0])
    full.record("H00.slow", [0.1, 0.1], source="cmu_amc")
    full.close()
    full.record("H00.quick", [5.0, 5.0], source="a body")  # measured without any recording
    full.close()
    smoke = bench("smoke")
    smoke.record("H00.quick", [0.1, 0.1], source="a body")
    smoke.record("H00.quick", [0.1, 0.1])  # fresh numbers decide where smoke may judge
    smoke.record("H00.slow", [0.1, 0.1])  # and do not where it may not
    assert verdict_of(smoke) == {
        ("H00.quick", "synthetic"): FAILS,
        ("H00.quick", "a body"): FAILS,
        ("H00.slow", "synthetic"): HOLDS,
        ("H00.slow", "cmu_amc"): FAILS,
    }


def test_a_full_run_without_recordings_keeps_what_was_measured_on_them(bench, tmp_path):
    first = bench("full", data=str(tmp_path))
    first.record("H00.quick", [5.0, 5.0], source="cmu_amc")
    first.record("H00.slow", [5.0, 5.0])
    first.close()
    second = bench("full")
    second.record("H00.quick", [5.0, 5.0])
    second.close()
    kept = {(f.test, f.source) for f in findings.load_results(tmp_path / "results")}
    assert kept == {("H00.quick", "synthetic"), ("H00.quick", "cmu_amc")}  # a synthetic row not measured again goes
    write_cells(tmp_path, ["x = 2"])  # other code did not measure the old rows
    third = bench("full")
    third.record("H00.quick", [5.0, 5.0])
    third.close()
    assert {f.source for f in findings.load_results(tmp_path / "results")} == {"synthetic"}


@pytest.mark.parametrize("profile", ["smoke", "full"])
def test_a_run_writes_no_results_unless_asked(bench, tmp_path, monkeypatch, profile):
    monkeypatch.delenv("MOTIONLAB_RESULTS")
    bench(profile).close()
    assert not (tmp_path / "results").exists()
    monkeypatch.setenv("MOTIONLAB_RESULTS", str(tmp_path / "elsewhere"))
    bench(profile).close()
    assert (tmp_path / "elsewhere" / "02.json").exists()


def test_tables_escape_what_would_break_them():
    text = notebook._markdown_table([{"a|b": "x|y\nz", "n": 0.123456}])
    assert text.splitlines()[2] == "| x\\|y z | 0.123 |"
    assert notebook._markdown_table([]) == "*(no rows)*"


def test_a_figure_is_shown_once(bench):
    bench("smoke").figure(plt.figure(), "02.1", "a plot")
    assert not plt.get_fignums()  # else the notebook shows it again
