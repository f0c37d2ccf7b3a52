"""Writes files whole, the old or the new one and never a part of it; and tells whether code changed."""

from __future__ import annotations

import ast
import contextlib
import hashlib
import os
from pathlib import Path

from motionlab.errors import DataError


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Writes text (UTF-8) or bytes to a temporary file beside ``path``, then renames it into place.

    Raises:
        DataError: the folder is not there or may not be written, or ``path`` is a folder.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        part.replace(path)
    except OSError as error:
        message = f"cannot be written: {error.strerror or error}"
        raise DataError(message, path=path, place="whole file", remedy="name a file in a folder that exists") from error
    finally:
        with contextlib.suppress(OSError):  # not there, or a name that cannot be
            part.unlink()


def source_hash(source: str) -> str:
    """Returns a hash of what Python code does: without comments, layout, documentation and imports."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [part for part in node.body if not _silent(part)] or [ast.Pass()]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:8]


def _silent(node: ast.stmt) -> bool:
    documentation = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return documentation or isinstance(node, ast.Import | ast.ImportFrom)
