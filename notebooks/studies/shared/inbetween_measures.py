"""Measures how well a gap is filled: the LAFAN1 benchmark's measures; the seam and the keyframes in metres.

L2Q, L2P and NPSS have no unit that means anything outside the benchmark: norms over whole poses. They take the
quaternions and positions that the benchmark's protocol makes (``studies.shared.lafan_benchmark``).

Source: Harvey et al. 2020, "Robust Motion In-betweening", and its code (``lafan1/benchmarks.py``).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.metrics.pose import joint_errors, masked_mean


def l2q(predicted: Tensor, truth: Tensor) -> Tensor:
    """Computes the mean over frames (...) of |q^ - q| over all joints; global quaternions (..., T, J, 4) with signs.

    q and -q are one rotation and here as far apart as can be: signs come from continuity in time of the
    local quaternions, never from aligning the prediction with the truth.

    Source: LAFAN1 benchmark (Harvey et al. 2020), ``benchmarks.py``.
    """
    _same(predicted, truth, "... T J 4")
    return (predicted - truth).square().sum((-1, -2)).sqrt().mean(-1)


def l2p(predicted: Tensor, truth: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Computes the mean over frames (...) of |p^ - p| over all joints, each coordinate divided by its deviation.

    Positions (..., T, J, 3), mean and std (J, 3), all in one unit: the result has none. The mean cancels.

    Source: LAFAN1 benchmark (Harvey et al. 2020), ``benchmarks.py``.
    Raises:
        DataError: a deviation is not above zero; no coordinate can be divided by it.
    """
    sizes = _same(predicted, truth, "... T J 3")
    for name, x in (("mean", mean), ("std", std)):
        check_shape(x, f"{sizes['J']} 3", name)
    if not (std > 0).all():
        raise DataError("a coordinate of the training set never changes", place="std", remedy="use more training data")
    gap = (predicted - mean) / std - (truth - mean) / std
    return gap.square().sum((-1, -2)).sqrt().mean(-1)


def npss(predicted: Tensor, truth: Tensor) -> float:
    """Computes the distance of power spectra of signals (N, T, D), 0 for equal ones: the benchmark's NPSS over N clips.

    P = (Re F x)^2 over all T frequencies, normalised to sum 1 per clip and signal; the sum over frequencies of
    |cumulated P^ - cumulated P|; averaged with the truth's total power as weight. Of the Fourier coefficients only the
    real part enters, so a shift in time changes the measure. A mean over clips of this is another number.

    Source: LAFAN1 benchmark, after Gopalakrishnan et al. 2019.
    Differs: a signal without any power is NaN there; here its cumulated power is zero, so a true one weighs nothing.
    Raises:
        DataError: no true signal has any power.
    """
    _same(predicted, truth, "N T D")
    power = [torch.fft.fft(x.double(), dim=1).real.square() for x in (predicted, truth)]
    total = [p.sum(1) for p in power]
    shares = [(p / torch.where(t > 0, t, 1.0)[:, None]).cumsum(1) for p, t in zip(power, total, strict=True)]
    if not total[1].sum() > 0:
        raise DataError("every true signal is zero throughout", place="truth", remedy="compare signals that are not")
    return ((shares[0] - shares[1]).abs().sum(1) * total[1]).sum().item() / total[1].sum().item()


def _same(predicted: Tensor, truth: Tensor, pattern: str) -> dict[str, int]:
    sizes = check_shape(predicted, pattern, "predicted")
    if predicted.shape != truth.shape or predicted.numel() == 0:
        raise ShapeError(
            f"predicted {tuple(predicted.shape)}, truth {tuple(truth.shape)}: expected one shape, not empty"
        )
    return sizes


class Seam(NamedTuple):
    """The velocity at the seams between what was given and what was filled in, per clip."""

    jump_mps: Tensor  #: (...) m/s, mean over the clip's seams of :func:`step_changes`; NaN where it has none
    worst_mps: Tensor  #: (...) m/s, the largest
    percentile: Tensor  #: (...) where jump_mps lies in the natural distribution, 0 to 100


def seam(positions: Tensor, known: Tensor, fps: float, natural: Tensor) -> Seam:
    """Computes how much the velocity jumps where known and filled frames meet, beside real motion at any step.

    Args:
        positions: (..., T, J, 3) metres. known: (..., T) True for the frames that were given.
        natural: (K,) m/s, :func:`natural_changes` of real motion at the same rate.
    """
    frames = check_shape(positions, "... T J 3", "positions")["T"]
    check_shape(known, f"... {frames}", "known")
    change = step_changes(positions, fps)
    seams = (known.bool()[..., 1:] != known.bool()[..., :-1]).expand(change.shape)
    jump = masked_mean(change, seams, 1)
    worst = torch.where(seams, change, -torch.inf).amax(-1)
    worst = torch.where(seams.any(-1), worst, torch.nan)
    return Seam(jump, worst, percentile(jump, natural))


def step_changes(positions: Tensor, fps: float) -> Tensor:
    """Computes the change of velocity into or out of each step between frames, the larger one: (..., T - 1) in m/s.

    The change at frame t is |v_t - v_(t-1)| with v_t = (p_(t+1) - p_t) fps, the mean over the joints of
    positions (..., T, J, 3) in metres. The first and the last step have one such frame, the others two.

    Raises:
        ShapeError: fewer than three frames.
    """
    frames = check_shape(positions, "... T J 3", "positions")["T"]
    if frames < 3:
        raise ShapeError(f"positions: a change of velocity needs three frames, got {frames}")
    change = torch.linalg.vector_norm(positions.diff(n=2, dim=-3), dim=-1).mean(-1) * fps  # (..., T - 2)
    padded = torch.nn.functional.pad(change, (1, 1), value=-torch.inf)
    return torch.maximum(padded[..., 1:], padded[..., :-1])


def natural_changes(positions: Tensor, fps: float) -> Tensor:
    """Computes :func:`step_changes`, m/s, of real motion (..., T, J, 3) at steps with two neighbours, one list (K,)."""
    return step_changes(positions, fps)[..., 1:-1].flatten()


def percentile(values: Tensor, natural: Tensor) -> Tensor:
    """Computes the percentile (...) in 0..100 of each value (...) in a distribution (K,); NaN for NaN.

    Raises:
        ShapeError: the distribution is empty or no list.
    """
    if natural.ndim != 1 or not len(natural):
        raise ShapeError(f"natural: expected numbers (K,), at least one; got {tuple(natural.shape)}")
    below = torch.searchsorted(natural.sort().values.to(values), values.contiguous(), right=True)
    return torch.where(values.isnan(), torch.nan, 100 * below.to(values) / len(natural))


class KeyframeError(NamedTuple):
    """How far what was given has moved, per clip."""

    mean_m: Tensor  #: (...) metres over all joints of all known frames; NaN where no frame is known
    worst_m: Tensor  #: (...) metres, the worst joint of the worst frame


def keyframe_error(predicted: Tensor, truth: Tensor, known: Tensor) -> KeyframeError:
    """Computes distances of positions (..., T, J, 3), metres, world, at the frames that were given; known (..., T)."""
    errors = joint_errors(predicted, truth, align="none")
    kept = known.bool()[..., None].expand(errors.shape)
    worst = torch.where(kept, errors, -torch.inf).amax((-1, -2))
    return KeyframeError(masked_mean(errors, kept, 2), torch.where(kept.any(-1).any(-1), worst, torch.nan))
