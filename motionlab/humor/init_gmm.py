"""How likely a first state is: a mixture of Gaussians over joints and velocities of a single frame.

    features (138): joints 66 | joints_vel 66 | trans_vel 3 | root_orient_vel 3, in the state's own heading frame

Source: HuMoR (Rempe et al. 2021), section 4.2 and its official code: 12 components, full covariances, 1e-6 added to
their diagonals.
Differs: more is added to the diagonals of ours (``RIDGE``). Two places and three velocities among the features are
fixed by others, so that 1e-6 asks the optimiser to hold them to a millimetre and to a millimetre per second.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.humor import state as layout
from motionlab.io.reading import numbers, read_npz, reading

PARTS = ("joints", "joints_vel", "trans_vel", "root_orient_vel")
SIZE = sum(layout.SLICES[name].stop - layout.SLICES[name].start for name in PARTS)
COMPONENTS = 12
RIDGE = 1e-4  # square metres, or (metres per second)^2: one centimetre


def features(state: Tensor) -> Tensor:
    """The features (..., 138) of states (..., 339) that stand in their own heading frame."""
    check_shape(state, f"... {layout.STATE}", "state")
    return torch.cat([state[..., layout.SLICES[name]] for name in PARTS], dim=-1)


class InitGmm:
    """A mixture of K Gaussians over D features, frozen.

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
            raise DataError(
                "a covariance is not symmetric and positive definite",
                place="covariances",
                remedy="add a little to its diagonal, or fit the mixture again",
            )

    @cached_property
    def _white(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rows that whiten, (K D, D), the means in these coordinates (K D,), and each component's constant (K,)."""
        weights, means, covariances = (x.double() for x in (self.weights, self.means, self.covariances))
        factor = torch.linalg.cholesky((covariances + covariances.mT) / 2)
        unit = torch.eye(means.shape[1], dtype=torch.float64, device=factor.device).expand_as(factor)
        rows = torch.linalg.solve_triangular(factor, unit, upper=False)
        logdet = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        constant = (weights / weights.sum()).log() - logdet - 0.5 * means.shape[1] * math.log(2 * math.pi)
        return rows.flatten(0, 1), (rows @ means[..., None]).flatten(), constant

    def each(self, features: Tensor) -> Tensor:
        """log(w_k N_k(features)) (..., K), nats, float64."""
        if features.shape[-1] != self.means.shape[1]:
            raise ShapeError(f"features: expected (..., {self.means.shape[1]}), got {tuple(features.shape)}")
        rows, shift, constant = (x.to(features.device) for x in self._white)
        white = (features.double() @ rows.mT - shift).unflatten(-1, self.means.shape)
        return constant - 0.5 * white.square().sum(-1)

    def whitened(self, features: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """W_k (features - m_k) (B, K, D) and W_k slopes (B, K, D, n), slopes (B, D, n), and the constants c_k (K,), so
        that ``each`` is c_k - 1/2 |W_k (features - m_k)|^2; float64."""
        rows, shift, constant = (x.to(features.device) for x in self._white)
        sizes = self.means.shape
        off = (features.double() @ rows.mT - shift).unflatten(-1, sizes)
        return off, (rows @ slopes.double()).unflatten(1, sizes), constant

    def log_prob(self, features: Tensor) -> Tensor:
        """log p(features) (...), nats; inside in float64."""
        return self.each(features).logsumexp(-1).to(features)

    def tensors(self) -> dict[str, Tensor]:
        """Its arrays by the names of the official file."""
        return {"weights": self.weights, "means": self.means, "covariances": self.covariances}


def from_tensors(tensors: Mapping[str, Tensor], path: Path | str | None = None) -> InitGmm:
    """The mixture of arrays ``weights``, ``means``, ``covariances``; ``path`` is for the errors.

    Raises:
        DataError: one of them is missing, of another shape, or no such mixture of 138 features.
    """
    names = ("weights", "means", "covariances")
    missing = [name for name in names if name not in tensors]
    remedy = "take the official prior_gmm.npz, or a checkpoint of this project"
    if missing:
        raise DataError(f"no {', '.join(missing)}", path=path, remedy=remedy)
    try:
        gmm = InitGmm(*(tensors[name] for name in names))
    except (ShapeError, DataError) as error:
        raise DataError(f"no mixture of Gaussians: {error}", path=path, remedy=remedy) from error
    if gmm.means.shape[1] != SIZE:
        raise DataError(f"expected {SIZE} features, found {gmm.means.shape[1]}", path=path, remedy=remedy)
    return gmm


def load_official(path: Path | str) -> InitGmm:
    """The official ``prior_gmm.npz``: weights (K,), means (K, 138), covariances (K, 138, 138).

    Raises:
        DataError: not such a file, damaged, or other shapes.
    """
    with reading(path, "take prior_gmm.npz of the official HuMoR release") as at:
        raw = read_npz(at, ("weights", "means", "covariances"))
        count = len(raw["weights"]) if raw["weights"].ndim else 0
        shapes = {"weights": f"{count}", "means": f"{count} {SIZE}", "covariances": f"{count} {SIZE} {SIZE}"}
        found = {name: torch.from_numpy(numbers(at, raw[name], shape, name)) for name, shape in shapes.items()}
        return from_tensors(found, path)


def fit(
    features: Tensor,
    generator: torch.Generator,
    *,
    components: int = COMPONENTS,
    steps: int = 100,
    ridge: float = RIDGE,
    tolerance: float = 1e-2,
) -> tuple[InitGmm, list[float]]:
    """Expectation-maximisation on features (N, D), started from k-means++ and a few steps of k-means.

    Returns:
        the mixture, and the mean log-likelihood (nats) before each step; it stops when that grows by less than
        ``tolerance``.
    Raises:
        DataError: fewer samples than features, or numbers that are not finite.
    """
    check_shape(features, "N D", "features")
    if len(features) <= features.shape[1] or not features.isfinite().all():
        raise DataError(
            f"{len(features)} samples of {features.shape[1]} features", remedy="give more frames, all of them finite"
        )
    x = features.double()
    share = torch.nn.functional.one_hot(_clusters(x, components, generator), components).double()
    history: list[float] = []
    for _ in range(steps):
        gmm = _maximise(x, share, ridge)
        joint = gmm.each(x)
        total = joint.logsumexp(-1)
        history.append(float(total.mean()))
        if len(history) > 1 and history[-1] - history[-2] < tolerance:
            break
        share = (joint - total[:, None]).exp()
    return gmm, history


def _maximise(x: Tensor, share: Tensor, ridge: float) -> InitGmm:
    """The mixture that fits samples x (N, D) best, given to whom (N, K) each belongs."""
    count = share.sum(0).clamp(min=1e-6)
    means = (share.mT @ x) / count[:, None]
    ridge_matrix = ridge * torch.eye(x.shape[1], dtype=x.dtype)
    covariances = []
    for k in range(share.shape[1]):  # one component at a time: all at once would need N K D numbers
        away = (x - means[k]) * (share[:, k, None] / count[k]).sqrt()
        covariances.append(away.mT @ away + ridge_matrix)
    return InitGmm(count / count.sum(), means, torch.stack(covariances))


def _clusters(x: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Index (N,) of the nearest of ``count`` centres: k-means++ and ten steps of Lloyd's, features at unit spread."""
    x = (x - x.mean(0)) / x.std(0).clamp(min=1e-3)
    chosen = x[torch.randint(len(x), (1,), generator=generator)]
    for _ in range(count - 1):
        nearest = torch.cdist(x, chosen).amin(-1).square()
        chosen = torch.cat((chosen, x[torch.multinomial(nearest.float() + 1e-12, 1, generator=generator)]))
    for _ in range(10):
        owner = torch.cdist(x, chosen).argmin(-1)
        member = torch.nn.functional.one_hot(owner, count).double()
        size = member.sum(0)[:, None]
        chosen = torch.where(size > 0, member.mT @ x / size.clamp(min=1), chosen)
    return torch.cdist(x, chosen).argmin(-1)
