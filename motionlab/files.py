"""Writes files whole: the old file or the new one is there, never a part of it."""

from __future__ import annotations

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
        part.unlink(missing_ok=True)
