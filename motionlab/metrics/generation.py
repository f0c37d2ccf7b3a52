"""Measures how far a set of generated motions is from real ones, between feature tensors (N, D), in float64; and what
windows of motion are like, in a few physical numbers (``describe``). Most measures change with the sizes of the sets.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.contact import with_contacts
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.metrics.pose import jitter, power_spectrum
from motionlab.motion import Motion, velocity
from motionlab.skeleton import FEET

#: What :func:`describe` measures, with its unit.
DESCRIPTION_UNITS = {
    "root speed": "m/s", "turning rate": "deg/s", "joint speed": "m/s", "joint acceleration": "m/s^2",
    "jitter": "m/s^3", "quick motion": "% above 4 Hz", "feet on the floor": "%", "foot height": "m",
    "knee flexion": "deg", "elbow flexion": "deg", "trunk lean": "deg", "hand height": "m",
}  # fmt: skip


def _checked(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Both sets in float64, of one width, with at least two rows, all finite."""
    check_shape(y, f"M {check_shape(x, 'N D', 'generated')['D']}", "real")
    if min(len(x), len(y)) < 2:
        raise ShapeError(f"needs at least 2 samples a side, got {len(x)} generated and {len(y)} real")
    for name, z in (("generated", x), ("real", y)):
        if not z.isfinite().all():
            row = int((~z.isfinite().all(-1)).nonzero()[0])
            raise DataError("NaN or infinity", place=f"{name}, row {row}", remedy="leave that sample out and say so")
    return x.double(), y.double()


def frechet(generated: Tensor, real: Tensor) -> float:
    """Computes the Frechet distance (FID) of sets (N, D), (M, D), in squared units of the features; grows as N shrinks.

    |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^1/2) of means and covariances; tr (C1 C2)^1/2 is the sum of the singular values
    of S1 S2, S the symmetric root by eigenvalues (those that rounding makes negative count as zero): it needs no
    inverse, so singular covariances are no special case.

    Source: Heusel et al. 2017. Differs: they take scipy's sqrtm and add 1e-6 to the diagonal where it fails.
    Raises:
        ShapeError: fewer than two samples a side, or different D. DataError: a feature is not finite.
    """

    def root(c: Tensor) -> Tensor:
        values, vectors = torch.linalg.eigh((c + c.mT) / 2)
        return vectors * values.clamp_min(0).sqrt() @ vectors.mT

    x, y = _checked(generated, real)
    cov, other = (z.mT.cov().reshape(z.shape[1], z.shape[1]) for z in (x, y))
    shared = torch.linalg.svdvals(root(cov) @ root(other)).sum()
    apart = (x.mean(0) - y.mean(0)).square().sum()
    return max(0.0, (apart + cov.trace() + other.trace() - 2 * shared).item())


class Precision(NamedTuple):
    """Shares in 0..1 of samples that lie on the other set's manifold."""

    precision: float  #: of the generated, how many lie among the real
    recall: float  #: of the real, how many lie among the generated


class Coverage(NamedTuple):
    """Fidelity and variety by the manifold of the real samples alone."""

    density: float  #: neighbourhoods that a generated sample lies in, over k: about 1 for equal sets, may exceed 1
    coverage: float  #: share in 0..1 of the real neighbourhoods that hold some generated sample


def _neighbour_radii(x: Tensor, k: int) -> Tensor:
    """Distance (N,) of each sample to its k-th nearest other one of the same set (N, D).

    Raises:
        ShapeError: not more than k samples, or k below 1.
    """
    if not 1 <= k < len(x):
        raise ShapeError(f"k = {k}: expected 1 up to one less than the {len(x)} samples")
    return _distances(x, x).fill_diagonal_(0).kthvalue(k + 1, dim=1).values


def _distances(x: Tensor, y: Tensor) -> Tensor:
    """Exact distances: the quick expansion of the square would part equal samples by its rounding."""
    return torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist")


def precision_recall(generated: Tensor, real: Tensor, k: int = 3) -> Precision:
    """Computes precision and recall: the share of each set inside the other's balls, to the k-th nearest neighbour.

    Compare numbers only at equal sizes: a larger set covers more. MDM takes the first min(N, M) of each.

    Source: Kynkaanniemi et al. 2019, with k = 3 of MDM.
    Raises:
        ShapeError: not more than k samples a side, or different D. DataError: a feature is not finite.
    """
    x, y = _checked(generated, real)
    between = _distances(x, y)
    on_real = (between <= _neighbour_radii(y, k)).any(1)
    on_generated = (between <= _neighbour_radii(x, k)[:, None]).any(0)
    return Precision(on_real.double().mean().item(), on_generated.double().mean().item())


def density_coverage(generated: Tensor, real: Tensor, k: int = 5) -> Coverage:
    """Computes density and coverage: how many generated samples real neighbourhoods hold, and how many hold any.

    density = 1 / (k N) sum_ij [g_i in B(r_j)], coverage = 1 / M sum_j [some g_i in B(r_j)], where B(r_j) is the open
    ball that reaches the k-th nearest other real sample. An outlier among the generated has no ball of its own, so
    it cannot add to either.

    Source: Naeem et al. 2020, with their k = 5.
    Raises:
        ShapeError: not more than k real samples, or different D. DataError: a feature is not finite.
    """
    x, y = _checked(generated, real)
    inside = _distances(x, y) < _neighbour_radii(y, k)
    return Coverage(inside.sum().item() / (k * len(x)), inside.any(0).double().mean().item())


def describe(motion: Motion) -> dict[str, Tensor]:
    """Computes a physical summary of each window of motions on the standard joints: ``DESCRIPTION_UNITS`` -> (...).

    Means over the T frames of a window (and over the joints or sides concerned); the root moves on the floor
    plane only; heights are above z = 0; flexion is the angle between the two bones of a limb; quick motion is the
    share of the joints' velocity power above 4 Hz; floor contacts are measured, never taken from labels.
    """
    p, fps, index = motion.positions, motion.fps, motion.skeleton.index
    pelvis, world = p[..., 0, :], motion.world[1]
    moving = velocity(p, fps, dim=-3)
    second = p.diff(n=2, dim=-3) * fps**2
    turn = rotation.geodesic(world[..., :-1, 0, :, :], world[..., 1:, 0, :, :]) * fps
    trunk = torch.nn.functional.normalize(p[..., index("neck"), :] - pelvis, dim=-1)
    feet = [motion.skeleton.contact_names.index(name) for name in FEET]
    hands = p[..., [index("left_wrist"), index("right_wrist")], 2]
    return {
        "root speed": moving[..., 0, :2].norm(dim=-1).mean(-1),
        "turning rate": torch.rad2deg(turn).mean(-1),
        "joint speed": moving.norm(dim=-1).mean((-1, -2)),
        "joint acceleration": second.norm(dim=-1).mean((-1, -2)),
        "jitter": jitter(p, fps),
        "quick motion": 100 * _power_above(moving - moving.mean(-3, keepdim=True), fps, 4.0),
        "feet on the floor": 100 * with_contacts(motion).contacts[..., feet].mean((-1, -2)),
        "foot height": p[..., motion.skeleton.indices(FEET), 2].mean((-1, -2)),
        "knee flexion": _flexion(motion, "hip", "knee", "ankle"),
        "elbow flexion": _flexion(motion, "shoulder", "elbow", "wrist"),
        "trunk lean": torch.rad2deg(torch.acos(trunk[..., 2].clamp(-1, 1))).mean(-1),
        "hand height": hands.mean((-1, -2)),
    }


def _power_above(moving: Tensor, fps: float, hertz: float) -> Tensor:
    """Share (...) of the power of signals (..., T, J, 3) above a frequency."""
    power = power_spectrum(moving)
    quick = torch.fft.rfftfreq(moving.shape[-3], 1 / fps) > hertz
    return power[..., quick].sum(-1) / power.sum(-1).clamp_min(torch.finfo(power.dtype).tiny)


def _flexion(motion: Motion, *chain: str) -> Tensor:
    angles = []
    for side in ("left", "right"):
        a, b, c = (motion.positions[..., motion.skeleton.index(f"{side}_{part}"), :] for part in chain)
        upper, lower = torch.nn.functional.normalize(b - a, dim=-1), torch.nn.functional.normalize(c - b, dim=-1)
        angles.append(torch.acos((upper * lower).sum(-1).clamp(-1, 1)))
    return torch.rad2deg(torch.stack(angles)).mean((0, -1))
