"""What nbval cannot see: a check that is never made is a check that always passes."""

import json
import re
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("[0-9]*.ipynb"))
MARKERS = ("NBVAL_CHECK_OUTPUT", "NBVAL_IGNORE_OUTPUT", "NBVAL_SKIP", "NBVAL_RAISES_EXCEPTION")


def code_cells(path):
    book = json.loads(path.read_text(encoding="utf-8"))
    cells = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    return [("".join(cell["source"]), cell) for cell in cells]


def problems(path):
    cells = code_cells(path)
    counts = [cell["execution_count"] for _, cell in cells]
    if counts != list(range(1, len(cells) + 1)):
        yield f"not run top to bottom in one kernel: execution counts {counts}"
    if not any("NBVAL_CHECK_OUTPUT" in source.splitlines()[0] for source, _ in cells if source):
        yield "no cell checks its output"
    if not cells or cells[-1][0].splitlines()[-1:] != ["lab.close()"]:
        yield "does not end with lab.close(), which compares it with its record"
    shown = "\n".join(text for _, cell in cells for text in texts(cell))
    if not re.search(r"profile \*?full\b", shown):
        yield "not the full profile: run `make full`"
    elsewhere = re.search(r"(?<![\w.:/])/(home|root|tmp|work|Users)/\w+", shown)
    if elsewhere:
        yield f"shows a path of one machine: {elsewhere[0]}"
    for number, (source, cell) in enumerate(cells, 1):
        yield from (f"cell {number}: {problem}" for problem in cell_problems(source, cell))


def texts(cell):
    for output in cell["outputs"]:
        yield "".join(output.get("text", ""))
        for kind, data in output.get("data", {}).items():
            if kind.startswith("text/"):
                yield "".join(data)


def cell_problems(source, cell):
    lines = source.splitlines()
    for line in lines:  # nbval 0.11 plugin.py:199-206: the comment must be the marker and nothing else
        if any(marker in line for marker in MARKERS) and line.strip().lstrip("#").strip() not in MARKERS:
            yield f"marker not alone on its line, nbval ignores it: {line.strip()!r}"
    kinds = [output["output_type"] for output in cell["outputs"]]
    checked = "NBVAL_CHECK_OUTPUT" in source or "nbval-check-output" in cell["metadata"].get("tags", [])
    if checked and not any("".join(text).strip() for text in texts(cell)):  # images are never compared
        yield "marked for checking but stores no text to compare"
    if "error" in kinds:
        yield "stores an error"
    if any(output.get("name") == "stderr" for output in cell["outputs"]):
        yield "stores a warning (stderr)"
    if "NBVAL_SKIP" in source:
        yield "a skipped cell is not evidence"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_honest(path):
    found = list(problems(path))
    assert not found, "\n".join(found)


def cell(source, count, output="all holds", **more):
    outputs = [{"output_type": "stream", "name": "stdout", "text": output}] if output else []
    made = {"cell_type": "code", "source": source, "execution_count": count, "outputs": outputs}
    return made | {"metadata": {}} | more


def good_cells():
    return [
        cell("PROFILE = None", 1, output=""),
        cell("lab = setup(PROFILE)", 2, output="profile *full*, seed 0"),
        cell("show(clips)", 3),
        cell("# NBVAL_CHECK_OUTPUT\nlab.verdicts()\nlab.close()", 4),
    ]


def written(tmp_path, cells):
    path = tmp_path / "00_toy.ipynb"
    path.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    return path


STDERR = [{"output_type": "stream", "name": "stderr", "text": "UserWarning"}]
ERROR = [{"output_type": "error", "ename": "E", "evalue": "", "traceback": []}]
IMAGE = [{"output_type": "display_data", "data": {"image/png": "iVBOR"}, "metadata": {}}]


@pytest.mark.parametrize(
    ("index", "bad", "complaint"),
    [
        (1, cell("lab = setup(PROFILE)", 7, "profile *full*"), "top to bottom"),
        (1, cell("lab = setup(PROFILE)", 2, "profile *smoke*"), "not the full profile"),
        (2, cell("print(path)", 3, "read /home/ann/walk.bvh"), "path of one machine"),
        (3, cell("lab.verdicts()", 4), "no cell checks"),
        (3, cell("# NBVAL_CHECK_OUTPUT\nlab.close()\nlab.verdicts()", 4), "does not end with lab.close()"),
        (3, cell("# NBVAL_CHECK_OUTPUT - verdicts\nlab.verdicts()", 4), "marker not alone"),
        (3, cell("# NBVAL_CHECK_OUTPUT\nlab.verdicts()", 4, output=""), "no text to compare"),
        (3, cell("# NBVAL_CHECK_OUTPUT\nlab.show()", 4, outputs=IMAGE), "no text to compare"),
        (2, cell("x", 3, outputs=STDERR), "stderr"),
        (2, cell("x", 3, outputs=ERROR), "stores an error"),
        (2, cell("# NBVAL_SKIP\nx", 3), "skipped cell"),
    ],
)
def test_control_bad_notebook_is_found(tmp_path, index, bad, complaint):
    cells = good_cells()
    assert not list(problems(written(tmp_path, cells)))
    cells[index] = bad
    assert any(complaint in problem for problem in problems(written(tmp_path, cells)))
