"""The command line, the doctor, and the report of a run."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from unittest.mock import Mock

import nbformat
import pytest
import torch

from motionlab import __main__
from motionlab.animate import filling, rewriting
from motionlab.commands import doctor, options
from motionlab.commands.doctor import Check
from motionlab.errors import DataError, MissingData
from motionlab.io import bvh, judging, load
from motionlab.skeleton import STANDARD
from motionlab.training import courses
from suite import __main__ as suite_main
from suite import execute, findings, pages, report, staleness
from tests.figures import standing
from tests.test_staleness import ledger


def write_notebook(path, *sources):
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    cells = [nbformat.v4.new_code_cell(source) for source in sources]
    nbformat.write(nbformat.v4.new_notebook(metadata=kernel, cells=cells), path)


@pytest.fixture
def suite(tmp_path, monkeypatch):
    """A suite of two notebooks, the first of which fails, with a ledger and one recorded finding."""
    folder = tmp_path / "notebooks"
    (folder / "results").mkdir(parents=True)
    write_notebook(folder / "00_fails.ipynb", "x = 1", "1 / 0", "print('never')")
    write_notebook(folder / "01_runs.ipynb", "import os", "print(os.environ['MOTIONLAB_PROFILE'], os.getcwd())")
    (folder / "claims.toml").write_text(LEDGER, encoding="utf-8")
    measured = "X01.size", "synthetic", 4.0, 3.0, 5.0, 9, "cm", "mean", ">= 2 cm", "holds"
    finding = findings.Finding(*measured, "01_runs", "full")
    findings.save_record(folder / "results" / "01.json", findings.Record("01_runs", "", (finding,)))
    monkeypatch.setattr(execute, "NOTEBOOKS", folder)
    return folder


LEDGER = ledger(size="").replace("H00", "X01").replace('"02"', '"01"').replace('"t"', '"Size <matters>"')
LEDGER += ledger().replace("H00", "X02")


def test_report_runs_every_notebook_and_says_which_failed(suite, tmp_path, capsys):
    before = dict(os.environ)
    runs = report.write_report(tmp_path / "report", "smoke")
    assert [(run.notebook, run.status) for run in runs] == [("00_fails", "failed at cell 2"), ("01_runs", "ran")]
    assert "ZeroDivisionError" in runs[0].error and "00_fails: Run today" in capsys.readouterr().out
    index = (tmp_path / "report/index.html").read_text(encoding="utf-8")
    assert 'href="01_runs.html"' in index and "Size &lt;matters&gt;" in index and "not measured yet" in index
    page = (tmp_path / "report/00_fails.html").read_text(encoding="utf-8")
    assert "failed at cell 2" in page and "ZeroDivisionError: division by zero" in page
    page = (tmp_path / "report/01_runs.html").read_text(encoding="utf-8")
    assert "no numbers are on record" in page and f"smoke {suite}" not in page  # what a short run shows stays out
    assert dict(os.environ) == before


def test_a_full_run_shows_its_own_notebooks_where_they_ran_to_their_end(suite, tmp_path, capsys):
    assert suite_main.main(["report", "--profile", "full", "--out", str(tmp_path / "report")]) == 1
    assert "1 of 2 notebooks ran; report: " in capsys.readouterr().out
    pages = {name: (tmp_path / f"report/{name}.html").read_text(encoding="utf-8") for name in ("00_fails", "01_runs")}
    assert f"full {suite}" in pages["01_runs"] and "Run in full today" in pages["01_runs"]
    assert "failed at cell 2" in pages["00_fails"] and "Traceback" not in pages["00_fails"]


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        ({"X01.size": 4.001, "X01.size: n": 9.0}, "1 finding agrees"),
        ({"X01.size": 5.0, "X01.size: n": 9.0}, "1 of 2 numbers differ from the record"),
        ({}, "2 of 2 numbers differ from the record"),
    ],
)
def test_a_page_says_whether_todays_numbers_are_those_on_record(suite, tmp_path, measured, said):
    record = findings.load_record(suite / "results/01.json")
    marks = {"X01.size": staleness.mark(4.0), "X01.size: n": staleness.Mark(9.0, 0.0)}
    findings.save_record(suite / "results/01.json", replace(record, fingerprint=marks))
    now = {name: staleness.mark(value) for name, value in measured.items()}
    findings.save_record(tmp_path / "out/today/results/01.json", replace(record, findings=(), fingerprint=now))
    report.build(tmp_path / "out", [execute.Run("01_runs")])
    page = (tmp_path / "out/01_runs.html").read_text(encoding="utf-8")
    assert said in page and ("X01.size was 4, is 5" in page) == (measured.get("X01.size") == 5.0)
    assert "Not checked today" in (tmp_path / "out/00_fails.html").read_text(encoding="utf-8")


def test_regenerate_writes_what_ran_and_keeps_what_failed(suite, monkeypatch):
    failed_before = (suite / "00_fails.ipynb").read_bytes()
    taken = []
    take = lambda path, again: taken.append(path.stem) or execute.Run(path.stem)  # noqa: E731
    monkeypatch.setattr(execute, "take_fingerprint", take)
    runs = execute.regenerate()
    assert [run.status for run in runs] == ["failed at cell 2", "ran"] and taken == ["01_runs"]
    assert (suite / "00_fails.ipynb").read_bytes() == failed_before
    first = (suite / "01_runs.ipynb").read_bytes()
    book = json.loads(first)
    assert [cell["execution_count"] for cell in book["cells"]] == [1, 2]
    assert book["cells"][1]["outputs"][0]["text"] == [f"full {suite}\n"]
    execute.regenerate(["01"])
    assert (suite / "01_runs.ipynb").read_bytes() == first


def test_a_fingerprint_is_not_replaced_by_another_unless_asked(suite, monkeypatch):
    path = suite / "01_runs.ipynb"
    marks = {"size": staleness.mark(4.0)}
    smoke = findings.Record("01_runs", "", (), {"seconds": "2"}, marks)
    monkeypatch.setattr(execute, "_measured", lambda path, data, others: [smoke, smoke])
    monkeypatch.delenv("MOTIONLAB_DATA", raising=False)
    before = findings.load_record(suite / "results/01.json")
    assert not execute.take_fingerprint(path).error
    record = findings.load_record(suite / "results/01.json")
    assert record.fingerprint == marks and record.findings == before.findings
    assert record.source_hash == staleness.code_hash(path) and record.provenance["smoke seconds"] == "2"
    smoke = replace(smoke, fingerprint={"size": staleness.mark(5.0)})
    assert "size was 4, is 5" in execute.take_fingerprint(path).error
    assert suite_main.main(["regenerate", "--fingerprints", "01"]) == 1
    assert suite_main.main(["regenerate", "--fingerprints", "--again", "01"]) == 0
    assert findings.load_record(suite / "results/01.json").fingerprint["size"].value == 5.0


def test_a_report_that_runs_nothing_or_is_interrupted_still_has_its_index(suite, tmp_path, monkeypatch):
    assert suite_main.main(["report", "--no-run", "--out", str(tmp_path / "pages")]) == 0
    monkeypatch.setattr(execute, "run_side_by_side", Mock(side_effect=KeyboardInterrupt))
    assert suite_main.main(["report", "--out", str(tmp_path / "report")]) == 130
    for folder in ("pages", "report"):
        assert "Not checked today" in (tmp_path / folder / "index.html").read_text(encoding="utf-8")


def test_unknown_notebook_is_named(suite, capsys):
    with pytest.raises(MissingData, match=r"'07'.*00_fails, 01_runs"):
        execute.find_notebooks(["07"])
    assert suite_main.main(["report", "07"]) == suite_main.main(["regenerate", "07"]) == 2
    assert "notebook '07'" in capsys.readouterr().err


def test_pages_take_their_findings_between_their_marks(suite, tmp_path):
    headline = '\n[[headline]]\nclaims = ["X01"]\nsays = "It is {size.value:.1f} cm."\n'
    (suite / "claims.toml").write_text(LEDGER + headline, encoding="utf-8")
    start, end = pages.MARKS
    (tmp_path / "docs").mkdir()
    readme, board = tmp_path / "README.md", tmp_path / "docs/scoreboard.md"
    for page in (readme, board):
        page.write_text(f"before\n{start}\nstale\n{end}\nafter\n", encoding="utf-8")
    for _ in range(2):  # the second time changes nothing
        pages.update(tmp_path)
        texts = [page.read_text(encoding="utf-8") for page in (readme, board)]
        assert all(x.startswith("before\n") and x.endswith("after\n") and "stale" not in x for x in texts)
        assert "- It is 4.0 cm. ([01](notebooks/01_runs.ipynb))" in texts[0] and "| X01 | Size" in texts[1]
    (suite / "claims.toml").write_text(LEDGER + headline.replace("{size.value:.1f}", "4"), encoding="utf-8")
    with pytest.raises(DataError, match="4 is typed"):
        pages.update(tmp_path)
    board.write_text("nothing", encoding="utf-8")
    with pytest.raises(DataError, match="no marks for the findings"):
        pages.update(tmp_path)


def test_rendering_is_really_tried_and_broken_rendering_is_found(monkeypatch):
    assert not doctor._check_rendering().remedy
    for program in ("import os; os.abort()", "raise SystemExit(0)", "raise SystemExit('an empty picture')"):
        monkeypatch.setattr(doctor, "_DRAW", program)
        assert "apt-get install" in doctor._check_rendering().remedy


def test_packages_agree_with_their_pins_and_another_version_is_found(tmp_path, monkeypatch):
    assert not any(check.remedy for check in doctor._check_packages())
    (tmp_path / "constraints.txt").write_text("torch==0.1\n", encoding="utf-8")
    monkeypatch.setattr(doctor, "ROOT", tmp_path)
    wrong = [check for check in doctor._check_packages() if check.remedy]
    assert [check.name for check in wrong] == ["torch"] and "0.1" in wrong[0].remedy


def test_data_folder_is_looked_into(tmp_path):
    assert doctor._check_data(str(tmp_path)).remedy and not doctor._check_data(None).remedy
    (tmp_path / "cmu_amc").mkdir()
    assert "cmu_amc" in doctor._check_data(str(tmp_path)).found


def test_doctor_exit_status_and_remedy(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "examine", lambda data: [Check("body", "not baked", "bake it"), Check("device", "cpu")])
    assert __main__.main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert "remedy: bake it" in out and "1 thing to mend" in out
    monkeypatch.setattr(doctor, "examine", lambda data: [Check("device", "cpu")])
    assert __main__.main(["doctor"]) == 0


def test_input_that_cannot_be_used_is_one_line_and_status_2(tmp_path):
    bad = tmp_path / "walk.bvh"
    bad.write_text("not a BVH", encoding="utf-8")
    command = [sys.executable, "-m", "motionlab", "convert", bad, tmp_path / "walk.glb"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 2 and "walk.bvh" in run.stderr and "Traceback" not in run.stderr


@pytest.mark.parametrize("flags", [("a.bvh",), ("a.npz", "--fps", "15"), ("a.glb",), ("a.glb", "--bones")])
def test_convert_writes_what_load_reads(tmp_path, flags):
    source, motion = tmp_path / "walk.bvh", standing(8)
    motion.root[:, 1] = torch.linspace(0, 1, 8)
    bvh.save(source, motion)
    target = tmp_path / flags[0]
    assert __main__.main(["convert", str(source), str(target), *flags[1:]]) == 0
    if target.suffix == ".glb":
        assert (b"JOINTS_0" in target.read_bytes()) == ("--bones" not in flags)  # a body unless it is not wanted
    back = load(target)
    assert back.fps == (15 if "--fps" in flags else 30)
    assert (back.root[-1] - back.root[0])[1].item() == pytest.approx(1, abs=0.15)


def test_npz_stands_on_the_floor_on_the_bones_that_its_reader_assumes(tmp_path):
    """AMASS files hold no bone lengths: a child's recording must be put on the standard body before it is written."""
    source, target = tmp_path / "child.bvh", tmp_path / "child.npz"
    bvh.save(source, standing(8, skeleton=STANDARD.scaled(0.6)))
    assert __main__.main(["convert", str(source), str(target)]) == 0
    soles = load(target).positions[..., STANDARD.indices(["left_foot", "right_foot"]), 2] - STANDARD.sole
    assert soles.abs().max() < 0.01


@pytest.mark.parametrize(
    ("target", "flags", "words"),
    [
        ("nowhere/a.bvh", (), "cannot be written"),
        ("a.bvh", ("--fps", "nan"), "give 1 to 1000"),
        ("a.npz", ("--bones",), "only a GLB"),
        ("still.bvh", ("--fps", "10"), "this is the file that was opened"),
    ],
)
def test_convert_says_in_one_line_what_it_cannot_do(tmp_path, capsys, target, flags, words):
    source = tmp_path / "still.bvh"
    bvh.save(source, standing())
    assert __main__.main(["convert", str(source), str(tmp_path / target), *flags]) == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [source]


def test_data_asks_for_the_rate_of_videos_and_takes_it(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    body = [x for k in range(25) for x in (10.0 * k, 5.0 * k, 0.9)]
    (tmp_path / "mine/0.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": body[:54]}]}), encoding="utf-8")
    assert __main__.main(["data", str(tmp_path)]) == 1
    assert "--fps" in capsys.readouterr().err
    assert __main__.main(["data", str(tmp_path), "--fps", "25"]) == 0
    assert "openpose" in capsys.readouterr().out


def test_data_prints_the_table_and_then_the_files_that_cannot_be_read(tmp_path, capsys):
    bvh.save(tmp_path / "good.bvh", standing())
    assert __main__.main(["data", str(tmp_path)]) == 0
    (tmp_path / "bad.bvh").write_text("HIERARCHY nothing")
    assert __main__.main(["data", str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert "1 clips" in printed.out and "good.bvh" not in printed.err
    assert "cannot be read: " in printed.err and "bad.bvh" in printed.err and "remedy" in printed.err


@pytest.mark.parametrize("certify", [[], ["--certify"]])
def test_data_says_first_what_it_guessed(tmp_path, capsys, certify):
    for n in range(3):
        bvh.save(tmp_path / f"{n}.bvh", standing(4 + n, skeleton=STANDARD.scaled(1 + n / 50)))
    main = ["data", str(tmp_path), *certify]
    assert __main__.main(main) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "3 such as 0.bvh: u" in lines[0] and "3 such as 0.bvh: u" in lines[1] and not lines[2].startswith("note")
    assert __main__.main([*main, "--unit", "cm", "--up", "y"]) == 0
    assert "note" not in capsys.readouterr().out


def test_data_needs_a_folder(monkeypatch, capsys):
    monkeypatch.delenv("MOTIONLAB_DATA", raising=False)
    assert __main__.main(["data"]) == 2 and "MOTIONLAB_DATA" in capsys.readouterr().err


def test_what_the_commands_offer_is_what_the_library_does():
    """They may not import it before one runs."""
    assert tuple(rewriting.WRITERS) == options.WRITTEN and options.METHODS == filling.METHODS
    assert {*judging.AXES} == {*options.UP} and {*courses.COURSES} == {*options.COURSES}


def test_help_loads_neither_torch_nor_numpy():
    """Which take a second or more; how long the rest takes depends on the machine."""
    code = "import runpy, sys; sys.argv[1:] = ['--help']\ntry: runpy.run_module('motionlab', run_name='__main__')\n"
    code += "finally: print([name for name in ('torch', 'numpy', 'motionlab') if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "convert" in done.stdout and done.stdout.splitlines()[-1] == "['motionlab']"
