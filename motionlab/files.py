"""Writes files whole, the old or the new one and never a part of it; and tells whether code changed."""

import ast
import contextlib
import hashlib
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from motionlab.errors import DataError, MissingData


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Writes text (UTF-8) or bytes to a temporary file beside ``path``, then renames it into place.

    Raises:
        DataError: the folder is not there or may not be written, or ``path`` is a folder.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with writing(path, "name a file in a folder that exists", "whole file"):
            part.write_bytes(content.encode() if isinstance(content, str) else content)
            part.replace(path)
    finally:
        with contextlib.suppress(OSError):  # not there, or a name that cannot be
            part.unlink()


@contextlib.contextmanager
def writing(out: Path, remedy: str = "make room or name another folder: --out OUT/", place: str = "") -> Iterator[None]:
    """Turns what the system says of a file or folder that cannot be written into a sentence.

    Raises:
        DataError: whatever ``OSError`` the block raised.
    """
    try:
        yield
    except MissingData:
        raise
    except OSError as error:
        message = f"cannot be written: {error.strerror or error}"
        raise DataError(message, path=out, place=place, remedy=remedy) from error


@cache  # the same files for every corpus
def source_hash(source: str) -> str:
    """Returns a hash of what Python code does: without comments, layout, documentation and imports."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            told = [part for part in node.body if not isinstance(part, ast.Import | ast.ImportFrom)]
            texts = [part for part in told if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant)]
            node.body = [part for part in told if part not in texts] or [ast.Pass()]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:8]
