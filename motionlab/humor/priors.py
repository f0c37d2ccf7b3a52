"""The three priors of a fit together: over transitions, over poses, over first states.

In the states of official files ``trans`` is SMPL's translation and the pelvis lies at trans + J_0, J_0 constant. Here
``trans`` is the pelvis itself. In any canonical frame the two states differ by one constant vector,

    official = ours + k,    k: -J_0z in the height of trans, (J_0x, J_0y) in every joint, 0 elsewhere,

so that W (x + k) + b = W x + (b + W k): official networks are moved to our states, exactly, by their first biases, an
official mixture by its means. What a transition adds stays the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor import checkpoint, init_gmm, state
from motionlab.humor.cvae import Cvae, load_official
from motionlab.humor.init_gmm import InitGmm
from motionlab.humor.pose_prior import PosePrior, load_vposer

#: Suffixes of files that torch wrote: the official code's checkpoints, VPoser's snapshots.
TORCH = (".pth", ".pt", ".ckpt", ".tar")
Pelvis = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Priors:
    """motion: over transitions. pose: over the pose of one frame. initial: over the first state. All frozen."""

    motion: Cvae
    pose: PosePrior
    initial: InitGmm


@cache
def load(
    name: str = "compact",
    *,
    motion: Path | str | None = None,
    pose: Path | str | None = None,
    initial: Path | str | None = None,
    pelvis: Pelvis | None = None,
) -> Priors:
    """The priors that ship with the project, ``humor_NAME``, ``pose_prior_NAME``, ``init_gmm_NAME``; or files instead.

    A file's suffix says whose it is: torch's (``TORCH``) is an official HuMoR checkpoint or a VPoser snapshot, .npz
    the official mixture, anything else a checkpoint of this project. Loaded once.

    Differs: a fit with official files poses our skeleton, not SMPL's body.

    Args:
        pelvis: J_0, metres: the pelvis from SMPL's translation, of the mean body that an official motion or initial
            prior was trained with. Zeros where its ``trans`` was the pelvis.

    Raises:
        DataError: a file is missing, damaged or of something else; an official one without ``pelvis``, or ``pelvis``
            without one or not in metres.
    """
    moved = {"motion": _suffix(motion) in TORCH, "initial": _suffix(initial) == ".npz"}
    official = next((path for path, yes in ((motion, moved["motion"]), (initial, moved["initial"])) if yes), None)
    if official is not None and pelvis is None:
        raise DataError(
            "its states are of SMPL's translation, and a fit needs to know where the pelvis lies from there",
            path=official,
            remedy="give pelvis, J_0 = (J_regressor @ v_template)[0] of its SMPL+H body in metres; 0 0 0 where trained "
            "with trans as the pelvis",
        )
    if official is None and pelvis is not None:
        raise DataError("pelvis: no official motion or initial prior that it moves", remedy="leave it out")
    if pelvis is not None and not all(abs(x) < 2 for x in pelvis):
        raise DataError(f"pelvis: expected metres, got {pelvis}", remedy="give its x, y and z")
    found = Priors(
        load_official(motion) if moved["motion"] else checkpoint.motion_prior(str(motion or f"humor_{name}")),
        load_vposer(pose) if _suffix(pose) in TORCH else _ours_pose(str(pose or f"pose_prior_{name}")),
        init_gmm.load_official(initial) if moved["initial"] else _ours_initial(str(initial or f"init_gmm_{name}")),
    )
    if pelvis is None:
        return found
    return Priors(
        at_pelvis(found.motion, pelvis) if moved["motion"] else found.motion,
        found.pose,
        mixture_at_pelvis(found.initial, pelvis) if moved["initial"] else found.initial,
    )


def _suffix(path: Path | str | None) -> str:
    return "" if path is None else Path(path).suffix.lower()


def _shift(pelvis: Pelvis) -> Tensor:
    """k (339,) above."""
    x, y, z = pelvis
    parts = {name: torch.zeros(shape) for name, shape in state.SHAPES.items()}
    parts["trans"][2] = -z
    parts["joints"][:, :2] = torch.tensor([x, y])
    return state.pack(parts)


def at_pelvis(model: Cvae, pelvis: Pelvis) -> Cvae:
    """An official model, changed in place so that ``trans`` of its states is the pelvis."""
    with torch.no_grad():
        for net, states in ((model.encoder, 2), (model.prior_net, 1), (model.decoder, 1)):
            first, k = net.net[0], _shift(pelvis).repeat(states)
            first.bias += first.weight[:, : len(k)] @ k.to(first.weight)
    return model


def mixture_at_pelvis(mixture: InitGmm, pelvis: Pelvis) -> InitGmm:
    """An official mixture over first states whose ``trans`` is the pelvis."""
    k = init_gmm.features(_shift(pelvis)).to(mixture.means)
    return InitGmm(mixture.weights, mixture.means - k, mixture.covariances)


@cache
def pose(name: str = "pose_prior_compact") -> PosePrior:
    """A pose prior of this project, by name or by path.

    Raises:
        DataError: no such checkpoint, damaged, or of something else.
    """
    tensors, path = _tensors(name)
    model = PosePrior()
    counts = {key: value for key, value in model.state_dict().items() if key.endswith("num_batches_tracked")}
    try:
        model.load_state_dict(counts | {key: value.float() for key, value in tensors.items()})
    except RuntimeError as error:
        what = str(error).splitlines()[-1].strip()
        raise DataError(f"not a pose prior: {what}", path=path, remedy=checkpoint.REMEDY) from error
    _finite(tensors, path)
    return model.frozen()


@cache
def initial(name: str = "init_gmm_compact") -> InitGmm:
    """A mixture over first states of this project, by name or by path.

    Raises:
        DataError: no such checkpoint, damaged, or of something else.
    """
    tensors, path = _tensors(name)
    _finite(tensors, path)
    return init_gmm.from_tensors(tensors, path)


_ours_pose, _ours_initial = pose, initial  # within ``load`` these names are arguments


def _tensors(name: str) -> tuple[dict[str, Tensor], Path]:
    path = checkpoint.SHIPPED / name if Path(name).name == name else Path(name)
    return checkpoint.load(path)[0], path


def _finite(tensors: dict[str, Tensor], path: Path) -> None:
    for name, value in tensors.items():
        if not value.isfinite().all():
            raise DataError("numbers that are not finite", path=path, place=name, remedy=checkpoint.REMEDY)
