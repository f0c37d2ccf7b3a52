"""Weights that somebody else saved with torch: only tensors are read, nothing in the file is executed."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from motionlab.errors import DataError


def tensors(path: Path | str, keys: str | tuple[str, ...], remedy: str) -> dict[str, Tensor]:
    """The tensors of a state dict by name, without 'module.'; the file holds it under one of ``keys``, the
    first that is there, or is one itself.

    What else a training run has saved beside them is left alone.

    Raises:
        DataError: no such file, not a file of plain tensors, or none in it.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise DataError("there is no such file", path=path, remedy=remedy) from error
    except Exception as error:  # torch names no type for a file that is none of its own
        message = f"not a file of plain tensors ({type(error).__name__})"
        raise DataError(message, path=path, remedy=f"{remedy}; or save its state_dict alone with torch.save") from error
    content = content if isinstance(content, dict) else {}
    names = (keys,) if isinstance(keys, str) else keys
    inside = next((content[name] for name in names if isinstance(content.get(name), dict)), content)
    found = {str(name).removeprefix("module."): value for name, value in inside.items() if isinstance(value, Tensor)}
    if not found:
        raise DataError("no state dict inside", path=path, remedy=remedy)
    return found
