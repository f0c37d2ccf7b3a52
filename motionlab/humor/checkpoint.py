"""Trained weights on disk: tensors as safetensors, and beside them the recipe they come from, as JSON.

A checkpoint is written whole or not at all, and says by a checksum in its recipe which tensors belong to it. Nothing in
it is executed.
"""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor.cvae import Cvae, from_weights
from motionlab.writing import write_whole

#: Where the weights that ship with the project lie.
SHIPPED = Path(__file__).parents[1] / "checkpoints"
REMEDY = "train it again (python -m motionlab train --help), or take the file from the project's repository"


def save(path: Path | str, tensors: dict[str, Tensor], recipe: dict) -> None:
    """Write ``path`` (.safetensors) and its recipe (.json): first the tensors, then the recipe with their checksum."""
    path = Path(path).with_suffix(".safetensors")
    content = save_tensors({name: value.detach().cpu().contiguous() for name, value in tensors.items()})
    recipe = recipe | {"sha256": hashlib.sha256(content).hexdigest()}
    write_whole(path, content)
    write_whole(path.with_suffix(".json"), json.dumps(recipe, indent=1) + "\n")


def load(path: Path | str) -> tuple[dict[str, Tensor], dict]:
    """The tensors, as they were stored, and the recipe.

    Raises:
        DataError: a file is missing, damaged or half written, or the two do not belong together.
    """
    path = Path(path).with_suffix(".safetensors")
    recipe = read_recipe(path)
    try:
        content = path.read_bytes()
        if recipe.get("sha256") != hashlib.sha256(content).hexdigest():
            raise DataError("not the tensors that its recipe describes", path=path, place="sha256", remedy=REMEDY)
        return load_tensors(content), recipe
    except OSError as error:
        raise DataError(error.strerror or str(error), path=path, remedy=REMEDY) from error
    except SafetensorError as error:
        raise DataError(f"damaged: {error}", path=path, remedy=REMEDY) from error


def read_recipe(path: Path | str) -> dict:
    """The recipe of a checkpoint.

    Raises:
        DataError: it is missing or not JSON.
    """
    path = Path(path).with_suffix(".json")
    try:
        recipe = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(error.strerror or str(error), path=path, remedy=REMEDY) from error
    except ValueError as error:
        raise DataError(f"not JSON: {error}", path=path, remedy=REMEDY) from error
    if not isinstance(recipe, dict):
        raise DataError("not a recipe", path=path, remedy=REMEDY)
    return recipe


@cache
def motion_prior(name: str = "humor_compact") -> Cvae:
    """A transition prior that ships with the project (by name) or lies at a path, frozen; loaded once.

    Raises:
        DataError: no such checkpoint, or damaged.
    """
    path = SHIPPED / name if Path(name).name == name else Path(name)
    tensors, _ = load(path)
    return from_weights({key: value.float() for key, value in tensors.items()}, path, REMEDY)
