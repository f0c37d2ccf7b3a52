"""The border: which room may import which. Imports only point down the floors written here."""

import ast
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: The rooms, a floor a line, the lowest first: what is below "animate" is what a stranger imports. An import goes
#: strictly down, or stays inside its room: a module, or a package that is named here as a whole. Every study, with its
#: notebooks, is a room on the floor of "studies".
FLOORS = """
    errors examples parallel
    files optimise rotation skeleton
    checkpoint motion rigs
    body
    baselines cleaning contact heading humanml ik observation rest skinning
    diffusion.features diffusion.sampling humor.body_shape humor.state io metrics retarget viz
    splits
    corpus diffusion.completer diffusion.model diffusion.windows humor.priors
    diffusion.poses humor.energies
    bench humor.compiled humor.evidence humor.pretrained
    humor.rollout
    humor.unknowns
    humor.stages humor.start
    humor.gauss_newton
    humor.coordinates
    humor.feedback_solver
    humor.testops
    posterior
    animate data_synth footage
    training
    commands
    __main__
    studies.official suite.staleness
    suite.findings
    suite.ledger
    studies.shared suite.notebook
    studies suite
"""


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Every module of ours by name; a notebook is one of its study."""
    places = ("motionlab", "data_synth", "notebooks/studies", "notebooks/suite")
    found = {}
    for path in [path for place in places for path in sorted((root / place).rglob("*.py"))]:
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts).removeprefix("notebooks.").removesuffix(".__init__")] = path
    studies = {name.split(".")[1][:4]: ".".join(name.split(".")[:2]) for name in found if ".nb" in name}
    return found | {f"{studies[f'nb{path.stem[:2]}']}.{path.stem}": path for path in notebooks(root)}


def notebooks(root: Path = ROOT) -> list[Path]:
    """The suite in its order."""
    return sorted((root / "notebooks").glob("[0-9][0-9]*_*.ipynb"))


def imports(path: Path, known) -> list[tuple[int, str]]:
    """(line, module) of every import of ours: `from a.b import c` is a.b.c where that is a module, else a.b."""
    text, found = path.read_text(encoding="utf-8"), []
    if path.suffix == ".ipynb":
        code = ["".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        text = "\n".join(line for line in "\n".join(code).splitlines() if not line.startswith(("%", "!")))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names if alias.name in known]
        elif isinstance(node, ast.ImportFrom):
            wholes = [(f"{node.module}.{alias.name}", node.module) for alias in node.names]
            found += [(node.lineno, name) for pair in wholes if (name := next((n for n in pair if n in known), None))]
    return found


def problems(root: Path = ROOT, text: str = FLOORS) -> list[str]:
    """What the floors forbid, and what is on none of them."""
    paths = modules(root)
    levels = {name: level for level, line in enumerate(text.split("\n")) for name in line.split()}
    levels |= {".".join(me.split(".")[:2]): levels["studies"] for me in paths if me.startswith("studies.nb")}

    def room(module: str) -> str | None:
        """The longest name of the floors that holds a module."""
        parts = module.removeprefix("motionlab.").split(".")
        return next((name for n in range(len(parts), 0, -1) if (name := ".".join(parts[:n])) in levels), None)

    found = [f"FLOORS names {name}, which does not exist" for name in levels.keys() - set(map(room, paths))]
    for me, path in paths.items():
        if (mine := room(me)) is None:
            found += [f"{me} has no floor: add it to FLOORS"] * (path.name != "__init__.py")
            continue
        for line, other in imports(path, paths):
            theirs = room(other) or mine
            if theirs != mine and levels[theirs] >= levels[mine]:
                found.append(f"{me}:{line}: imports {other}, which is no floor below")
    return found


def test_every_import_goes_down():
    assert not problems(), "\n".join(problems())


@pytest.mark.parametrize(
    ("module", "source", "found"),
    [
        ("motionlab/low.py", "import motionlab.high", "imports motionlab.high"),
        ("motionlab/low.py", "from studies.nb01_x import trials", "imports studies.nb01_x.trials"),
        ("motionlab/io/deep.py", "from motionlab import high", "imports motionlab.high"),
        ("motionlab/stranger.py", "", "has no floor"),
        ("notebooks/studies/nb02_y/a.py", "from suite import report", "imports suite.report"),
        ("notebooks/suite/report.py", "from studies.nb01_x import trials", "imports studies.nb01_x.trials"),
        ("notebooks/02_y.ipynb", "from studies.nb01_x import trials", "imports studies.nb01_x.trials"),
        ("notebooks/01_x.ipynb", "%cd\nfrom studies.nb01_x import trials\nfrom motionlab import high", None),
        ("notebooks/studies/nb02_y/a.py", "from suite import notebook\nfrom motionlab.high import x", None),
    ],
)
def test_control_bad_module_is_found(tmp_path, module, source, found):
    def put(name, text=""):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")

    for name in ("motionlab/low", "motionlab/high", "motionlab/io/deep", "notebooks/suite/report"):
        put(f"{name}.py")
    for name in ("suite/notebook", "studies/__init__", "studies/nb01_x/trials", "studies/nb02_y/a"):
        put(f"notebooks/{name}.py")
    small = "low\nhigh io\nsuite.notebook\nstudies suite"
    assert problems(tmp_path, small) == []
    cells = json.dumps({"cells": [{"cell_type": "code", "source": source}]})
    put(module, cells if module.endswith("ipynb") else source)
    assert any(found in each for each in problems(tmp_path, small)) if found else not problems(tmp_path, small)
