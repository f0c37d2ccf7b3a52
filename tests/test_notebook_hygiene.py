"""What nbval cannot see: a check that is never made is a check that always passes."""

import ast
import json
import re
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("[0-9]*.ipynb"))
MARKERS = ("NBVAL_CHECK_OUTPUT", "NBVAL_IGNORE_OUTPUT", "NBVAL_SKIP", "NBVAL_RAISES_EXCEPTION")
ENVIRONMENT = ("%pip", "!pip", "!apt", "%cd", "%load_ext", "%conda")
GENERATORS = ("default_rng", "Generator", "manual_seed", "RandomState", "generator")


def code_cells(path):
    book = json.loads(path.read_text(encoding="utf-8"))
    cells = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    return [("".join(cell["source"]), cell) for cell in cells]


def problems(path):
    cells = code_cells(path)
    counts = [cell["execution_count"] for _, cell in cells]
    if counts != list(range(1, len(cells) + 1)):
        yield f"not run top to bottom in one kernel: execution counts {counts}"
    parameters = [source for source, cell in cells if "parameters" in cell["metadata"].get("tags", [])]
    if len(parameters) != 1:
        yield "needs exactly one cell tagged 'parameters'"
    if not any("NBVAL_CHECK_OUTPUT" in source.splitlines()[0] for source, _ in cells if source):
        yield "no cell checks its output"
    if not cells or cells[-1][0].splitlines()[-1:] != ["lab.close()"]:
        yield "does not end with lab.close(), which compares it with its record"
    if path.stat().st_size > 4_000_000:
        yield f"{path.stat().st_size / 1e6:.1f} MB; make the pictures smaller"
    shown = "\n".join(text for _, cell in cells for text in texts(cell))
    if not re.search(r"profile \*?full\b", shown):
        yield "not the full profile: run `make full`"
    elsewhere = re.search(r"(?<![\w.:/])/(home|root|tmp|work|Users)/\w+", shown)
    if elsewhere:
        yield f"shows a path of one machine: {elsewhere[0]}"
    for number, (source, cell) in enumerate(cells, 1):
        yield from (f"cell {number}: {problem}" for problem in cell_problems(source, cell))
    yield from leaked_loop_variables([source for source, _ in cells])


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
    if len(lines) > 30:
        yield f"{len(lines)} lines; move code to its study"
    if any(line.strip().startswith(ENVIRONMENT) for line in lines):
        yield "changes the environment"
    if "NBVAL_SKIP" in source:
        yield "a skipped cell is not evidence"
    for node in ast.walk(tree_of(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) and called(node.value) in GENERATORS:
            yield f"line {node.lineno}: makes a generator and drops it (a ghost seed)"
        if isinstance(node, ast.Attribute) and node.attr == "seed" and ast.unparse(node).startswith(("np.", "numpy.")):
            yield f"line {node.lineno}: seeds the global state"


def tree_of(source):
    """The cell's syntax tree, without its magics."""
    plain = [re.sub(r"^(\s*)[%!?].*", r"\1pass", line) for line in source.splitlines()]
    return ast.parse("\n".join(plain))


def called(call):
    """Name of the function at the end of a chain: torch.Generator().manual_seed(0) is a manual_seed on a fresh one."""
    if isinstance(call.func, ast.Attribute):
        fresh = isinstance(call.func.value, ast.Call) or call.func.attr != "manual_seed"
        return call.func.attr if fresh or ast.unparse(call.func.value) == "torch" else ""
    return getattr(call.func, "id", "")


def leaked_loop_variables(sources):
    """A for-loop's variable read in a later cell that did not set it: it holds whatever came last."""
    leaked: dict[str, int] = {}
    for number, source in enumerate(sources, 1):
        tree = tree_of(source)
        used = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
        local = bound_inside(tree)
        stored = {node.id for node in used if isinstance(node.ctx, ast.Store)} | local
        for node in used:
            if isinstance(node.ctx, ast.Load) and node.id in leaked and node.id not in stored:
                yield f"cell {number}: reads {node.id}, the loop variable of cell {leaked[node.id]}"
        loops = [node for node in tree.body if isinstance(node, ast.For)]
        targets = {name.id for loop in loops for name in ast.walk(loop.target) if isinstance(name, ast.Name)}
        for name in stored:
            leaked.pop(name, None)
        leaked |= dict.fromkeys(targets, number)


def bound_inside(tree):
    """Names bound as arguments, imports, functions."""
    names = {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    names |= {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    return names | {
        alias.asname or alias.name
        for node in ast.walk(tree)
        for alias in getattr(node, "names", [])
        if isinstance(alias, ast.alias)
    }


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_honest(path):
    found = list(problems(path))
    assert not found, "\n".join(found)


def test_there_are_notebooks():
    assert NOTEBOOKS


def cell(source, count, output="all holds", tags=(), **more):
    outputs = [{"output_type": "stream", "name": "stdout", "text": output}] if output else []
    return {
        "cell_type": "code",
        "source": source,
        "execution_count": count,
        "metadata": {"tags": list(tags)},
        "outputs": outputs,
        **more,
    }


def good_cells():
    return [
        cell("PROFILE = None", 1, output="", tags=["parameters"]),
        cell("lab = setup(PROFILE)", 2, output="profile *full*, seed 0"),
        cell("for clip in clips:\n    rng = np.random.default_rng(0)\n    show(clip, rng)", 3),
        cell("# NBVAL_CHECK_OUTPUT\nlab.verdicts()\nlab.close()", 4),
    ]


def written(tmp_path, cells):
    path = tmp_path / "00_toy.ipynb"
    path.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    return path


def test_control_good_notebook_passes(tmp_path):
    assert list(problems(written(tmp_path, good_cells()))) == []


STDERR = [{"output_type": "stream", "name": "stderr", "text": "UserWarning"}]
ERROR = [{"output_type": "error", "ename": "E", "evalue": "", "traceback": []}]
IMAGE = [{"output_type": "display_data", "data": {"image/png": "iVBOR"}, "metadata": {}}]


@pytest.mark.parametrize(
    ("index", "bad", "complaint"),
    [
        (1, cell("lab = setup(PROFILE)", 7, "profile *full*"), "top to bottom"),
        (0, cell("PROFILE = None", 1), "exactly one cell"),
        (1, cell("lab = setup(PROFILE)", 2, "profile *smoke*"), "not the full profile"),
        (2, cell("print(path)", 3, "read /home/ann/walk.bvh"), "path of one machine"),
        (3, cell("lab.verdicts()", 4), "no cell checks"),
        (3, cell("# NBVAL_CHECK_OUTPUT\nlab.close()\nlab.verdicts()", 4), "does not end with lab.close()"),
        (3, cell("# NBVAL_CHECK_OUTPUT - verdicts\nlab.verdicts()", 4), "marker not alone"),
        (3, cell("lab.verdicts()  # NBVAL_CHECK_OUTPUT", 4), "marker not alone"),
        (3, cell("# NBVAL_CHECK_OUTPUT\nlab.verdicts()", 4, output=""), "no text to compare"),
        (3, cell("# NBVAL_CHECK_OUTPUT\nlab.show()", 4, outputs=IMAGE), "no text to compare"),
        (2, cell("x", 3, outputs=STDERR), "stderr"),
        (2, cell("x", 3, outputs=ERROR), "stores an error"),
        (2, cell("x = 1\n" * 31, 3), "31 lines"),
        (2, cell("%pip install x", 3), "changes the environment"),
        (2, cell("# NBVAL_SKIP\nx", 3), "skipped cell"),
        (2, cell("np.random.default_rng(seed=0)", 3), "ghost seed"),
        (2, cell("torch.Generator().manual_seed(0)", 3), "ghost seed"),
        (2, cell("lab.generator('walk')", 3), "ghost seed"),
        (2, cell("np.random.seed(0)", 3), "global state"),
        (3, cell("# NBVAL_CHECK_OUTPUT\nlab.show(clip)", 4), "loop variable of cell 3"),
        (2, cell("x", 3, output="x" * 4_100_000), "4.1 MB"),
    ],
)
def test_control_bad_notebook_is_found(tmp_path, index, bad, complaint):
    cells = good_cells()
    cells[index] = bad
    assert any(complaint in problem for problem in problems(written(tmp_path, cells)))


def test_control_loop_variable_set_again_is_fine(tmp_path):
    cells = good_cells()
    cells.insert(3, cell("clip = clips[0]\nshow(clip)", 4))
    cells.insert(4, cell("show(clip)\n[clip for clip in clips]", 5))
    cells[5]["execution_count"] = 6
    assert list(problems(written(tmp_path, cells))) == []
