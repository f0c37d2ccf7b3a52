"""Trained weights on disk: tensors as safetensors, and beside them the recipe they come from, as JSON.

A checkpoint is written whole or not at all, and says by a checksum in its recipe which tensors belong to it. Nothing in
it is executed.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from motionlab.errors import DataError
from motionlab.files import write_whole

Network = TypeVar("Network", bound=nn.Module)
#: Where the weights that ship with the project lie.
SHIPPED = Path(__file__).parent / "checkpoints"
_LOADED: dict[str, str] = {}  # what this process has read: name and checksum
REMEDY = "train it again (python -m motionlab train --help), or take the file from the project's repository"


def save(path: Path | str, tensors: Mapping[str, Tensor], recipe: dict, exact: tuple[str, ...] = ("",)) -> None:
    """Writes ``path`` (.safetensors) and its recipe (.json): first the tensors, then the recipe with their checksum.

    exact: how names begin of tensors that are not written as float16; all do."""
    path = Path(path).with_suffix(".safetensors")
    halved = {name: x if name.startswith(exact) else x.half() for name, x in tensors.items()}
    content = save_tensors({name: x.detach().cpu().contiguous() for name, x in halved.items()})
    recipe = recipe | {"sha256": hashlib.sha256(content).hexdigest()}
    write_whole(path, content)
    write_whole(path.with_suffix(".json"), json.dumps(recipe, indent=1) + "\n")


def load(path: Path | str) -> tuple[dict[str, Tensor], dict]:
    """Reads the tensors, as they were stored, and the recipe.

    With $MOTIONLAB_NUDGE set to a seed, each number is off by about 1 part in 10^7, as rounding on another machine
    might have it: what a fingerprint must stand (``suite.execute``).

    Raises:
        DataError: a file is missing, damaged or half written, or the two do not belong together.
    """
    path = Path(path).with_suffix(".safetensors")
    recipe = read_recipe(path)
    with rebuilding(path, "no tensors"):
        content = path.read_bytes()
        tensors = load_tensors(content)
    if recipe.get("sha256") != hashlib.sha256(content).hexdigest():
        raise DataError("not the tensors that its recipe describes", path=path, place="sha256", remedy=REMEDY)
    _LOADED[path.stem] = recipe["sha256"][:12]
    if seed := os.environ.get("MOTIONLAB_NUDGE"):
        generator = torch.Generator().manual_seed(int(seed))
        for name, x in sorted(tensors.items()):  # safetensors gives them in another order each time
            if x.is_floating_point():
                tensors[name] = x.float() * (1 + 1e-7 * torch.randn(x.shape, generator=generator))
    return tensors, recipe


def loaded() -> dict[str, str]:
    """Returns the checkpoints that this process has loaded, by name, with the head of their checksum."""
    return dict(sorted(_LOADED.items()))


def read_recipe(path: Path | str) -> dict:
    """Reads the recipe of a checkpoint.

    Raises:
        DataError: it is missing or not JSON.
    """
    path = Path(path).with_suffix(".json")
    with rebuilding(path, "no recipe"):
        if isinstance(found := json.loads(path.read_text(encoding="utf-8")), dict):
            return found
        raise ValueError("no object")


def shipped(name: str) -> Path:
    """Returns where a model lies: one that ships, by its name, or the one at a path."""
    return SHIPPED / name if Path(name).name == name else Path(name)


@contextmanager
def rebuilding(path: Path | str, complaint: str) -> Iterator[None]:
    """Turns what goes wrong while a checkpoint is read, or a network built of one of another, into a DataError."""
    try:
        yield
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        said = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        raise DataError(f"{complaint} ({said})"[:300], path=path, remedy=REMEDY) from error


def frozen(build: Callable[[], Network], tensors: Mapping[str, Tensor], prefix: str = "") -> Network:
    """Builds a network with those tensors whose names begin so; torch's own generator stays as it is."""
    with torch.random.fork_rng(devices=[]):
        model = build()
    model.load_state_dict({n.removeprefix(prefix): x.float() for n, x in tensors.items() if n.startswith(prefix)})
    return model.eval().requires_grad_(False)


def load_foreign(path: Path | str, key: str, remedy: str) -> dict[str, Tensor]:
    """Reads the tensors of a state dict that somebody else saved with torch, by name, without 'module.'.

    The file holds it under ``key``, or is one itself. Nothing in it is executed.

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
    inside = content[key] if isinstance(content.get(key), dict) else content
    found = {str(name).removeprefix("module."): value for name, value in inside.items() if isinstance(value, Tensor)}
    if not found:
        raise DataError("no state dict inside", path=path, remedy=remedy)
    return found


def keep(path: Path, tensors: Mapping[str, Tensor], about: object) -> None:
    """Writes what took long to make, with what JSON says about it: what :func:`kept` reads."""
    tensors, text = {name: x.contiguous().clone() for name, x in tensors.items()}, json.dumps(about)
    write_whole(path, save_tensors(tensors, {"about": text, "sum": _sum(tensors, text)}))


def kept(path: Path) -> tuple[dict[str, Tensor], Any] | None:
    """Returns the tensors that :func:`keep` wrote, and what it said about them; None where nothing is, or damaged."""
    try:
        with safe_open(path, "pt") as file:
            said, tensors = file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}
        return (tensors, json.loads(said["about"])) if said["sum"] == _sum(tensors, said["about"]) else None
    except (OSError, SafetensorError, KeyError, ValueError):
        return None


def _sum(tensors: Mapping[str, Tensor], about: str) -> str:
    whole = hashlib.sha256(about.encode())
    for name in sorted(tensors):
        whole.update(name.encode() + tensors[name].contiguous().numpy().tobytes())
    return whole.hexdigest()
