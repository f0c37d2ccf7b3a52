"""`make doctor`: lines and lines of code (without blank ones, comments and docstrings) of every room."""

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("motionlab", "data_synth", "notebooks/studies", "notebooks/suite", "tests")
_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
_WITH_DOCSTRING = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def lines(text: str) -> tuple[int, int]:
    """Lines of a module, and those of code."""
    rows = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            rows |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, _WITH_DOCSTRING) and ast.get_docstring(node, clean=False) is not None:
            rows -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return len(text.splitlines()), len(rows)


def table(root: Path = ROOT) -> str:
    """A line for every room; of motionlab one for each of its own rooms as well, and its modules together."""
    found: dict[str, Counter] = {}
    for room in ROOMS:
        for path in sorted((root / room).rglob("*.py")):
            whole, code = lines(path.read_text(encoding="utf-8"))
            inner = path.relative_to(root / room).parts[0] if room == "motionlab" else ""
            for name in (room, f"  {inner}") if inner and not inner.endswith(".py") else (room,):
                found.setdefault(name, Counter()).update(files=1, lines=whole, code=code)
    width = max(map(len, found))
    return "\n".join(f"{name:<{width}} {n['files']:4} files {n['lines']:6} lines {n['code']:6} of code"
                     for name, n in found.items())  # fmt: skip


if __name__ == "__main__":
    print(table())
