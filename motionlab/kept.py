"""Training runs on disk: written whole or not at all, read without executing anything."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch

from motionlab.errors import DataError

AFRESH = "start afresh, without --resume"


def write(path: Path | str, content: Mapping[str, object]) -> None:
    """Write plain values and tensors; a reader never sees half a file."""
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    torch.save(dict(content), part)
    part.replace(path)


def read(path: Path | str) -> dict:
    """What :func:`write` wrote, on the CPU.

    Raises:
        DataError: the file is missing, damaged or not of this kind.
    """
    with reading(path):
        return torch.load(path, map_location="cpu", weights_only=True)


@contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """Whatever goes wrong inside is a DataError that names the file."""
    try:
        yield
    except Exception as error:
        raise DataError(f"not a saved run ({type(error).__name__})", path=path, remedy=AFRESH) from error
