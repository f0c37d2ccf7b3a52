"""What is measured of motion: errors of poses in metres and smoothness of their paths; gait and feet on the floor; how
far sets of generated motions are from real ones; confidence intervals by the bootstrap.

Positions are (..., T, J, 3) of joints or (..., T, F, 3) of foot joints, in metres, world, z up. A measure averages
over frames and joints and keeps the batch axes (...). Where there is nothing to average (no visible joint, too few
frames for a difference) it is NaN, never 0. Sets are features (N, D), computed in float64; most of their measures
change with N.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.motion import Motion

SIDES = ("left", "right")
SEATED = 60.0  # degrees of the thighs' tilt and of the knees' flexion from which somebody sits


# ------------------------------------------------------------------------------------------------ poses and their paths
def masked_mean(values: Tensor, mask: Tensor | None, axes: int) -> Tensor:
    """Averages over the last ``axes`` axes where ``mask`` holds (None: everywhere); NaN where it never does."""
    dims = tuple(range(-axes, 0))
    kept = torch.ones_like(values) if mask is None else mask.to(values).expand_as(values)
    return torch.where(kept > 0, values * kept, 0.0).sum(dims) / kept.sum(dims)


def align_procrustes(predicted: Tensor, truth: Tensor, *, scale: bool) -> Tensor:
    """Moves each predicted point set (..., J, 3) onto the true one by the best rotation, shift and, if asked, scale.

    min over R, t (and s) of sum_j |s R x_j + t - y_j|^2, frame by frame.

    Raises:
        ShapeError: the two do not have the same number of points.
        DataError: a coordinate is not finite; no best rotation exists then.
    Source: Umeyama 1991.
    """
    sizes = check_shape(predicted, "... J 3", "predicted")
    check_shape(truth, f"... {sizes['J']} 3", "truth")
    for name, points in (("predicted", predicted), ("truth", truth)):
        if not points.isfinite().all():
            first = (~points.isfinite()).nonzero()[0].tolist()
            raise DataError("cannot be aligned: NaN or infinity", place=f"{name}{first}", remedy="leave that frame out")
    centre = truth.mean(-2, keepdim=True)
    x, y = predicted - predicted.mean(-2, keepdim=True), truth - centre
    turn = rotation.nearest(y.mT @ x)
    turned = x @ turn.mT
    if scale:
        turned = turned * ((turned * y).sum((-1, -2)) / turned.square().sum((-1, -2)))[..., None, None]
    return turned + centre


def _check_pair(predicted: Tensor, truth: Tensor) -> None:
    """Both are (..., T, J, 3) with the same T and J: broadcasting one frame over many would hide a mistake."""
    sizes = check_shape(predicted, "... T J 3", "predicted")
    check_shape(truth, f"... {sizes['T']} {sizes['J']} 3", "truth")


def joint_errors(predicted: Tensor, truth: Tensor, *, align: str) -> Tensor:
    """Computes the distance (..., T, J) in metres of every predicted joint from the true one.

    ``align``: "none" (world), "root" (joint 0 of each frame moved onto the true one), "rigid" (Procrustes
    per frame without scale), "similarity" (with scale; what is called PA-MPJPE).

    Raises:
        ShapeError: different numbers of frames or joints.
        ValueError: no such alignment.
        DataError: an alignment by Procrustes of numbers that are not finite.
    """
    _check_pair(predicted, truth)
    if align == "root":
        predicted = predicted - predicted[..., :1, :] + truth[..., :1, :]
    elif align in ("rigid", "similarity"):
        predicted = align_procrustes(predicted, truth, scale=align == "similarity")
    elif align != "none":
        raise ValueError(f'align: expected "none", "root", "rigid" or "similarity", got {align!r}')
    return torch.linalg.vector_norm(predicted - truth, dim=-1)


def mpjpe(predicted: Tensor, truth: Tensor, *, align: str, mask: Tensor | None = None) -> Tensor:
    """Computes the mean per-joint position error (...) in metres; ``mask`` (..., T, J) chooses what counts.

    All joints take part in the alignment (see :func:`joint_errors`), also those that do not count.
    """
    return masked_mean(joint_errors(predicted, truth, align=align), mask, 2)


def acceleration(positions: Tensor, fps: float) -> Tensor:
    """Computes the size (..., T - 2, J) of each joint's acceleration in m/s^2, by second differences."""
    check_shape(positions, "... T J 3", "positions")
    return torch.linalg.vector_norm(positions.diff(n=2, dim=-3), dim=-1) * fps**2


def mean_acceleration(positions: Tensor, fps: float) -> Tensor:
    """Computes the mean size (...) of the acceleration in m/s^2; NaN for fewer than three frames."""
    return masked_mean(acceleration(positions, fps), None, 2)


def acceleration_error(predicted: Tensor, truth: Tensor, fps: float) -> Tensor:
    """Computes the mean size (...) of the difference of accelerations in m/s^2; NaN for fewer than three frames."""
    _check_pair(predicted, truth)
    return masked_mean(acceleration(predicted - truth, fps), None, 2)


def jitter(positions: Tensor, fps: float) -> Tensor:
    """Computes the mean size (...) of the third time derivative in m/s^3; NaN for fewer than four frames."""
    check_shape(positions, "... T J 3", "positions")
    return masked_mean(torch.linalg.vector_norm(positions.diff(n=3, dim=-3), dim=-1) * fps**3, None, 2)


# -------------------------------------------------------------------------------------------------------- gait and feet
def legs(motion: Motion) -> list[int]:
    """Returns the indices of knees, ankles and feet."""
    return motion.skeleton.indices([f"{side}_{part}" for side in SIDES for part in ("knee", "ankle", "foot")])


def tilt_and_bend(motion: Motion) -> tuple[Tensor, Tensor]:
    """Computes the thighs' tilt from hanging straight down and the knees' flexion, degrees (B, T, 2): left, right."""
    hip, knee, ankle = (
        motion.positions[..., motion.skeleton.indices([f"{side}_{part}" for side in SIDES]), :]
        for part in ("hip", "knee", "ankle")
    )
    thigh, shin = (torch.nn.functional.normalize(x, dim=-1) for x in (knee - hip, ankle - knee))
    cosine = (thigh * shin).sum(-1).clamp(-1, 1)
    return torch.rad2deg((-thigh[..., 2]).clamp(-1, 1).arccos()), torch.rad2deg(cosine.arccos())


def skating_ratio(positions: Tensor, fps: float) -> Tensor:
    """Computes the share (...) of frames in which some foot slides over the floor.

    It is below 5 cm now and in the next frame, and faster than 0.5 m/s, at once and in the mean of five frames around.

    Source: GMD, OmniControl, CondMDI (their joints: the balls of the feet, at 20 fps; fewer frames than five
        around an end count as standing still).
    Differs: NaN for fewer than two frames.
    """
    check_shape(positions, "... T F 3", "positions")
    moving = torch.linalg.vector_norm(positions[..., :2].diff(dim=-3), dim=-1) * fps  # (..., T - 1, F)
    padded = torch.nn.functional.pad(moving.mT, (2, 2)).mT
    mean = sum(padded[..., k : k + moving.shape[-2], :] for k in range(5)) / 5
    low = positions[..., 2] < 0.05
    slides = low[..., 1:, :] & low[..., :-1, :] & (moving > 0.5) & (mean > 0.5)
    return slides.any(-1).to(positions).mean(-1)


def slide_in_contact_mm(positions: Tensor, contacts: Tensor) -> Tensor:
    """Computes the mean displacement (...), mm per frame, of joints that touch in both frames; contacts (..., T, F)."""
    check_shape(positions, "... T F 3", "positions")
    step = torch.linalg.vector_norm(positions.diff(dim=-3), dim=-1) * 1000
    on = contacts > 0.5
    return masked_mean(step, on[..., 1:, :] & on[..., :-1, :], 2)


def slide_where_truth_stands_mm(positions: Tensor, truth: Tensor, *, still: float = 0.01) -> Tensor:
    """Computes the mean displacement (...) in mm per frame where the true joint moves less than ``still`` m per frame.

    Source: foot sliding of WHAM and GVHMR (there of four sole vertices, at 30 fps).
    """
    check_shape(positions, "... T F 3", "positions")
    step, true = (torch.linalg.vector_norm(x.diff(dim=-3), dim=-1) for x in (positions, truth))
    return masked_mean(step * 1000, true < still, 2)


def contact_f1(predicted: Tensor, truth: Tensor) -> Tensor:
    """Computes the F1 score (...) of contact labels (..., T, C), or of probabilities with threshold 1/2, over all
    frames and joints: 2 hits / (predicted + true); NaN where there is neither."""
    p, t = (predicted > 0.5).double(), (truth > 0.5).double()
    return 2 * (p * t).sum((-1, -2)) / (p + t).sum((-1, -2))


# ------------------------------------------------------------------------------------------------------ sets of motions
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


def density_coverage(generated: Tensor, real: Tensor, k: int = 5) -> tuple[float, float]:
    """Computes density and coverage: how many generated samples real neighbourhoods hold, and how many hold any.

    density = 1 / (k N) sum_ij [g_i in B(r_j)], coverage = 1 / M sum_j [some g_i in B(r_j)], where B(r_j) is the open
    ball that reaches the k-th nearest other real sample. An outlier among the generated has no ball of its own, so
    it cannot add to either. Of equal sets density is about 1, and may exceed it.

    Source: Naeem et al. 2020, with their k = 5.
    Raises:
        ShapeError: not more than k real samples, or different D. DataError: a feature is not finite.
    """
    x, y = _checked(generated, real)
    inside = _distances(x, y) < _neighbour_radii(y, k)
    return inside.sum().item() / (k * len(x)), inside.any(0).double().mean().item()


# ------------------------------------------------------------------------------------------------------------ intervals
def interval(
    samples: Tensor, statistic: str, generator: torch.Generator, draws: int = 2000
) -> tuple[float, float, float]:
    """Computes a statistic of samples (N,) and its 95 % bootstrap percentile interval: (value, low, high).

    statistic: "mean", "median", "max", "min", "p95" (95th percentile), or "share" (mean of 0/1 samples, with
    Wilson's interval, which stays honest when all samples agree). One sample has no spread: low = high = value.
    """
    samples = samples.detach().double().flatten()
    if statistic == "share":
        return _wilson(samples.mean().item(), len(samples))
    measure = {
        "mean": lambda x: x.mean(-1),
        "median": lambda x: x.quantile(0.5, -1),
        "p95": lambda x: x.quantile(0.95, -1),
        "max": lambda x: x.amax(-1),
        "min": lambda x: x.amin(-1),
    }[statistic]
    value = measure(samples).item()
    if len(samples) < 2 or statistic in ("max", "min"):  # the bootstrap cannot see past an extreme
        return value, value, value
    pick = torch.randint(len(samples), (draws, len(samples)), generator=generator)
    low, high = measure(samples[pick]).quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return value, low, high


def _wilson(share: float, n: int, z: float = 1.96) -> tuple[float, float, float]:
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return share, max(0.0, centre - half), min(1.0, centre + half)


class Paired(NamedTuple):
    """The mean difference of paired samples with its 95 % bootstrap interval, and how many there were."""

    mean: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        return f"{self.mean:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


def paired(after: Tensor, before: Tensor, generator: torch.Generator) -> Paired:
    """Computes the mean of ``after`` - ``before`` with its 95 % interval; pairs that are not finite are dropped."""
    difference = (after - before).flatten()
    difference = difference[difference.isfinite()]
    return Paired(*interval(difference, "mean", generator), len(difference))
