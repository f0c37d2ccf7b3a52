"""pyproject.toml, constraints.txt and environment.yml agree, and the running environment is the one they describe."""

import ast
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

from motionlab.doctor import _normal_name, _read_pins

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ASKED = [Requirement(line) for line in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["dev"]]
PINS = _read_pins(ROOT / "constraints.txt")
#: What `make interop` asks from an environment of its own, and for the extra `detect`.
APART = {
    _normal_name(line.split("==")[0])
    for name in ("requirements.txt", "detect.txt")
    for line in (ROOT / "tests/interop" / name).read_text(encoding="utf-8").splitlines()
    if "==" in line
}
CONDA = yaml.safe_load((ROOT / "environment.yml").read_text(encoding="utf-8"))
CONDA_PIP = next(entry["pip"] for entry in CONDA["dependencies"] if isinstance(entry, dict))
CONDA_PINS = dict(line.split("==") for line in CONDA_PIP if "==" in line)


def disagreements(asked, pins, conda):
    """What the three lists do not agree on; conda has {"name[extra]": version}."""
    conda_names = {_normal_name(name.split("[")[0]): name for name in conda}
    for requirement in asked:
        name = _normal_name(requirement.name)
        if name not in pins:
            yield f"{name}: not in constraints.txt"
        elif not requirement.specifier.contains(pins[name]):
            yield f"{name}: pyproject.toml wants {requirement.specifier}, constraints.txt has {pins[name]}"
        if name not in conda_names:
            yield f"{name}: not in environment.yml"
        elif conda[conda_names[name]] != pins.get(name):
            yield f"{name}: environment.yml has {conda[conda_names[name]]}, constraints.txt {pins.get(name)}"
        elif set(re.findall(r"\w+", conda_names[name].partition("[")[2])) != requirement.extras:
            yield f"{name}: environment.yml asks for other extras than pyproject.toml"
    for name in set(conda_names) - {_normal_name(requirement.name) for requirement in asked}:
        yield f"{name}: in environment.yml, not in pyproject.toml"


def needed(asked):
    """Names of everything that `asked` pulls in on this machine, itself included."""
    todo = [(_normal_name(r.name), extra) for r in asked for extra in ["", *r.extras]]
    seen = set()
    while todo:
        name, extra = todo.pop()
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        for line in metadata.requires(name) or []:
            r = Requirement(line)
            if r.marker is None or r.marker.evaluate({"extra": extra}):
                todo += [(_normal_name(r.name), further) for further in ["", *r.extras]]
    return {name for name, _ in seen}


def imported(folder):
    """Top-level names of the modules that the files of a folder import, wherever in the file."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from (alias.name.split(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and not node.level:
                yield node.module.split(".")[0]
            elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("pytest.importorskip", "import_module"):
                yield from (a.value.split(".")[0] for a in node.args[:1] if isinstance(a, ast.Constant))


def undeclared(folder, asked):
    """Third-party packages that a folder imports and nobody asks for by name."""
    owners = metadata.packages_distributions()
    ours = {"motionlab", "data_synth", "tests", *(path.stem for path in folder.glob("*.py"))}
    names = set(imported(folder)) - set(sys.stdlib_module_names) - ours
    asked = {_normal_name(requirement.name) for requirement in asked}
    return {name for name in names if not {_normal_name(owner) for owner in owners.get(name, [name])} & asked}


@pytest.mark.parametrize("folder", ["motionlab", "data_synth"])
def test_what_the_code_imports_is_a_dependency(folder):
    extras = PROJECT["optional-dependencies"].items()
    optional = [line for name, lines in extras if name != "dev" for line in lines]  # each says so where it is missing
    assert not undeclared(ROOT / folder, [Requirement(line) for line in PROJECT["dependencies"] + optional])


def test_what_the_tests_import_is_a_dependency_or_for_developers():
    beside = {"studies", "suite"}  # beside the notebooks, on pytest's path
    assert undeclared(ROOT / "tests", ASKED) <= beside | APART


def test_control_undeclared_imports_are_found(tmp_path):
    text = "import os, beside\nfrom yaml import x\ndef f():\n    import networkx.algorithms\n"
    (tmp_path / "a.py").write_text(text + 'm = pytest.importorskip("ezc3d.c3d")\n')
    (tmp_path / "beside.py").touch()
    assert undeclared(tmp_path, [Requirement("numpy")]) == {"yaml", "networkx", "ezc3d"}
    assert undeclared(tmp_path, [Requirement("PyYAML>1"), Requirement("networkx"), Requirement("ezc3d")]) == set()


def test_the_three_lists_agree():
    assert not list(disagreements(ASKED, PINS, CONDA_PINS))


def test_every_package_that_is_pulled_in_is_pinned():
    of_torch = {
        name for name in needed(ASKED) if name.startswith(("nvidia-", "cuda-", "triton"))
    }  # it pins them itself
    assert not needed(ASKED) - set(PINS) - of_torch - {"setuptools", "pip"}


GOOD = ([Requirement("torch"), Requirement("pyvista[jupyter]>=1")], {"torch": "2.0", "pyvista": "1.5"})


@pytest.mark.parametrize(
    ("pins", "conda", "complaint"),
    [
        ({"torch": "2.0"}, {"torch": "2.0", "pyvista[jupyter]": "1.5"}, "pyvista: not in constraints.txt"),
        ({"torch": "2.0", "pyvista": "0.9"}, {"torch": "2.0", "pyvista[jupyter]": "0.9"}, "wants >=1"),
        (GOOD[1], {"torch": "2.0"}, "pyvista: not in environment.yml"),
        (GOOD[1], {"torch": "2.1", "pyvista[jupyter]": "1.5"}, "torch: environment.yml has 2.1"),
        (GOOD[1], {"torch": "2.0", "pyvista": "1.5"}, "other extras"),
        (GOOD[1], {"torch": "2.0", "pyvista[jupyter]": "1.5", "six": "1"}, "six: in environment.yml"),
    ],
)
def test_control_disagreement_is_found(pins, conda, complaint):
    assert any(complaint in found for found in disagreements(GOOD[0], pins, conda))


def test_control_agreement_passes():
    assert not list(disagreements(GOOD[0], GOOD[1], {"torch": "2.0", "pyvista[jupyter]": "1.5"}))
