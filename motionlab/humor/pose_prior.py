"""A prior over poses: a variational autoencoder from 21 joint rotations to 32 numbers and back.

    rotations -> BatchNorm, 512, BatchNorm, 512 -> mean, deviation (32);   latent (32) -> 512, 512 -> 6D -> rotations

Rotations are relative to the parent, pelvis left out; in training the latents of people are drawn to N(0, 1).

Source: VPoser (Pavlakos et al. 2019), as HuMoR uses it.
Differs: ours reads 6 numbers per joint, which are continuous, where VPoser reads rotation vectors.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor, nn
from torch.nn import functional as F

from motionlab import rotation
from motionlab.errors import DataError, check_shape
from motionlab.humor import foreign
from motionlab.humor.cvae import Gaussian

LATENT, JOINTS, WIDTH = 32, 21, 512
#: Slopes below zero of the three activations, encoder's first and second, decoder's.
VPOSER_1, VPOSER_2 = (0.2, 0.2, 0.2), (0.01, 1.0, 0.01)
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


class PosePrior(nn.Module):
    """Encoder and decoder of poses.

    numbers: that describe a joint's rotation at the encoder's door: 6, or 3 for a rotation vector.
    slopes: of the three activations below zero.
    """

    def __init__(self, numbers: int = 6, slopes: tuple[float, float, float] = VPOSER_1) -> None:
        super().__init__()
        self.numbers, self.slopes = numbers, slopes
        self.norm = nn.BatchNorm1d(JOINTS * numbers)
        self.first, self.middle_norm = nn.Linear(JOINTS * numbers, WIDTH), nn.BatchNorm1d(WIDTH)
        self.second = nn.Linear(WIDTH, WIDTH)
        self.mean, self.spread = nn.Linear(WIDTH, LATENT), nn.Linear(WIDTH, LATENT)
        self.out_first, self.out_second = nn.Linear(LATENT, WIDTH), nn.Linear(WIDTH, WIDTH)
        self.out = nn.Linear(WIDTH, 6 * JOINTS)

    def encode(self, rot: Tensor) -> Gaussian:
        """Distribution of the latent (..., 32) of local rotations (..., 21, 3, 3)."""
        check_shape(rot, f"... {JOINTS} 3 3", "rot")
        said = rotation.matrix_to_sixd(rot) if self.numbers == 6 else rotation.log(rot)
        x = self.norm(said.reshape(-1, JOINTS * self.numbers))
        x = self.middle_norm(F.leaky_relu(self.first(x), self.slopes[0]))
        x = F.leaky_relu(self.second(x), self.slopes[1])
        log_var = 2 * F.softplus(self.spread(x)).clamp(min=1e-6).log()
        return Gaussian(*(y.unflatten(0, rot.shape[:-3]) if rot.ndim > 3 else y[0] for y in (self.mean(x), log_var)))

    def decode(self, latent: Tensor) -> Tensor:
        """Local rotations (..., 21, 3, 3) of latents (..., 32)."""
        check_shape(latent, f"... {LATENT}", "latent")
        x = F.leaky_relu(self.out_first(latent), self.slopes[2])
        x = F.leaky_relu(self.out_second(x), self.slopes[2])
        return rotation.sixd_to_matrix(self.out(x).unflatten(-1, (JOINTS, 6)))

    def frozen(self) -> PosePrior:
        """Itself, in evaluation mode, its weights without gradients: what a fit wants."""
        return self.eval().requires_grad_(requires_grad=False)


def load_vposer(path: Path | str) -> PosePrior:
    """Weights of VPoser 1.0 (``snapshots/*.pt``) or 2.0 (``snapshots/*.ckpt``), by their names; frozen.

    Only tensors are read, nothing in the file is executed. What else a training run has saved is left alone.

    Raises:
        DataError: not such a file, damaged, or with other names, shapes or numbers.
    """
    remedy = "take a file of the snapshots folder of VPoser v1.0 or v2.0, from smpl-x.is.tue.mpg.de"
    named = foreign.tensors(path, "state_dict", remedy)
    found = {name.removeprefix("vp_model."): value for name, value in named.items()}
    try:
        return _from_vposer(found)
    except (KeyError, RuntimeError, ValueError) as error:
        what = f"no tensor {error}" if isinstance(error, KeyError) else str(error).splitlines()[-1].strip()
        raise DataError(f"not VPoser's weights: {what}", path=path, remedy=remedy) from error


def _from_vposer(found: Mapping[str, Tensor]) -> PosePrior:
    second = "encoder_net.2.weight" in found
    names, model = (_NAMES_2 if second else _NAMES_1), PosePrior(3, VPOSER_2 if second else VPOSER_1)
    taken = {
        f"{ours}.{part}": found[f"{theirs}.{part}"].float()
        for ours, theirs in names.items()
        for part in _PARTS[ours.endswith("norm")]
    }
    if second:
        weight, bias = (found[f"{_FOLDED}.{part}"].float() for part in _PARTS[False])
        taken["second.bias"] = weight @ taken["second.bias"] + bias
        taken["second.weight"] = weight @ taken["second.weight"]
    for name in taken:
        if not taken[name].isfinite().all():
            raise ValueError(f"{name} has numbers that are not finite")
    # they write the 6 numbers of a joint as (3, 2), column after column being ours
    for part in ("out.weight", "out.bias"):
        if taken[part].shape[0] == 6 * JOINTS:
            taken[part] = taken[part].unflatten(0, (JOINTS, 3, 2)).transpose(1, 2).flatten(0, 2)
    counts = {name: value for name, value in model.state_dict().items() if name.endswith("num_batches_tracked")}
    model.load_state_dict(taken | counts)
    return model.frozen()
