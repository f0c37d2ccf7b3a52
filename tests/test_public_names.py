"""A public name of the library has one meaning and two who need it: the library itself and somebody else, two
notebooks, or the stranger for whom docs/library.md names it as API."""

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import motionlab
from tests.test_architecture import LIBRARY, ROOT, STUDIES, modules, notebooks, syntax

#: One meaning everywhere: a file's content as what the module is about, and back.
SAME_EVERYWHERE = {"load", "save"}


@cache
def trees(root: Path = ROOT) -> dict[str, ast.Module]:
    """Syntax of every module, and of every notebook's code cells under its number ("08")."""
    paths = modules(root) | {path.stem.partition("_")[0]: path for path in notebooks(root)}
    return {name: syntax(path) for name, path in paths.items()}


def defined(tree: ast.Module) -> dict[str, str]:
    """Public names that a module has once it is imported: function, class or constant, also of tuples, branches and
    loops."""
    found, todo = {}, list(tree.body)
    while todo:
        node = todo.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            found[node.name] = "function"
        elif isinstance(node, ast.ClassDef):
            found[node.name] = "class"
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found[node.id] = "constant"
        elif not isinstance(node, ast.expr) or isinstance(node, ast.Tuple | ast.List | ast.Starred | ast.NamedExpr):
            todo += ast.iter_child_nodes(node)  # a comprehension's names are its own
    return {name: kind for name, kind in found.items() if not name.startswith("_")}


def users(parsed: dict[str, ast.Module]) -> dict[tuple[str, str], set[str]]:
    """(module, name) of the library -> who uses it: other modules, and notebooks together with their studies."""
    names = {module: defined(tree) for module, tree in parsed.items() if module.split(".")[0] == LIBRARY}
    passed_on = {}  # what a package offers under its own name
    for module in {name.rpartition(".")[0] for name in names} & set(names):
        for node in parsed[module].body:
            if isinstance(node, ast.ImportFrom) and node.module in names:
                passed_on |= {(module, a.asname or a.name): (node.module, a.name) for a in node.names}
    found = defaultdict(set)
    for module, tree in parsed.items():
        parts = module.split(".")
        notebook = re.match(r"nb(\d\d)_", parts[1]) if parts[0] == STUDIES and len(parts) > 1 else None
        who = notebook[1] if notebook else module
        as_module, seen = {}, []
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                as_module |= {a.asname or a.name: a.name for a in node.names if a.name in parsed}
            elif isinstance(node, ast.ImportFrom) and node.module:
                for a in node.names:
                    whole = f"{node.module}.{a.name}"
                    if whole in parsed:
                        as_module[a.asname or a.name] = whole
                    else:
                        seen.append((node.module, a.name))

        def module_of(node: ast.AST, as_module=as_module) -> str | None:
            if isinstance(node, ast.Name):
                return as_module.get(node.id)
            if isinstance(node, ast.Attribute) and (base := module_of(node.value)):
                return whole if (whole := f"{base}.{node.attr}") in parsed else None
            return None

        seen += [
            (base, node.attr) for node in ast.walk(tree)
            if isinstance(node, ast.Attribute) and (base := module_of(node.value))
        ]  # fmt: skip
        for pair in seen:
            at, name = passed_on.get(pair, pair)
            if name in names.get(at, ()) and at != module and (module, name) not in passed_on:
                found[at, name].add(who)
    return found


def api(text: str) -> set[tuple[str, str]]:
    """(module, name) that a page names room by room, in lines such as "- `io.smpl`: `load`"."""
    section = text.partition("\n## Room by room")[2].partition("\n## ")[0]
    found = set()
    for line in re.findall(r"^- `([\w.]+)`: (.*(?:\n  .*)*)", section, re.MULTILINE):
        found |= {(f"{LIBRARY}.{line[0]}", name) for name in re.findall(r"`(\w+)`", line[1])}
    return found


def idle(parsed: dict[str, ast.Module], offered: set[tuple[str, str]]) -> list[str]:
    """Public functions and classes that one notebook uses and nothing else, or nobody, not offered to strangers.

    What another module of the library needs is library. What its own module needs, too, is needed by two where a
    notebook uses it, and private where nobody does. A class may be there as the type that a function gives or takes.
    """
    who, found = users(parsed), []
    for module, tree in parsed.items():
        if module.split(".")[0] != LIBRARY or module == f"{LIBRARY}.__main__":
            continue
        own = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
        for name, kind in defined(tree).items():
            by = who.get((module, name), set())
            notebooks = {user for user in by if user.isdigit()}
            if by - notebooks or len(notebooks) > 1 or (notebooks and name in own) or (module, name) in offered:
                continue
            if kind == "function" or notebooks:
                found.append(f"{module}.{name}: {'only ' + notebooks.pop() if notebooks else 'nobody else'} uses it")
    return found


def ambiguous(parsed: dict[str, ast.Module]) -> list[str]:
    """Public names that several modules of the library define."""
    places = defaultdict(list)
    for module, tree in parsed.items():
        if module.split(".")[0] == LIBRARY:
            for name in defined(tree):
                places[name].append(module)
    return [f"{n}: {', '.join(at)}" for n, at in sorted(places.items()) if len(at) > 1 and n not in SAME_EVERYWHERE]


PAGE = (ROOT / "docs/library.md").read_text(encoding="utf-8")


def test_what_is_public_is_needed():
    """By another module of the library, by two notebooks, or by strangers: then docs/library.md says so."""
    assert not idle(trees(), api(PAGE))


def test_what_the_page_offers_exists():
    parsed = trees()
    assert api(PAGE)
    assert not [f"{m}.{n}" for m, n in sorted(api(PAGE)) if m not in parsed or n not in defined(parsed[m])]
    rooms = set(re.findall(r"`(\w+)", " ".join(re.findall(r"^- (`.*?`): ", PAGE, re.MULTILINE))))
    assert {"heading", "io"} <= rooms <= set(motionlab.__all__)


def test_a_public_name_has_one_meaning():
    assert not ambiguous(trees())


def test_control_idle_and_ambiguous_names_are_found():
    parse = ast.parse
    parsed = {
        "motionlab.a": parse("def lonely(): ...\ndef shared(): ...\ndef inner(): ...\nclass Type: ...\nload = 1"),
        "motionlab.b": parse("from motionlab.a import inner\nfrom motionlab import a\ndef shared(): ...\nload = 2"),
        "studies.nb03_x.y": parse("from motionlab import a\na.lonely()\na.shared()"),
        "03": parse("from motionlab.a import lonely"),
        "04": parse("import motionlab.a as m\nm.shared()"),
    }
    found = idle(parsed, set())
    assert found == ["motionlab.a.lonely: only 03 uses it", "motionlab.b.shared: nobody else uses it"]
    assert not idle(parsed, {("motionlab.a", "lonely"), ("motionlab.b", "shared")})
    assert ambiguous(parsed) == ["shared: motionlab.a, motionlab.b"]
    nested = (
        "A, (B, *C) = f\nif A:\n    D: int = 1\nelse:\n    def d(): E = 1\nfor F in [x for x in A]:\n    _G = F.H = 1"
    )
    assert set(defined(parse(nested))) == {"A", "B", "C", "D", "d", "F"}
