"""Loads the three priors of a fit: those that ship with the project, or files of others.

In the states of official files ``trans`` is SMPL's translation and the pelvis lies at trans + J_0, J_0 constant. Here
``trans`` is the pelvis itself. In any canonical frame the two states differ by one constant vector,

    official = ours + k,    k: -J_0z in the height of trans, (J_0x, J_0y) in every joint, 0 elsewhere,

so that W (x + k) + b = W x + (b + W k): official networks are moved to our states, exactly, by their first biases, an
official mixture by its means. What a transition adds stays the same.

Source: the files of HuMoR (Rempe et al. 2021) and of VPoser (Pavlakos et al. 2019), versions 1.0 and 2.0.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from motionlab import checkpoint
from motionlab.errors import DataError, ShapeError
from motionlab.humor import priors, state
from motionlab.humor.priors import BODY_JOINTS, Cvae, InitGmm, PosePrior, Priors, from_weights
from motionlab.io.reading import checked_array, read_npz, reading

#: The priors that ship: ``humor_real``, ``pose_prior_real``, ``init_gmm_real``, learnt from hours of real motion.
DEFAULT = "real"
_TORCH = (".pth", ".pt", ".ckpt", ".tar")  # of the official code's checkpoints, VPoser's snapshots
Pelvis = tuple[float, float, float]  # J_0, metres
_VPOSER_2_SLOPES = (0.01, 1.0, 0.01)
#: Names in VPoser's files of our layers. Between two linear layers of version 2 stands no activation: they become one.
_NAMES_1 = {
    "norm": "bodyprior_enc_bn1", "first": "bodyprior_enc_fc1", "middle_norm": "bodyprior_enc_bn2",
    "second": "bodyprior_enc_fc2", "mean": "bodyprior_enc_mu", "spread": "bodyprior_enc_logvar",
    "out_first": "bodyprior_dec_fc1", "out_second": "bodyprior_dec_fc2", "out": "bodyprior_dec_out",
}  # fmt: skip
_NAMES_2 = {
    "norm": "encoder_net.1", "first": "encoder_net.2", "middle_norm": "encoder_net.4", "second": "encoder_net.6",
    "mean": "encoder_net.8.mu", "spread": "encoder_net.8.logvar",
    "out_first": "decoder_net.0", "out_second": "decoder_net.3", "out": "decoder_net.5",
}  # fmt: skip
_FOLDED = "encoder_net.7"
_PARTS = {True: ("weight", "bias", "running_mean", "running_var"), False: ("weight", "bias")}


@cache
def load_priors(
    name: str = DEFAULT, *, motion: Path | str | None = None, pose: Path | str | None = None,
    initial: Path | str | None = None, pelvis: Pelvis | None = None,
) -> Priors:  # fmt: skip
    """Loads the priors that ship, ``humor_NAME``, ``pose_prior_NAME``, ``init_gmm_NAME``, or files instead.

    A file's suffix says whose it is: torch's (``_TORCH``) is an official HuMoR checkpoint or a VPoser snapshot, .npz
    the official mixture, anything else a checkpoint of this project. A fit with official files poses our skeleton, not
    SMPL's body. Loaded once.

    pelvis: J_0, metres: the pelvis from SMPL's translation, of the mean body that an official motion or initial prior
    was trained with. Zeros where its ``trans`` was the pelvis.

    Raises:
        DataError: a file is missing, damaged or of something else; an official one without ``pelvis``, or ``pelvis``
            without one or not in metres; a motion prior whose velocities are central ones, without ``initial``.
    """
    their_motion, their_initial = _suffix(motion) in _TORCH, _suffix(initial) == ".npz"
    official = motion if their_motion else initial if their_initial else None
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
    model = _official_motion(motion, pelvis) if their_motion else load_motion_prior(str(motion or f"humor_{name}"))
    if initial is None and not model.causal:
        raise DataError(
            "its velocities are central ones, which know the next frame; the first states that ship know the past only",
            path=motion,
            remedy="give the first states it was trained with, too (initial, --initial): prior_gmm.npz of its release",
        )
    mixture = _official_mixture(initial, pelvis) if their_initial else load_initial(str(initial or f"init_gmm_{name}"))
    theirs = _suffix(pose) in _TORCH
    return Priors(model, _vposer(pose) if theirs else load_pose_prior(str(pose or f"pose_prior_{name}")), mixture)


def _suffix(path: Path | str | None) -> str:
    return "" if path is None else Path(path).suffix.lower()


def _shift(pelvis: Pelvis) -> Tensor:
    """k (339,) above."""
    x, y, z = pelvis
    parts = {name: torch.zeros(shape) for name, shape in state.SHAPES.items()}
    parts["trans"][2] = -z
    parts["joints"][:, :2] = torch.tensor([x, y])
    return state.pack(parts)


@torch.no_grad()
def _at_pelvis(model: Cvae, pelvis: Pelvis) -> Cvae:
    """An official model, changed in place so that ``trans`` of its states is the pelvis."""
    for net, states in ((model.encoder, 2), (model.prior_net, 1), (model.decoder, 1)):
        first, k = net.net[0], _shift(pelvis).repeat(states)
        first.bias += first.weight[:, : len(k)] @ k.to(first.weight)
    return model


def _mixture_at_pelvis(mixture: InitGmm, pelvis: Pelvis) -> InitGmm:
    """An official mixture over first states whose ``trans`` is the pelvis."""
    k = priors.first_state_features(_shift(pelvis)).to(mixture.means)
    return InitGmm(mixture.weights, mixture.means - k, mixture.covariances)


@cache
def load_pose_prior(name: str = f"pose_prior_{DEFAULT}") -> PosePrior:
    """Loads a pose prior of this project, by name or by path; DataError: none, damaged, or of something else."""
    path = checkpoint.shipped(name)
    return priors.filled(PosePrior(), checkpoint.load(path)[0], "not a pose prior", path, checkpoint.REMEDY)


@cache
def load_initial(name: str = f"init_gmm_{DEFAULT}") -> InitGmm:
    """Loads a mixture over first states of this project, by name or by path; DataError: none, damaged, or other."""
    path = checkpoint.shipped(name)
    tensors, _ = checkpoint.load(path)
    priors.finite(tensors, path, checkpoint.REMEDY)
    return _mixture_of(tensors, path)


@cache
def load_motion_prior(name: str = f"humor_{DEFAULT}") -> Cvae:
    """Loads a transition prior of this project, by name or by path, frozen; once. DataError: none, or damaged."""
    path = checkpoint.shipped(name)
    return from_weights(checkpoint.load(path)[0], path, checkpoint.REMEDY)


def _official_motion(path: Path | str, pelvis: Pelvis) -> Cvae:
    """A checkpoint of the official code: a dict with 'model', a state dict, perhaps with 'module.' before its names."""
    remedy = "take a checkpoint of the official HuMoR release (50 tensors, 'decoder.net.0.weight' and so on)"
    return _at_pelvis(from_weights(checkpoint.load_foreign(path, "model", remedy), Path(path), remedy), pelvis)


def _official_mixture(path: Path | str, pelvis: Pelvis) -> InitGmm:
    """The official ``prior_gmm.npz``: weights (K,), means (K, 138), covariances (K, 138, 138)."""
    shapes = {"weights": "K", "means": "K D", "covariances": "K D D"}
    with reading(path, "take prior_gmm.npz of the official HuMoR release") as at:
        raw = read_npz(at, tuple(shapes))
        found = {name: torch.from_numpy(checked_array(at, x, shapes[name], name)) for name, x in raw.items()}
    return _mixture_at_pelvis(_mixture_of(found, path), pelvis)


def _mixture_of(tensors: Mapping[str, Tensor], path: Path | str) -> InitGmm:
    """The mixture of arrays ``weights``, ``means``, ``covariances``; ``path`` is for the errors."""
    remedy = "take the official prior_gmm.npz, or a checkpoint of this project"
    try:
        gmm = InitGmm(*(tensors[name] for name in ("weights", "means", "covariances")))
    except KeyError as error:
        raise DataError(f"no {error.args[0]}", path=path, remedy=remedy) from error
    except (ShapeError, DataError) as error:
        raise DataError(f"no mixture of Gaussians: {error}", path=path, remedy=remedy) from error
    if gmm.means.shape[1] != priors.FIRST_STATE_SIZE:
        raise DataError(
            f"expected {priors.FIRST_STATE_SIZE} features, found {gmm.means.shape[1]}", path=path, remedy=remedy
        )
    return gmm


def _vposer(path: Path | str) -> PosePrior:
    """Weights of VPoser 1.0 (``snapshots/*.pt``) or 2.0 (``snapshots/*.ckpt``), by their names; frozen."""
    remedy = "take a file of the snapshots folder of VPoser v1.0 or v2.0, from smpl-x.is.tue.mpg.de"
    named = checkpoint.load_foreign(path, "state_dict", remedy)
    found = {name.removeprefix("vp_model."): value for name, value in named.items()}
    try:
        return _from_vposer(found, Path(path), remedy)
    except (KeyError, RuntimeError, ValueError) as error:
        what = f"no tensor {error}" if isinstance(error, KeyError) else str(error).splitlines()[-1].strip()
        raise DataError(f"not VPoser's weights: {what}", path=path, remedy=remedy) from error


def _from_vposer(found: Mapping[str, Tensor], path: Path, remedy: str) -> PosePrior:
    second = "encoder_net.2.weight" in found
    names, model = (_NAMES_2, PosePrior(3, _VPOSER_2_SLOPES)) if second else (_NAMES_1, PosePrior(3))
    taken = {
        f"{ours}.{part}": found[f"{theirs}.{part}"].float()
        for ours, theirs in names.items()
        for part in _PARTS[ours.endswith("norm")]
    }
    if second:
        weight, bias = (found[f"{_FOLDED}.{part}"].float() for part in _PARTS[False])
        taken["second.bias"] = weight @ taken["second.bias"] + bias
        taken["second.weight"] = weight @ taken["second.weight"]
    # they write the 6 numbers of a joint as (3, 2), column after column being ours
    for part in ("out.weight", "out.bias"):
        if taken[part].shape[0] == 6 * BODY_JOINTS:
            taken[part] = taken[part].unflatten(0, (BODY_JOINTS, 3, 2)).transpose(1, 2).flatten(0, 2)
    return priors.filled(model, taken, "not VPoser's weights", path, remedy)
