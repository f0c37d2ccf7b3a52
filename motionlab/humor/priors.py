"""The three priors of a fit as models: over transitions (``cvae``), over the pose of one frame, over the first state.

The pose prior is a variational autoencoder from 21 joint rotations, relative to the parent, to 32 numbers and back:

    rotations -> BatchNorm, 512, BatchNorm, 512 -> mean, deviation (32);   latent (32) -> 512, 512 -> 6D -> rotations

The initial-state prior is a mixture of Gaussians over joints and velocities of a single frame:

    features (138): joints 66 | joints_vel 66 | trans_vel 3 | root_orient_vel 3, in the state's own heading frame

``pretrained`` loads them, ``training.recipes`` makes them.

Source: VPoser (Pavlakos et al. 2019), as HuMoR uses it; HuMoR (Rempe et al. 2021), section 4.2 and its official code:
12 components, full covariances.
Differs: our pose prior reads 6 numbers per joint, which are continuous, where VPoser reads rotation vectors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from motionlab import rotation
from motionlab.errors import DataError, check_shape
from motionlab.humor import state as layout
from motionlab.humor.cvae import Cvae, Gaussian

POSE_LATENT, BODY_JOINTS = 32, 21
_WIDTH = 512
#: Slopes below zero of VPoser 1.0's three activations: encoder's first and second, decoder's.
VPOSER_SLOPES = (0.2, 0.2, 0.2)
_FEATURES = ("joints", "joints_vel", "trans_vel", "root_orient_vel")
FIRST_STATE_SIZE = 138  # numbers of a first state that the mixture is over


@dataclass(frozen=True, eq=False)
class Priors:
    """motion: over transitions. pose: over the pose of one frame. initial: over the first state. All frozen."""

    motion: Cvae
    pose: PosePrior
    initial: InitGmm


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

    def frozen(self) -> PosePrior:
        """Returns itself, in evaluation mode, its weights without gradients: what a fit wants."""
        return self.eval().requires_grad_(requires_grad=False)


def first_state_features(state: Tensor) -> Tensor:
    """Computes the features (..., 138) from states (..., 339) that stand in their own heading frame."""
    check_shape(state, f"... {layout.STATE}", "state")
    return torch.cat([state[..., layout.SLICES[name]] for name in _FEATURES], dim=-1)


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
        check_shape(features, f"... {self.means.shape[1]}", "features")
        rows, shift, constant = (x.to(features.device) for x in self._white)
        white = (features.double() @ rows.mT - shift).unflatten(-1, self.means.shape)
        return constant - 0.5 * white.square().sum(-1)

    def whitened(self, features: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Computes W_k (features - m_k) (B, K, D), W_k slopes (B, K, D, n) and c_k (K,) from slopes (B, D, n).

        ``each`` is c_k - 1/2 |W_k (features - m_k)|^2; float64.
        """
        rows, shift, constant = (x.to(features.device) for x in self._white)
        off = (features.double() @ rows.mT - shift).unflatten(-1, self.means.shape)
        return off, (rows @ slopes.double()).unflatten(1, self.means.shape), constant

    def log_prob(self, features: Tensor) -> Tensor:
        """Computes log p(features) (...), nats; inside in float64."""
        return self.each(features).logsumexp(-1).to(features)

    def tensors(self) -> dict[str, Tensor]:
        """Returns its arrays by the names of the official file."""
        return {"weights": self.weights, "means": self.means, "covariances": self.covariances}
