"""The border: which room may import which. Imports only point down the floors written here."""

import ast
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: The rooms of the library, a floor a line, the lowest first: what is below "animate" is what a stranger imports. An
#: import goes strictly down, or stays inside its room: a module, or a package that is named here as a whole.
FLOORS = """
    errors examples parallel
    files optimise rotation skeleton
    checkpoint motion rigs
    body
    baselines cleaning contact heading humanml ik observation rest skinning
    data_synth diffusion.encoder diffusion.features diffusion.sampling humor.body_shape humor.state io
        metrics retarget viz
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
    animate footage training
    commands
    __main__
"""
LIBRARY, SYNTHETIC, STUDIES = "motionlab", "data_synth", "studies"
#: What runs all notebooks: it may import the library; a notebook imports these parts of it, a study what a finding is.
DATA_MODEL = "suite.findings"
SUITE, BENCH = "suite", ("suite.notebook", "suite.ledger", DATA_MODEL)
#: Where commands bring synthetic motion and models together; the rest of the library does not know it.
COMPOSERS = ("training",)
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


def complaint(me: str, other: str, levels: dict[str, int]) -> str | None:
    """Why a module, or a notebook, may not import another; None where it may."""
    mine, theirs, base = room(me, levels), room(other, levels), me.split(".")[0]
    if other.split(".")[0] in (STUDIES, SUITE):
        if base in (LIBRARY, SYNTHETIC):
            return "the library does not know the studies"
        if base == SUITE:
            near = (SUITE,)
        elif base == STUDIES:
            near = (".".join(me.split(".")[:2]), *SHARED, DATA_MODEL)
        else:
            near = (*SHARED, *BENCH)
        own = other.startswith(f"{STUDIES}.nb{me[:2]}_") and base not in (SUITE, STUDIES)
        return None if own or any(f"{other}.".startswith(f"{name}.") for name in near) else f"imports another's {other}"
    if base not in (LIBRARY, SYNTHETIC) or theirs is None or mine in (None, theirs):
        return None
    if theirs == SYNTHETIC and mine not in COMPOSERS:
        return "the library does not know synthetic motion"
    return f"imports {other}, which is no floor below" if levels[theirs] >= levels[mine] else None


def problems(root: Path = ROOT, text: str = FLOORS) -> list[str]:
    """What the rules of this file forbid."""
    levels, paths = floors(text), modules(root)
    holds = {LIBRARY, *(name.rpartition(".")[0] for name in paths if name.count(".") > 1)}  # packages without a floor
    ours = [me for me in paths if me.split(".")[0] in (LIBRARY, SYNTHETIC)]
    found = [f"{me} has no floor: add it to FLOORS" for me in ours if room(me, levels) is None and me not in holds]
    found += [f"FLOORS names {name}, which does not exist" for name in set(levels) - {room(me, levels) for me in paths}]
    for me, path in {**paths, **{path.stem: path for path in notebooks(root)}}.items():
        for line, other in imports(path, paths):
            if why := complaint(me, other, levels):
                found.append(f"{me}:{line}: {why}")
    return found


def test_every_import_goes_down():
    assert not problems(), "\n".join(problems())


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
        ("motionlab/low.py", "from studies.nb01_x import trials", "does not know the studies"),
        ("motionlab/low.py", "from suite import execute", "does not know the studies"),
        ("motionlab/io/deep.py", "from motionlab import judge", "imports motionlab.judge"),
        ("motionlab/stranger.py", "", "has no floor"),
        ("motionlab/judge.py", "from data_synth import truth", "does not know synthetic motion"),
        ("notebooks/studies/nb02_y/a.py", "from suite import execute", "another's suite.execute"),
        ("notebooks/suite/report.py", "from studies.nb01_x import trials", "another's studies.nb01_x.trials"),
        ("notebooks/02_y.ipynb", "from studies.nb01_x import trials", "another's studies.nb01_x.trials"),
        ("notebooks/02_y.ipynb", "from suite.notebook import setup", None),
        ("notebooks/01_x.ipynb", "%cd\nfrom studies.nb01_x import trials\nfrom motionlab import judge", None),
        ("notebooks/suite/report.py", "from suite import execute\nfrom motionlab import judge", None),
        ("notebooks/studies/nb02_y/a.py", "from studies.shared import medians\nfrom motionlab.judge import x", None),
        ("motionlab/judge.py", "from motionlab import low\nfrom motionlab.low import x", None),
    ],
)
def test_control_bad_module_is_found(tmp_path, module, source, complaint):
    def put(name, text=""):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")

    for name in ("low", "high", "judge", "io/deep"):
        put(f"motionlab/{name}.py")
    for name in ("studies/nb01_x/trials", "studies/shared/medians", "suite/execute", "suite/notebook"):
        put(f"notebooks/{name}.py")
    put("data_synth/truth.py")
    assert problems(tmp_path, SMALL) == []
    cells = json.dumps({"cells": [{"cell_type": "code", "source": source}]})
    put(module, cells if module.endswith("ipynb") else source)
    found = problems(tmp_path, SMALL)
    assert any(complaint in problem for problem in found) if complaint else not found
