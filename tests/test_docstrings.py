"""A public function or method says what it does in a sentence that begins with a verb: "Computes X from Y"."""

import ast

import pytest

from tests.test_architecture import LIBRARY, modules

#: The verbs in use. "Samples" is not among them, nor "Windows" or "Errors": such a first word may be a noun.
VERBS = frozenset(
    """Adds Averages Bends Builds Changes Checks Chooses Closes Compares Computes Converts Counts Cuts Draws Fills Finds
    Fits Holds Installs Interpolates Joins Limits Lists Loads Lowers Makes Measures Minimises Mirrors Moves Opens
    Projects Puts Reads Records Remembers Removes Returns Runs Says Searches Shows Smooths Stacks Starts Stores Takes
    Trains Turns Walks Writes""".split()
)
#: Modules that are being rewritten; leave them out here when they are done.
SKIPPED = {"corpus", "motion", "humor.compiled", "humor.training"}


def is_property(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """A property may be described by what it is."""
    return any(ast.unparse(each).endswith("property") for each in node.decorator_list)


def without_verb(tree: ast.AST) -> list[str]:
    """Public functions, and public methods of public classes, whose docstring begins with another word, or that have
    none."""
    found = []
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            found += [f"{node.name}.{each}" for each in without_verb(node)]
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_"):
            said = (ast.get_docstring(node) or "").split()
            if not is_property(node) and (said[0].rstrip(",") if said else None) not in VERBS:
                found.append(f"{node.name}: {' '.join(said[:5])}")
    return found


def test_public_functions_say_what_they_do():
    paths = {name: path for name, path in modules().items() if name.split(".")[0] == LIBRARY}
    found = [
        f"{name}.{each}"
        for name, path in paths.items()
        if name.removeprefix(f"{LIBRARY}.") not in SKIPPED
        for each in without_verb(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("said", ["Compute x.", "The sum of x.", "Windows (N, T) of x.", "See f.", ""])
def test_control_another_first_word_is_found(said):
    for head in ("def f():", "async def f():", "class C:\n  @classmethod\n  def f():"):
        assert len(without_verb(ast.parse(f'{head} """{said}"""'))) == 1, head
        assert not without_verb(ast.parse(f'{head} """Computes, from y, x."""'))
        assert not without_verb(ast.parse(f'{head} """{said}"""'.replace("def f", "def _f")))
    assert not without_verb(ast.parse(f'class C:\n  @cached_property\n  def f(): """{said}"""'))
    assert without_verb(ast.parse("def f(): pass"))
    assert all(verb.endswith("s") for verb in VERBS)
