"""Fits that are kept on disk: the same clips, weights, priors and code give the same fit, so that who turns one knob of
a notebook waits for what that knob changes. Below ``$MOTIONLAB_CACHE``, or the user's cache; safe to delete.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

import motionlab
from motionlab.corpus import cache_folder
from motionlab.files import source_hash, write_whole
from motionlab.humor.priors import Priors
from motionlab.observation import Camera, Observation2D

Tensors = dict[str, Tensor]
_USED = ("heading", "motion", "observation", "optimise", "rotation", "skeleton")  # modules of a fit beside ``humor``


def kept(
    compute: Callable[[], Tensors], seen: Observation2D, cameras: Sequence[Camera], priors: Priors,
    how: Mapping[str, object],
) -> Tensors:  # fmt: skip
    """Returns what ``compute`` gives for these clips, cameras, priors and options, as it was kept or computed now.

    how: arguments of ``testops.fit`` whose ``repr`` says all.
    """
    path = cache_folder().with_name("fits") / f"{_key(seen, cameras, priors, how)}.safetensors"
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}
    except (OSError, SafetensorError):  # none there, or a damaged one
        found = {name: value.detach().contiguous() for name, value in compute().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, save(found))
    return found


def _key(seen: Observation2D, cameras: Sequence[Camera], priors: Priors, how: Mapping[str, object]) -> str:
    digest = hashlib.sha256(f"{_code()}{sorted(how.items())!r}{seen.names}{seen.fps}{torch.__version__}".encode())
    for camera in cameras:
        for value in vars(camera).values():
            digest.update(value.numpy().tobytes() if isinstance(value, Tensor) else repr(value).encode())
    weights = [w for model in (priors.motion, priors.pose, priors.initial) for w in _tensors(model)]
    for value in (seen.keypoints, seen.confidence, *weights):
        digest.update(value.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()[:24]


def _tensors(model: object) -> list[Tensor]:
    named = model.state_dict() if isinstance(model, torch.nn.Module) else vars(model)
    return [value for _, value in sorted(named.items()) if isinstance(value, Tensor)]


@cache
def _code() -> str:
    """A hash of what the code of a fit does."""
    root = Path(motionlab.__file__).parent
    files = [*sorted((root / "humor").rglob("*.py")), *(root / f"{name}.py" for name in _USED)]
    return hashlib.sha256("".join(source_hash(f.read_text(encoding="utf-8")) for f in files).encode()).hexdigest()
