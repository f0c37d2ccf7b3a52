"""Imports may only point down the floors written here; this file is the architecture."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("motionlab", "data_synth")
FLOORS = {  # module or package -> floor; an import goes strictly down, or stays inside its package
    # ground
    "motionlab": 0,
    "motionlab.errors": 0,
    # algebra and instruments
    "motionlab.writing": 0.5,
    "motionlab.kept": 0.5,
    "motionlab.euler": 0.5,
    "motionlab.unrolling": 0.5,
    "motionlab.rotation": 1,
    "motionlab.findings": 1,
    "motionlab.profiling": 1,
    "motionlab.scaling": 1,
    "motionlab.tables": 1,
    # bodies and the values that travel
    "motionlab.skeleton": 2,
    "motionlab.anny_body": 2.5,
    "motionlab.motion": 3,
    "motionlab.observation": 3,
    "motionlab.body": 3,
    "motionlab.skinning": 3.5,
    # views of a motion
    "motionlab.leakage": 4,
    "motionlab.frames": 4,
    "motionlab.contact": 4,
    "motionlab.io": 4,
    "data_synth": 4.5,
    # measures
    "motionlab.retarget": 5,
    "motionlab.metrics": 5,
    "motionlab.baselines": 5,
    "motionlab.optimise": 5,
    "motionlab.lbfgs": 4.5,
    "motionlab.optimise_batch": 5,
    # procedures
    "motionlab.library": 6,
    "motionlab.representations": 6,
    "motionlab.rotation_trials": 6.5,
    "motionlab.partial_fit": 6,
    # models
    "motionlab.humor": 6.7,
    "motionlab.diffusion": 6.8,
    "motionlab.posterior": 6.9,
    # showing
    "motionlab.viz": 7,
    "motionlab.notebook": 8,
    "motionlab.doctor": 8,
    "motionlab.train_small": 7.5,
    "motionlab.diffusion_data": 7.2,
    "motionlab.train_diffusion": 7.5,
    "motionlab.run_faithful": 7.5,
    "motionlab.run_tuning": 7.5,
    "motionlab.train": 8,
    "motionlab.fit": 8,
    "motionlab.execute": 8.1,
    "motionlab.report": 8.2,
    "motionlab.__main__": 9,
}
# where commands bring synthetic motion and models together
COMPOSERS = (
    "motionlab.train",
    "motionlab.train_small",
    "motionlab.train_diffusion",
    "motionlab.diffusion_data",
    "motionlab.run_faithful",
    "motionlab.run_tuning",
)
SYNTH_CEILING = 4  # data_synth makes ground truth: it may not know a measure or a model that is judged by it


def name_of(path: Path, root: Path) -> str:
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def modules(root: Path = ROOT) -> list[Path]:
    return [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]


def home(module: str, floors: dict[str, float]) -> str | None:
    """The longest entry of the floors that holds a module: motionlab.io for motionlab.io.bvh."""
    parts = module.split(".")
    above = [".".join(parts[:n]) for n in range(len(parts), 0, -1)]
    if len(above) > 1 and above[-1] == "motionlab":  # the package itself shelters nobody
        above.pop()
    return next((name for name in above if name in floors), None)


def imports(path: Path, known: set[str]):
    """(line, module) of every import of ours: `from a.b import c` is a.b.c where that is a module, else a.b."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            wholes = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from ((node.lineno, whole if whole in known else node.module) for whole in wholes)


def problems(path: Path, root: Path = ROOT, floors: dict[str, float] = FLOORS):
    me = name_of(path, root)
    mine = home(me, floors)
    if mine is None:
        yield f"{me} has no floor: add it to FLOORS, or delete it"
        return
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for line, other in imports(path, {name_of(module, root) for module in modules(root)} | set(floors)):
        theirs = home(other, floors)
        if theirs is None or theirs == mine:
            continue
        if me.startswith("motionlab") and other.startswith("data_synth") and me not in COMPOSERS:
            yield f"{me}:{line}: the library does not know synthetic motion"
        elif (me.startswith("data_synth") and floors[theirs] > SYNTH_CEILING) or floors[theirs] >= floors[mine]:
            yield f"{me}:{line} (floor {floors[mine]}) imports {other} (floor {floors[theirs]})"
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.level:
            yield f"{me}:{node.lineno}: relative import"
        if isinstance(node, ast.Assert):
            yield f"{me}:{node.lineno}: assert in the library; raise an error that says what to do"
    lines = len(path.read_text(encoding="utf-8").splitlines())
    if lines > 300:
        yield f"{me}: {lines} lines; is it more than one idea?"


def cycle(root: Path = ROOT) -> list[str]:
    """Modules that import each other in a circle, or nothing."""
    paths = {name_of(path, root): path for path in modules(root)}
    needs = {me: {other for _, other in imports(path, set(paths)) if other in paths} for me, path in paths.items()}
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as error:
        return error.args[1]
    return []


@pytest.mark.parametrize("path", modules(), ids=lambda path: name_of(path, ROOT))
def test_module_keeps_to_its_floor(path):
    found = list(problems(path))
    assert not found, "\n".join(found)


def test_no_module_imports_itself_through_others():
    assert not cycle()


def test_every_floor_entry_exists():
    names = {name_of(path, ROOT) for path in modules()}
    assert not set(FLOORS) - names, f"FLOORS names modules that do not exist: {sorted(set(FLOORS) - names)}"


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("motionlab/low.py", "import motionlab.high", "imports motionlab.high"),
        ("motionlab/low.py", "from motionlab import high", "imports motionlab.high"),
        ("motionlab/low.py", "def f():\n    from motionlab.high import x", "imports motionlab.high"),
        ("motionlab/low.py", "from . import errors", "relative import"),
        ("motionlab/low.py", "assert 1", "assert in the library"),
        ("motionlab/low.py", "x = 1\n" * 301, "301 lines"),
        ("motionlab/io/deep.py", "from motionlab import high", "imports motionlab.high"),
        ("motionlab/stranger.py", "", "has no floor"),
        ("data_synth/truth.py", "from motionlab import judge", "imports motionlab.judge"),
        ("motionlab/judge.py", "from data_synth import truth", "does not know synthetic motion"),
    ],
)
def test_control_bad_module_is_found(tmp_path, module, source, complaint):
    floors = {"motionlab.low": 1, "motionlab.high": 6, "motionlab.io": 4, "motionlab.judge": 5, "data_synth": 9}
    path = tmp_path / module
    path.parent.mkdir(parents=True)
    path.write_text(source, encoding="utf-8")
    assert any(complaint in problem for problem in problems(path, tmp_path, floors))


def test_control_good_module_passes(tmp_path):
    path = tmp_path / "motionlab/high.py"
    path.parent.mkdir()
    path.write_text("import json\nfrom motionlab import low\nfrom motionlab.low import f\n", encoding="utf-8")
    assert not list(problems(path, tmp_path, {"motionlab.low": 1, "motionlab.high": 2}))


def test_control_cycle_is_found(tmp_path):
    (tmp_path / "motionlab/io").mkdir(parents=True)
    (tmp_path / "motionlab/io/bvh.py").write_text("from motionlab.io import amc", encoding="utf-8")
    (tmp_path / "motionlab/io/amc.py").write_text("import motionlab.io.bvh", encoding="utf-8")
    assert set(cycle(tmp_path)) == {"motionlab.io.bvh", "motionlab.io.amc"}
