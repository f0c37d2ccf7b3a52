"""pyproject.toml, constraints.txt and environment.yml agree, and the running environment is the one they describe."""

import ast
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from motionlab.commands.doctor import _normal_name, _read_pins
from tests import pins

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ASKED = [Requirement(line) for line in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["dev"]]
PINS = _read_pins(ROOT / "constraints.txt")


def needed(asked, seen):
    """Names of everything that `asked` pulls in on this machine, itself included; seen: by name and extra."""
    for each, extra in ((r, extra) for r in asked for extra in ("", *r.extras)):
        if (key := (_normal_name(each.name), extra)) not in seen:
            seen.add(key)
            further = map(Requirement, metadata.requires(each.name) or [])
            needed([r for r in further if r.marker is None or r.marker.evaluate({"extra": extra})], seen)
    return {name for name, _ in seen}


def imported(folder):
    """Top-level names of the modules that the files of a folder import, wherever in the file."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from (alias.name.split(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and not node.level:
                yield node.module.split(".")[0]


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


def test_control_undeclared_imports_are_found(tmp_path):
    (tmp_path / "a.py").write_text("import os, beside\nfrom yaml import x\ndef f():\n    import networkx.algorithms\n")
    (tmp_path / "beside.py").touch()
    assert undeclared(tmp_path, [Requirement("numpy")]) == {"yaml", "networkx"}
    assert undeclared(tmp_path, [Requirement("PyYAML>1"), Requirement("networkx")]) == set()


def disagreements(asked, known):
    """What pyproject.toml asks for and the pins do not give."""
    given = {r.name: known.get(_normal_name(r.name)) for r in asked}
    return [r.name for r in asked if given[r.name] is None or not r.specifier.contains(given[r.name])]


def test_the_three_lists_agree():
    assert not disagreements(ASKED, PINS)
    assert pins.environment(PINS) == (ROOT / "environment.yml").read_text(encoding="utf-8")
    asked = [Requirement("torch"), Requirement("pyvista[jupyter]>=1"), Requirement("six")]
    assert disagreements(asked, {"torch": "2.0", "pyvista": "0.9"}) == ["pyvista", "six"]  # control


def test_every_package_that_is_pulled_in_is_pinned():
    pulled = needed(ASKED, set())
    of_torch = {name for name in pulled if name.startswith(("nvidia-", "cuda-", "triton"))}  # it pins them itself
    assert not pulled - set(PINS) - of_torch - {"setuptools", "pip"}
