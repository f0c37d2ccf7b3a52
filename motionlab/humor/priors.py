"""The three priors of a fit: over transitions, the pose of one frame, and first states (the initial mixture).

The transition prior is HuMoR's conditional VAE: posterior, conditional prior and decoder, with the official names and
shapes. The pose prior is a variational autoencoder from 21 joint rotations, relative to the parent, to 32 numbers and
back:

    rotations -> BatchNorm, 512, BatchNorm, 512 -> mean, deviation (32);   latent (32) -> 512, 512 -> 6D -> rotations

The initial-state prior is a mixture of Gaussians over joints and velocities of a single frame:

    features (138): joints 66 | joints_vel 66 | trans_vel 3 | root_orient_vel 3, in the state's own heading frame

``pretrained`` loads them, ``training`` makes them.

Source: HuMoR (Rempe et al. 2021), sections 3 and 4.2, and its official code, with 12 components and full covariances;
VPoser (Pavlakos et al. 2019), as HuMoR uses it; thesis 3.1.1.
Differs: a transition prior may have a linear layer past the decoder, ``skip``, which begins as "everything goes on at
its velocity" (and then knows velocities of the past, ``Cvae.causal``), and one past the encoder, ``direct``. Our pose
prior reads 6 numbers per joint, which are continuous, where VPoser reads rotation vectors.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.humor.state import DELTA, OFFICIAL_DELTA_ORDER, OFFICIAL_ORDER, SLICES, STATE

LATENT = 48
POSE_LATENT, BODY_JOINTS = 32, 21
_WIDTH = 512
#: Slopes below zero of VPoser 1.0's three activations: encoder's first and second, decoder's.
VPOSER_SLOPES = (0.2, 0.2, 0.2)
_FEATURES = ("joints", "joints_vel", "trans_vel", "root_orient_vel")
FIRST_STATE_SIZE = 138  # numbers of a first state that the mixture is over


class Gaussian(NamedTuple):
    """A diagonal Gaussian over latents: mean and log_var, each (..., 48)."""

    mean: Tensor
    log_var: Tensor

    def sample(self, generator: torch.Generator) -> Tensor:
        """Draws one sample (..., 48)."""
        noise = torch.randn(self.mean.shape, generator=generator, dtype=self.mean.dtype, device=self.mean.device)
        return self.mean + noise * (0.5 * self.log_var).exp()

    def nll(self, z: Tensor) -> Tensor:
        """Computes -log N(z) (...), nats."""
        squared = (z - self.mean).square() * (-self.log_var).exp()
        return 0.5 * (squared + self.log_var + math.log(2 * math.pi)).sum(-1)


def kl(q: Gaussian, p: Gaussian) -> Tensor:
    """Computes KL(q || p) per latent dimension (..., 48), nats."""
    ratio = (q.log_var - p.log_var).exp() + (q.mean - p.mean).square() * (-p.log_var).exp()
    return 0.5 * (ratio - 1 + p.log_var - q.log_var)


class RowNorm(nn.GroupNorm):
    """GroupNorm of rows (..., C): the same numbers by layer norms of the groups, on a CPU twice as fast."""

    def forward(self, x: Tensor) -> Tensor:
        """Computes normed rows (..., C) from rows (..., C)."""
        groups = x.unflatten(-1, (self.num_groups, -1))
        normed = F.layer_norm(groups, groups.shape[-1:], eps=self.eps).flatten(-2)
        return torch.addcmul(self.bias, normed, self.weight)


class Mlp(nn.Module):
    """Linear -> GroupNorm(16) -> ReLU, and a last Linear; the last ``again`` inputs go to every later Linear too."""

    def __init__(self, inputs: int, widths: tuple[int, ...], outputs: int, again: int = 0) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width in widths:
            layers += [nn.Linear(inputs, width), RowNorm(16, width), nn.ReLU()]
            inputs = width + again
        self.net = nn.Sequential(*layers, nn.Linear(inputs, outputs))
        self.again = again

    def forward(self, x: Tensor) -> Tensor:
        """Computes outputs (N, outputs) from inputs (N, inputs)."""
        skip = x[..., x.shape[-1] - self.again :]
        for k, layer in enumerate(self.net):
            if k and self.again and isinstance(layer, nn.Linear):
                x = torch.cat((x, skip), dim=-1)
            x = layer(x)
        return x


class Cvae(nn.Module):
    """The three networks. States are in the canonical frame of the past one.

    width: of the hidden layers, 1024 in the official model (9,725,976 parameters); a multiple of 32, as the decoder's
    last norm is half as wide and has 16 groups; 64 is the least that can learn.
    There is no normalisation of inputs or outputs: what training uses is folded into the weights.
    skip: with a linear layer from the past state to the raw changes, beside the decoder. direct: with one from both
    states to the mean of z, beside the encoder. Neither is in the official model.

    Raises:
        ShapeError: the width is no multiple of 32.
    """

    latent = LATENT

    def __init__(self, width: int = 1024, *, skip: bool = False, direct: bool = False) -> None:
        super().__init__()
        if width < 32 or width % 32:
            raise ShapeError(f"width: expected a multiple of 32, got {width}")
        self.width = width
        self.encoder = Mlp(2 * STATE, (width,) * 4, 2 * LATENT)
        self.prior_net = Mlp(STATE, (width,) * 4, 2 * LATENT)
        self.decoder = Mlp(STATE + LATENT, (width, width, width // 2), DELTA, again=LATENT)
        self.skip = nn.Linear(STATE, DELTA, bias=False) if skip else None
        self.direct = nn.Linear(2 * STATE, LATENT) if direct else None

    @property
    def causal(self) -> bool:
        """Whether velocities of its states are backward differences, or central ones, which know the next frame."""
        return self.skip is not None

    def posterior(self, past: Tensor, now: Tensor) -> Gaussian:
        """Computes q(z | past, now) from states (..., 339), both in the frame of the past one."""
        both = torch.cat((past, now), dim=-1)
        mean, log_var = _rows(self.encoder, both).chunk(2, dim=-1)
        return Gaussian(mean if self.direct is None else mean + self.direct(both), log_var)

    def prior(self, past: Tensor) -> Gaussian:
        """Computes p(z | past) from states (..., 339) in their own heading frame."""
        return Gaussian(*_rows(self.prior_net, past).chunk(2, dim=-1))

    def decode(self, past: Tensor, z: Tensor) -> Tensor:
        """Computes raw changes and contact logits (..., 216) of the next state; ``state.apply`` adds them."""
        raw = _rows(self.decoder, torch.cat((past, z), dim=-1))
        return raw if self.skip is None else raw + self.skip(past)

    def frozen(self) -> Self:
        """Returns itself, in evaluation mode, its weights without gradients: what a fit wants."""
        return self.eval().requires_grad_(requires_grad=False)


def _rows(net: nn.Module, x: Tensor) -> Tensor:
    return net(x.reshape(-1, x.shape[-1])).unflatten(0, x.shape[:-1])


@torch.no_grad()
def reorder(model: Cvae, *, back: bool = False) -> Cvae:
    """Changes in place a model with official weights into one that takes and gives our order of numbers, or back."""
    order, delta = (each.argsort() if back else each for each in (OFFICIAL_ORDER, OFFICIAL_DELTA_ORDER))
    direct = () if model.direct is None else ((model.direct, 2),)
    first = ((model.encoder.net[0], 2), (model.prior_net.net[0], 1), (model.decoder.net[0], 1), *direct)
    for layer, states in first:
        weight, size = layer.weight, states * STATE
        weight[:, :size] = weight[:, :size].unflatten(1, (states, STATE))[..., order.to(weight.device)].flatten(1)
    last = model.decoder.net[-1]
    last.weight.copy_(last.weight[delta]), last.bias.copy_(last.bias[delta])
    if model.skip is not None:
        model.skip.weight.copy_(model.skip.weight[delta][:, order])
    return model


def official_weights(model: Cvae) -> dict[str, Tensor]:
    """Returns a model's weights as the official code has them: what a checkpoint holds, and ``from_weights`` reads."""
    return reorder(copy.deepcopy(model), back=True).state_dict()


def from_weights(weights: dict[str, Tensor], path: Path, remedy: str) -> Cvae:
    """Builds a frozen model from a state dict with the official names; ``path`` and ``remedy`` are for the errors.

    Raises:
        DataError: names or shapes are others, or a number is not finite.
    """
    first = weights.get("prior_net.net.0.weight")
    if first is None or first.ndim != 2 or first.shape[1] != STATE or first.shape[0] % 32:
        raise DataError("no prior_net.net.0.weight of shape (width, 339)", path=path, remedy=remedy)
    model = Cvae(len(first), skip="skip.weight" in weights, direct="direct.weight" in weights)
    return reorder(filled(model, weights, "tensors do not fit HuMoR's networks", path, remedy))


class PosePrior(nn.Module):
    """Encoder and decoder of poses. numbers: of a joint's rotation at the encoder's door, 6, or 3 of a rotation vector.
    slopes: of the three activations below zero."""

    def __init__(self, numbers: int = 6, slopes: tuple[float, float, float] = VPOSER_SLOPES) -> None:
        super().__init__()
        self.numbers, self.slopes = numbers, slopes
        self.norm = nn.BatchNorm1d(BODY_JOINTS * numbers)
        self.first, self.middle_norm = nn.Linear(BODY_JOINTS * numbers, _WIDTH), nn.BatchNorm1d(_WIDTH)
        self.second = nn.Linear(_WIDTH, _WIDTH)
        self.mean, self.spread = nn.Linear(_WIDTH, POSE_LATENT), nn.Linear(_WIDTH, POSE_LATENT)
        self.out_first, self.out_second = nn.Linear(POSE_LATENT, _WIDTH), nn.Linear(_WIDTH, _WIDTH)
        self.out = nn.Linear(_WIDTH, 6 * BODY_JOINTS)

    def encode(self, rot: Tensor) -> Gaussian:
        """Computes the distribution of the latent (..., 32) from local rotations (..., 21, 3, 3)."""
        check_shape(rot, f"... {BODY_JOINTS} 3 3", "rot")
        said = rotation.matrix_to_sixd(rot) if self.numbers == 6 else rotation.log(rot)
        x = self.norm(said.reshape(-1, BODY_JOINTS * self.numbers))
        x = self.middle_norm(F.leaky_relu(self.first(x), self.slopes[0]))
        x = F.leaky_relu(self.second(x), self.slopes[1])
        log_var = 2 * F.softplus(self.spread(x)).clamp(min=1e-6).log()
        return Gaussian(*(y.unflatten(0, rot.shape[:-3]) if rot.ndim > 3 else y[0] for y in (self.mean(x), log_var)))

    def decode(self, latent: Tensor) -> Tensor:
        """Computes local rotations (..., 21, 3, 3) from latents (..., 32)."""
        check_shape(latent, f"... {POSE_LATENT}", "latent")
        x = F.leaky_relu(self.out_first(latent), self.slopes[2])
        x = F.leaky_relu(self.out_second(x), self.slopes[2])
        return rotation.sixd_to_matrix(self.out(x).unflatten(-1, (BODY_JOINTS, 6)))


def first_state_features(state: Tensor) -> Tensor:
    """Computes the features (..., 138) from states (..., 339) that stand in their own heading frame."""
    check_shape(state, f"... {STATE}", "state")
    return torch.cat([state[..., SLICES[name]] for name in _FEATURES], dim=-1)


class InitGmm:
    """The initial-state mixture: K Gaussians over D features of a first state, frozen.

    weights (K,): sum to 1. means (K, D). covariances (K, D, D): symmetric, positive definite.

    Raises:
        ShapeError: the arrays do not fit each other.
        DataError: weights that are none, or a covariance that is not positive definite.
    """

    def __init__(self, weights: Tensor, means: Tensor, covariances: Tensor) -> None:
        sizes = check_shape(means, "K D", "means")
        count, size = sizes["K"], sizes["D"]
        check_shape(weights, f"{count}", "weights")
        check_shape(covariances, f"{count} {size} {size}", "covariances")
        self.weights, self.means, self.covariances = weights, means, covariances
        if not (weights > 0).all() or abs(float(weights.double().sum()) - 1) > 1e-3:
            raise DataError("weights must be above zero and sum to 1", place="weights", remedy="fit the mixture again")
        symmetric = (covariances - covariances.mT).abs().max() <= 1e-4 * covariances.abs().max()
        if not symmetric or torch.linalg.cholesky_ex(covariances.double()).info.any():
            remedy = "add a little to its diagonal, or fit the mixture again"
            raise DataError("a covariance is not symmetric and positive definite", place="covariances", remedy=remedy)

    @cached_property
    def _white(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rows that whiten, (K D, D), the means in these coordinates (K D,), and each component's constant (K,)."""
        weights, means, covariances = (x.double() for x in (self.weights, self.means, self.covariances))
        factor = torch.linalg.cholesky((covariances + covariances.mT) / 2)
        rows = torch.linalg.solve_triangular(factor, torch.eye(means.shape[1]).to(factor), upper=False)
        logdet = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        constant = (weights / weights.sum()).log() - logdet - 0.5 * means.shape[1] * math.log(2 * math.pi)
        return rows.flatten(0, 1), (rows @ means[..., None]).flatten(), constant

    def each(self, features: Tensor) -> Tensor:
        """Computes log(w_k N_k(features)) (..., K), nats, float64."""
        off, _, constant = self.whitened(features)
        return constant - 0.5 * off.square().sum(-1)

    def whitened(self, features: Tensor, slopes: Tensor | None = None) -> tuple[Tensor, Tensor | None, Tensor]:
        """Computes W_k (features - m_k) (..., K, D), W_k slopes (B, K, D, n) from slopes (B, D, n), and c_k (K,).

        ``each`` is c_k - 1/2 |W_k (features - m_k)|^2; float64.
        """
        check_shape(features, f"... {self.means.shape[1]}", "features")
        rows, shift, constant = (x.to(features.device) for x in self._white)
        off = (features.double() @ rows.mT - shift).unflatten(-1, self.means.shape)
        return off, None if slopes is None else (rows @ slopes.double()).unflatten(1, self.means.shape), constant

    def log_prob(self, features: Tensor) -> Tensor:
        """Computes log p(features) (...), nats; inside in float64."""
        return self.each(features).logsumexp(-1).to(features)

    def tensors(self) -> dict[str, Tensor]:
        """Returns its arrays by the names of the official file."""
        return {"weights": self.weights, "means": self.means, "covariances": self.covariances}


@dataclass(frozen=True, eq=False)
class Priors:
    """motion: over transitions. pose: over the pose of one frame. initial: over the first state. All frozen."""

    motion: Cvae
    pose: PosePrior
    initial: InitGmm


def filled(model: nn.Module, weights: Mapping[str, Tensor], unfit: str, path: Path, remedy: str) -> nn.Module:
    """Returns a model, frozen, with the weights of a state dict, whose norms need not have counted their batches.

    Raises:
        DataError: names or shapes are others (``unfit``), or a number is not finite.
    """
    counts = {name: value for name, value in model.state_dict().items() if name.endswith("num_batches_tracked")}
    try:
        model.load_state_dict(counts | {name: value.float() for name, value in weights.items()})
    except RuntimeError as error:
        raise DataError(f"{unfit}: {str(error).splitlines()[-1].strip()}", path=path, remedy=remedy) from error
    finite(weights, path, remedy)
    return model.eval().requires_grad_(False)


def finite(tensors: Mapping[str, Tensor], path: Path, remedy: str) -> None:
    """Raises DataError where a tensor holds a number that is not finite."""
    for name, value in tensors.items():
        if not value.isfinite().all():
            raise DataError("numbers that are not finite", path=path, place=name, remedy=remedy)
