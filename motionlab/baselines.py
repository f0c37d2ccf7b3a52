"""Fills gaps, puts noise on motions and smooths it away without a model, as baselines: curves, filters.

Gaps are given by ``known``: (T,) or (..., T) for whole frames, (..., T, J) with all axes for single joints, True where
the motion may be used; what is known stays exactly. Contacts of a filled or smoothed motion are dropped.

``smooth_curves`` are, number by number, the conditional mean of a Gaussian process in time of Matern covariance 3/2.
Like cubic splines these have a velocity that does not jump, but far from known entries they come back to zero.

Source: Rasmussen and Williams 2006, Eqs. 2.25 and 4.17; noise: thesis 4.2.1, "Denoising: come up with a better test".
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.motion import Motion

_FRAMES = 30.0  # length of the curves' Gaussian process: its covariance falls to a half in so many frames
_NOISE = 1e-5  # of its variance: of what is known, so that every pattern can be solved for
_LIVELY, _QUICK = 2.5, 1.0  # strength of acceleration that is motion: rad/s^(3/2) of joints, m/s^(3/2) of the root


def _mask(known: Tensor, motion: Motion) -> Tensor:
    """The mask as bool (..., T, J): of joints where it has an axis more than frames have."""
    whole = known.bool() if known.ndim == motion.root.ndim else known.bool()[..., None]
    shape = motion.rot.shape[:-2]
    fits = all(k in (1, n) for k, n in zip(whole.shape[::-1], shape[::-1], strict=False))
    if not fits or whole.shape[-2:-1] != shape[-2:-1] or whole.ndim > len(shape):
        raise ShapeError(f"known: expected (..., {motion.frames}) or {tuple(shape)}, got {tuple(known.shape)}")
    if not whole.any(-2).all():
        raise ShapeError("known: some joint is known at no frame, so there is nothing to fill it from")
    return whole.expand(shape)


def nearest_known(known: Tensor) -> tuple[Tensor, Tensor]:
    """Computes the nearest known frame at or before each frame, and at or after it, from a mask of known frames.

    known: (..., T) bool. Returns two (..., T) int64 frame indices, always within 0..T-1: before the first known frame
    both are the first one, after the last one both are the last; without meaning in a row that knows no frame.
    """
    frames = known.shape[-1]
    time = torch.arange(frames, device=known.device).expand(known.shape)
    before = torch.where(known, time, -1).cummax(-1).values
    after = torch.where(known, time, frames).flip(-1).cummin(-1).values.flip(-1)
    before, after = torch.where(before < 0, after, before), torch.where(after == frames, before, after)
    return before.clamp(0, frames - 1), after.clamp(0, frames - 1)


def cosine_transform(frames: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Computes the orthonormal cosine transform over time (DCT-II), C (T, T): C @ x (..., T, D) are coefficients.

    dtype: what it is computed in; it comes as float32. In float32 entries are off by 1e-5, as in the fits on record,
    whose first few steps amplify that.
    """
    k = torch.arange(frames, dtype=dtype)
    basis = (math.pi * k[:, None] * (k + 0.5) / frames).cos() * (2 / frames) ** 0.5
    basis[0] /= 2**0.5
    return basis.float()


def between_known(known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Computes for each frame of a mask (..., T, K) the last known one and the next, as :func:`nearest_known`, and how
    far between them it is (0..1)."""
    time = torch.arange(known.shape[-2], device=known.device)[:, None]
    before, after = (at.mT for at in nearest_known(known.mT))
    return before, after, (time - before) / (after - before).clamp(min=1)


def _take(x: Tensor, frames: Tensor) -> Tensor:
    """x (..., T, K, *rest) at the frames (..., T, K) of each k."""
    rest = x.ndim - frames.ndim
    index = frames.reshape(*frames.shape, *(1,) * rest).expand(x.shape)
    return x.gather(frames.ndim - 2, index)


def interpolate(motion: Motion, known: Tensor) -> Motion:
    """Fills unknown root positions linearly and rotations by slerp between the known frames around; ends hold."""
    known = _mask(known, motion)
    before, after, weight = between_known(known)
    weight = weight.to(motion.rot)
    start, stop = (_take(motion.root[..., None, :], at[..., :1])[..., 0, :] for at in (before, after))
    root = torch.lerp(start, stop, weight[..., :1])
    rot = rotation.slerp(_take(motion.rot, before), _take(motion.rot, after), weight)
    root = torch.where(known[..., :1], motion.root, root)
    rot = torch.where(known[..., None, None], motion.rot, rot)
    return replace(motion, root=root, rot=rot, contacts=None)


def savitzky_golay(x: Tensor, window: int, degree: int) -> Tensor:
    """Smooths x (..., T, D) by a polynomial of ``degree`` through ``window`` (odd) frames around each; no gradient.

    Raises:
        ShapeError: the window is longer than the recording, even, or not longer than the degree.
    """
    sizes = check_shape(x, "... T D", "x")
    if not degree < window <= sizes["T"] or window % 2 == 0:
        raise ShapeError(f"window {window}: expected an odd number over degree {degree} and up to T = {sizes['T']}")
    from scipy.signal import savgol_filter  # takes most of a second to load

    smooth = savgol_filter(x.detach().cpu().double().numpy(), window, degree, axis=-2)
    return torch.as_tensor(smooth).to(x)


def kalman(x: Tensor, fps: float, noise: float, acceleration: float) -> Tensor:
    """Smooths x (..., T, D) as a constant-velocity Kalman filter and Rauch-Tung-Striebel smoother do; no gradient.

    The mean of p given x in: x_t = p_t + noise, dp = v dt, dv = white noise. It is a cubic smoothing spline, so that
    one banded system gives all frames.

    Args:
        noise: standard deviation of a measurement, in units of x.
        acceleration: strength of the white acceleration, units of x / s^(3/2).

    Source: Wahba 1978 (the mean is a spline); Reinsch 1967 (its system).
    Raises:
        ValueError: fps, noise or acceleration is not a finite number above zero (without spread nothing weighs
            one measurement against another).
        DataError: x is not finite.
    """
    check_shape(x, "... T D", "x")
    for name, value in (("fps", fps), ("noise", noise), ("acceleration", acceleration)):
        if not 0 < value < torch.inf:
            raise ValueError(f"{name}: expected a finite number above zero, got {value}")
    if not x.isfinite().all():
        raise DataError("x holds NaN or infinity", remedy="fill it first")
    if x.shape[-2] < 3:  # on one line
        return x
    from scipy.linalg import solveh_banded

    z, stiff = x.movedim(-2, 0).double().numpy(force=True), (noise / acceleration) ** 2
    system = stiff * fps**2 * np.array([1, -4, 6]) + np.array([0, 1 / 6, 2 / 3]) / fps  # diagonals, the main one last
    bend = fps * np.diff(z, 2, axis=0).reshape(len(z) - 2, -1)
    bend = solveh_banded(np.repeat(system[:, None], len(bend), 1), bend)  # second derivatives at inner frames
    smooth = z - stiff * fps * np.diff(np.pad(bend, ((2, 2), (0, 0))), 2, axis=0).reshape(z.shape)
    return torch.as_tensor(smooth).movedim(0, -2).to(x)


def smooth(motion: Motion, smoother: Callable[[Tensor], Tensor]) -> Motion:
    """Smooths a motion's root positions and joint rotations by ``smoother``, (..., T, D) -> (..., T, D).

    Rotations as tangent vectors at each joint's mean, continuous in time, so a joint that spins is followed round.
    """
    centre = rotation.mean(motion.rot.movedim(-4, -3))[..., None, :, :, :]
    tangent = rotation.unroll_axis_angle(rotation.log(centre.mT @ motion.rot), dim=-3)
    rot = centre @ rotation.exp(smoother(tangent.flatten(-2)).unflatten(-1, (-1, 3)))
    return replace(motion, root=smoother(motion.root), rot=rot, contacts=None)


def smoothed(motion: Motion, window: int) -> Motion:
    """Smooths a motion by a Savitzky-Golay filter of degree 2 and ``window`` frames; 0: as it is."""
    return smooth(motion, lambda x: savitzky_golay(x, window, 2)) if window else motion


def lines_between(x: Tensor, known: Tensor) -> Tensor:
    """Computes x (B, T, D) with unknown entries (not ``known``, bool B T D) interpolated linearly in time, held at the
    ends; 0 in a column without known ones. What x holds at unknown entries is never read."""
    before, after, share = between_known(known)  # both the nearest one at the ends
    left, right = (torch.where(known, x, 0.0).gather(-2, at) for at in (before, after))
    return torch.where(known.any(-2, keepdim=True), left + share.to(x) * (right - left), 0.0)


def _matern(frames: int) -> Tensor:
    """Covariance (T, T) of the curves' process, float64, variance 1."""
    time = torch.arange(frames, dtype=torch.float64)
    far = 3**0.5 * (time[:, None] - time).abs() / _FRAMES
    return (1 + far) * torch.exp(-far)


def smooth_curves(x: Tensor, known: Tensor, owners: Tensor) -> Tensor:
    """Computes x (B, T, D) with smooth curves through what is known, 0 in a column that knows nothing. What x holds
    elsewhere is never read.

    known (B, T, U), bool: units; owners (D,): the unit that each number belongs to.
    """
    patterns, which = torch.unique(known.mT.flatten(0, 1), dim=0, return_inverse=True)
    which = which.unflatten(0, (len(known), -1))[:, owners].flatten()
    told = torch.where(known[..., owners], x, 0.0).mT.flatten(0, 1)
    drawn = torch.zeros_like(told)
    for k, weights in enumerate(curve_weights(patterns).to(told)):
        mine = (which == k).nonzero()[:, 0]
        drawn[mine] = told[mine] @ weights.mT
    return torch.where(known[..., owners], x, drawn.unflatten(0, (len(known), -1)).mT)


def curve_weights(patterns: Tensor) -> Tensor:
    """Computes what a smooth curve is of what it knows: (P, T, T), float64, for patterns of known frames (P, T)."""
    seen, cov = patterns.double(), _matern(patterns.shape[-1]).to(patterns.device)
    square = seen[:, :, None] * cov * seen[:, None] + torch.diag_embed(1 - seen + _NOISE)
    return cov @ (seen[:, :, None] * torch.linalg.inv(square) * seen[:, None])


@dataclass(frozen=True)
class Noise:
    """turn: radians about each axis of every joint. shift: metres along each axis of the root. Standard deviations.

    lasting: correlation of one frame's noise with the next one's; 0: every frame's is new.
    """

    turn: float
    shift: float
    lasting: float = 0.0

    @classmethod
    def of(cls, degrees: float, centimetres: float, lasting: float = 0.0) -> Self:
        """Returns the noise of so many degrees and centimetres."""
        return cls(degrees * torch.pi / 180, centimetres / 100, lasting)

    def on(self, motion: Motion, generator: torch.Generator) -> Motion:
        """Adds this noise to a motion; contacts are dropped."""
        dim = motion.root.ndim - 2
        turn = self.turn * _steady((*motion.rot.shape[:-2], 3), generator, dim=dim, lasting=self.lasting)
        shift = self.shift * _steady(motion.root.shape, generator, dim=dim, lasting=self.lasting)
        return replace(motion, root=motion.root + shift, rot=motion.rot @ rotation.exp(turn), contacts=None)


def denoised(motion: Motion, noise: Noise) -> Motion:
    """Computes a motion without most of its noise: a Kalman smoother over joints and root, each with its own."""

    turn, shift = (max(size, 1e-6) for size in (noise.turn, noise.shift))
    turned = smooth(motion, lambda x: kalman(x, motion.fps, turn, _LIVELY))
    return replace(turned, root=kalman(motion.root, motion.fps, shift, _QUICK))


def _steady(shape: Sequence[int], generator: torch.Generator, *, dim: int, lasting: float) -> Tensor:
    """Standard normal numbers of which those next to each other along ``dim`` have correlation ``lasting``."""
    fresh = torch.randn(shape, generator=generator).movedim(dim, 0)
    out = [fresh[0]]
    for now in fresh[1:]:
        out.append(lasting * out[-1] + (1 - lasting**2) ** 0.5 * now)
    return torch.stack(out).movedim(0, dim)
