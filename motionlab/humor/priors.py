"""The three priors of a fit together: over transitions, over poses, over first states."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from torch import Tensor

from motionlab.errors import DataError
from motionlab.humor import checkpoint, init_gmm
from motionlab.humor.cvae import Cvae
from motionlab.humor.init_gmm import InitGmm
from motionlab.humor.pose_prior import PosePrior


@dataclass(frozen=True, eq=False)
class Priors:
    """motion: over transitions. pose: over the pose of one frame. initial: over the first state. All frozen."""

    motion: Cvae
    pose: PosePrior
    initial: InitGmm


@cache
def load(name: str = "compact") -> Priors:
    """The priors that ship with the project: ``humor_NAME``, ``pose_prior_NAME``, ``init_gmm_NAME``; loaded once.

    Raises:
        DataError: one of them is missing or damaged.
    """
    return Priors(checkpoint.motion_prior(f"humor_{name}"), pose(f"pose_prior_{name}"), initial(f"init_gmm_{name}"))


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


def _tensors(name: str) -> tuple[dict[str, Tensor], Path]:
    path = checkpoint.SHIPPED / name if Path(name).name == name else Path(name)
    return checkpoint.load(path)[0], path


def _finite(tensors: dict[str, Tensor], path: Path) -> None:
    for name, value in tensors.items():
        if not value.isfinite().all():
            raise DataError("numbers that are not finite", path=path, place=name, remedy=checkpoint.REMEDY)
