"""Imports may only point down the floors written here; this file is the architecture."""

import ast
import json
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: The rooms of the library, a floor a line, the lowest first. An import goes strictly down, or stays inside its room: a
#: module, or a package that is named here as a whole.
FLOORS = """
    errors examples parallel
    batch files optimise rotation skeleton training_loop diffusion.sampling
    body checkpoint motion
    heading humanml
    baselines contact rest rigs skinning tailoring humor.state diffusion.features diffusion.state
    observation retarget humor.cvae diffusion.curves diffusion.footsteps diffusion.losses diffusion.masks
    io viz data_synth humor.body_shape humor.energies humor.priors humor.transition
        diffusion.completer diffusion.denoiser diffusion.planting diffusion.windows
    certificate cleaning detect people metrics stature humor.compiled humor.evidence humor.examples humor.pretrained
        humor.prior_training diffusion.model diffusion.poses
    humor.rollout diffusion.denoising diffusion.embedding diffusion.inpainting diffusion.training
    corpus splits humor.scales humor.unknowns corrections diffusion.completer_training
    bench shipped doctor onnx_export humor.chain_training humor.quality humor.stages humor.start animate
    footlock train_more models humor.shooting renew
    looping train_completer train_plain train_prior
    train
    humor.testops
    posterior scene_fit
    clip scene_report
    fit
    commands
    __main__
"""
LIBRARY, SYNTHETIC, STUDIES = "motionlab", "data_synth", "studies"
#: What runs all notebooks: it may import the library; a notebook imports these parts of it, a study what a finding is.
DATA_MODEL = "suite.findings"
SUITE, BENCH = "suite", ("suite.notebook", "suite.ledger", DATA_MODEL)
#: Where commands bring synthetic motion and models together; the rest of the library does not know it.
COMPOSERS = ("splits", "shipped", "train_more", "train_completer", "train_plain", "train_prior", "train")
#: Studies may not import each other, but for these, which are there for several.
SHARED = ("studies.shared", "studies.official")


def floors(text: str = FLOORS) -> dict[str, int]:
    """Floor of every room; a line that begins deeper goes on with the one before."""
    lines = [line for line in text.splitlines() if line.strip()]
    base = min(len(line) - len(line.lstrip()) for line in lines)
    found, level = {}, -1
    for line in lines:
        level += len(line) - len(line.lstrip()) == base
        found |= dict.fromkeys(line.split(), level)
    return found


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Every module of the library, of data_synth, of the studies and of what runs them all, by name."""
    bases = ((root, LIBRARY), (root, SYNTHETIC), (root / "notebooks", STUDIES), (root / "notebooks", SUITE))
    paths = [(base, path) for base, package in bases for path in sorted((base / package).rglob("*.py"))]
    return {
        ".".join(path.relative_to(base).with_suffix("").parts).removesuffix(".__init__"): path for base, path in paths
    }


def room(module: str, known: dict[str, int]) -> str | None:
    """The room of a module: the longest name of the floors that holds it."""
    parts = module.removeprefix(f"{LIBRARY}.").split(".")
    return next((name for n in range(len(parts), 0, -1) if (name := ".".join(parts[:n])) in known), None)


def notebooks(root: Path = ROOT) -> list[Path]:
    """The suite in its order."""
    return sorted((root / "notebooks").glob("[0-9][0-9]*_*.ipynb"))


def syntax(path: Path) -> ast.Module:
    """Syntax of a module, or of a notebook's code cells without their magics."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        code = ["".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        text = "\n".join(line for line in "\n".join(code).splitlines() if not line.startswith(("%", "!")))
    return ast.parse(text)


def imports(path: Path, known) -> list[tuple[int, str]]:
    """(line, module) of every import of ours: `from a.b import c` is a.b.c where that is a module, else a.b."""
    found = []
    for node in ast.walk(syntax(path)):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names if alias.name in known]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            wholes = [(f"{node.module}.{alias.name}", node.module) for alias in node.names]
            found += [(node.lineno, name) for pair in wholes if (name := next((n for n in pair if n in known), None))]
    return found


def problems(root: Path = ROOT, text: str = FLOORS) -> list[str]:
    """What the rules of this file forbid."""
    levels, paths, found = floors(text), modules(root), []
    empty = {LIBRARY, *(name.rpartition(".")[0] for name in paths if name.count(".") > 1)}  # packages that only hold
    for me, path in paths.items():
        mine, tree = room(me, levels), syntax(path)
        study = me.split(".")[0] in (STUDIES, SUITE)
        if mine is None and not study and me not in empty:
            found.append(f"{me} has no floor: add it to FLOORS, or delete it")
        if mine is None and not study and path.name == "__init__.py" and me != LIBRARY and len(tree.body) > 1:
            found.append(f"{me}: a package without a floor only holds; move this into a module")
        for line, other in imports(path, paths):
            where = f"{me}:{line}"
            theirs = room(other, levels)
            if other.split(".")[0] in (STUDIES, SUITE):
                ours = SUITE if me.split(".")[0] == SUITE else ".".join(me.split(".")[:2])
                if not study:
                    found.append(f"{where}: the library does not know the studies")
                elif not any(f"{other}.".startswith(f"{near}.") for near in (ours, *SHARED, DATA_MODEL)):
                    found.append(f"{where}: a study imports another, {other}")
            elif theirs is None or study or theirs == mine or mine is None:
                continue
            elif theirs == SYNTHETIC and mine not in COMPOSERS:
                found.append(f"{where}: the library does not know synthetic motion")
            elif levels[theirs] >= levels[mine]:
                found.append(f"{where} (floor {levels[mine]}) imports {other} (floor {levels[theirs]})")
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.level:
                found.append(f"{me}:{node.lineno}: relative import")
            if isinstance(node, ast.Assert):
                found.append(f"{me}:{node.lineno}: assert; raise an error that says what to do")
    for path in notebooks(root):
        near = (f"{STUDIES}.nb{path.stem[:2]}_", *(f"{name}." for name in (*SHARED, *BENCH)))
        others = {name for _, name in imports(path, paths) if name.split(".")[0] in (STUDIES, SUITE)}
        found += [
            f"{path.stem}: imports {n}, which is another's" for n in sorted(others) if not f"{n}.".startswith(near)
        ]
    gone = set(levels) - {room(me, levels) for me in paths}
    return [*found, *(f"FLOORS names {name}, which does not exist" for name in sorted(gone))]


def cycle(root: Path = ROOT) -> list[str]:
    """Modules that import each other in a circle, or nothing."""
    paths = modules(root)
    needs = {me: {other for _, other in imports(path, paths)} - {me} for me, path in paths.items()}
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_every_import_goes_down():
    found = problems()
    assert not found, "\n".join(found)


def test_no_module_imports_itself_through_others():
    assert not cycle()


SMALL = """
    low
    high io
    judge
    data_synth
"""


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("motionlab/low.py", "import motionlab.high", "imports motionlab.high"),
        ("motionlab/low.py", "from motionlab import high", "imports motionlab.high"),
        ("motionlab/low.py", "def f():\n    from motionlab.high import x", "imports motionlab.high"),
        ("motionlab/low.py", "from . import errors", "relative import"),
        ("motionlab/low.py", "assert 1", "assert"),
        ("motionlab/low.py", "from studies.nb01_x import trials", "does not know the studies"),
        ("motionlab/low.py", "from suite import execute", "does not know the studies"),
        ("motionlab/io/deep.py", "from motionlab import judge", "imports motionlab.judge"),
        ("motionlab/stranger.py", "", "has no floor"),
        ("motionlab/judge.py", "from data_synth import truth", "does not know synthetic motion"),
        ("notebooks/studies/nb02_y/a.py", "from studies.nb01_x import trials", "a study imports another"),
        ("notebooks/studies/nb01/a.py", "from studies.nb01_x import trials", "a study imports another"),
        ("notebooks/02_y.ipynb", "from studies.nb01_x import trials", "imports studies.nb01_x.trials"),
        ("notebooks/02_y.ipynb", "from suite.execute import run", "imports suite.execute"),
        ("notebooks/02_y.ipynb", "from suite.notebook import setup", None),
        ("notebooks/01_x.ipynb", "%cd\nfrom studies.nb01_x import trials\nfrom motionlab import judge", None),
        ("motionlab/deep/__init__.py", "'''It does.'''\nfrom motionlab.judge import x", "only holds"),
        ("notebooks/studies/nb02_y/a.py", "from suite import execute", "a study imports another"),
        ("notebooks/suite/report.py", "from studies.nb01_x import trials", "a study imports another"),
        ("notebooks/suite/report.py", "from suite import execute\nfrom motionlab import judge", None),
        ("notebooks/studies/nb02_y/a.py", "from studies.shared import medians", None),
        ("notebooks/studies/nb02_y/a.py", "from motionlab.judge import x", None),
        ("motionlab/judge.py", "from motionlab import low\nfrom motionlab.low import x", None),
    ],
)
def test_control_bad_module_is_found(tmp_path, module, source, complaint):
    files = [
        "motionlab/low.py",
        "motionlab/high.py",
        "motionlab/judge.py",
        "motionlab/io/deep.py",
        "data_synth/truth.py",
    ]
    files += ["notebooks/studies/nb01_x/trials.py", "notebooks/studies/shared/medians.py", "notebooks/suite/execute.py"]
    files += ["notebooks/suite/notebook.py"]
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert problems(tmp_path, SMALL) == []
    (tmp_path / module).parent.mkdir(parents=True, exist_ok=True)
    cells = json.dumps({"cells": [{"cell_type": "code", "source": source}]})
    (tmp_path / module).write_text(cells if module.endswith("ipynb") else source, encoding="utf-8")
    found = problems(tmp_path, SMALL)
    assert any(complaint in problem for problem in found) if complaint else not found


def test_control_cycle_is_found(tmp_path):
    (tmp_path / "motionlab/io").mkdir(parents=True)
    (tmp_path / "motionlab/io/bvh.py").write_text("from motionlab.io import amc", encoding="utf-8")
    (tmp_path / "motionlab/io/amc.py").write_text("import motionlab.io.bvh", encoding="utf-8")
    assert set(cycle(tmp_path)) == {"motionlab.io.bvh", "motionlab.io.amc"}
