"""Computes a first guess of x_0 from its known entries, without a network.

``InitialGuess`` has two steps. Training windows near the known entries, or a Gaussian of few principal parts, give the
unknown entries that go with them. What is then left over at the known entries is passed on by smooth curves: the
conditional mean, number by number, of a Gaussian process in time of Matern covariance 3/2. Like cubic splines these
have a velocity that does not jump, but far from known entries they come back to zero. ``doubt`` says how far from the
guess the truth may be. ``lines_between`` gives straight lines, the input of a network that has no guess.

Source: Bishop 2006, 12.2 and 2.5.1; Rasmussen and Williams 2006, Eqs. 2.25 and 4.17 (curves); ReMoDiffuse (Zhang et al.
2023), which also recalls training motion for a diffusion model.
Differs from CondMDI, where what is not known is zero, and the network has to find all this out by itself.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from motionlab.baselines import nearest_known
from motionlab.errors import ShapeError

_PARTS, _RIDGE = 96, 40.0  # principal parts; variance of a known number about them, as known numbers say much alike
_LEARNING = 4  # every so many-th is recalled while the network is trained, where time counts more
_NEAR = 0.2  # variance of z about that of a training window that is recalled
_SURE = 10.0  # frames: at that distance from what is known a quarter of the deviation is open
_FRAMES = 30.0  # length of the curves' Gaussian process: its covariance falls to a half in so many frames
_NOISE = 1e-5  # of its variance: of what is known, so that every pattern can be solved for


def lines_between(x: Tensor, known: Tensor) -> Tensor:
    """Computes x (B, T, D) with unknown entries (not ``known``, bool B T D) interpolated linearly in time, held at the
    ends; 0 in a column without known ones. What x holds at unknown entries is never read."""
    before, after, any_known = _around(known)
    time = torch.arange(x.shape[-2], device=x.device)[:, None]
    share = (time - before) / (after - before).clamp(min=1)
    left, right = (torch.where(known, x, 0.0).gather(-2, at) for at in (before, after))
    return torch.where(any_known, left + share.to(x) * (right - left), 0.0)


def doubt(known: Tensor) -> Tensor:
    """Computes the uncertainty (B, T, D) of a guess from the mask: 0 where known, 1 in an unknown column, else (h / (h
    + ``_SURE``))^2: h, frames, half the harmonic mean of the distances to known entries on both sides, as of a Brownian
    bridge; on one side, that one."""
    before, after, any_known = _around(known)
    time = torch.arange(known.shape[-2], device=known.device)[:, None]
    left, right = (time - before).abs().float(), (after - time).abs().float()
    inside = (before <= time) & (time <= after)
    h = torch.where(inside, left * right / (left + right).clamp(min=1.0), torch.minimum(left, right))
    return torch.where(any_known, (h / (h + _SURE)).square(), 1.0)


def _same(a: Tensor, b: Tensor) -> bool:
    return a.device == b.device and a.dtype == b.dtype and torch.equal(a, b)


def _around(known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The known frames next before and after (B, T, D), both the nearest one at the ends; which columns know any."""
    before, after = (at.mT for at in nearest_known(known.mT))
    return before, after, known.any(-2, keepdim=True)


def principal(rows: Tensor, parts: int, generator: torch.Generator) -> Tensor:
    """Computes a factor F (D, K), F F^T about the covariance of centred rows (N, D): K largest axes, times deviation.

    Source: Halko et al. 2011, randomised range finder with two power iterations.
    """
    parts = min(parts, len(rows) - 1, rows.shape[1])
    basis = rows.mT @ torch.randn(len(rows), min(parts + 16, *rows.shape), generator=generator)
    for _ in range(2):
        basis = rows.mT @ (rows @ torch.linalg.qr(basis).Q)
    basis = torch.linalg.qr(basis).Q
    values, axes = torch.linalg.eigh((rows @ basis).mT.cov(correction=0))
    return basis @ axes[:, -parts:] * values[-parts:].clamp(min=0).sqrt()


class InitialGuess(nn.Module):
    """What is known (B, T, D) -> a guess of all of x_0, exact where it is known. frames, features: T and D.

    Windows are m + F z + noise of variance RIDGE, F of the principal parts. z ~ N(0, I), which is ridge regression;
    or, with ``recalls`` > 0, one of so many training windows' z_i + N(0, s I), s = ``_NEAR`` (Parzen 1962), both
    nearest neighbour and ridge regression around it: given x_K, with P = F_K^T F_K / RIDGE, A = (P + I / s)^-1 and
    b = F_K^T (x_K - m_K) / RIDGE, the mean of z is sum_i w_i A (b + z_i / s), where
    log w_i = z_i^T A b / s - z_i^T (I / s - A / s^2) z_i / 2. Buffers are data, filled by ``measure`` and stored with
    the weights. They change by ``measure`` and ``load_state_dict`` only; whoever changes them otherwise sets
    ``last`` to None.
    """

    def __init__(self, frames: int, features: int, recalls: int = 0) -> None:
        super().__init__()
        self.shape, self.recalls, self.variance = (frames, features), recalls, _NEAR if recalls else 1.0
        self.last: tuple[Tensor, Tensor, Tensor] | None = None  # what was known, and the guess: samplers ask again
        self.register_load_state_dict_post_hook(lambda start, _: setattr(start, "last", None))
        self.register_buffer("mean", torch.zeros(frames * features))
        self.register_buffer("factor", torch.zeros(frames * features, _PARTS))
        self.register_buffer("codes", torch.zeros(max(recalls, 1), _PARTS))  # z_i
        self.register_buffer("clips", torch.full((max(recalls, 1),), -1.0))  # the motions they are of

    @torch.no_grad()
    def measure(self, x: Tensor, clips: Tensor, generator: torch.Generator) -> None:
        """Measures the buffers on normalised windows (N, T, D) of motions (N,): N > ``_PARTS``, N >= ``recalls``."""
        rows = x.flatten(1)
        if len(rows) <= max(_PARTS, self.recalls - 1):
            raise ShapeError(f"x: expected {max(_PARTS + 1, self.recalls)} windows or more, got {len(rows)}")
        self.last = None
        self.mean.copy_(rows.mean(0))
        self.factor.copy_(principal(rows - self.mean, _PARTS, generator))
        if self.recalls:
            rows, self.clips[:] = rows[: self.recalls] - self.mean, clips[: self.recalls]
            self.codes.copy_(torch.linalg.solve(self.factor.mT @ self.factor, (rows @ self.factor).mT).mT)

    @torch.no_grad()
    def forward(self, known: Tensor, mask: Tensor, own: Tensor | None = None) -> Tensor:
        """Computes a guess (B, T, D) from known numbers and a mask (bool), (B, T, D); ``known`` is not read elsewhere.
        own (B,): motions that must not be recalled, as what a window was cut from when it is trained on."""
        if known.shape[1:] != self.shape:
            raise ShapeError(f"known: expected {self.shape[0]} frames of {self.shape[1]} numbers, got {known.shape}")
        known = torch.where(mask, known, 0.0)
        if self.training or own is not None:
            return self._guess(known, mask, own)
        if self.last is None or not all(_same(a, b) for a, b in zip(self.last, (mask, known), strict=False)):
            self.last = (mask.clone(), known, self._guess(known, mask, None))
        return self.last[2].clone()

    def _guess(self, known: Tensor, mask: Tensor, own: Tensor | None) -> Tensor:
        weight, off = mask.flatten(1).to(known) / _RIDGE, known.flatten(1) - self.mean
        off, eye = torch.where(mask.flatten(1), off, 0.0), torch.eye(_PARTS).to(known) / self.variance
        inverse = torch.linalg.inv((self.factor.mT * weight[:, None]) @ self.factor + eye)
        seen = (inverse @ ((weight * off) @ self.factor)[..., None])[..., 0]
        near = self._recalled(inverse, seen, eye, own)
        guess = self.mean + (seen + (inverse @ near[..., None])[..., 0] / self.variance) @ self.factor.mT
        guess = guess.unflatten(1, self.shape)
        return guess + smooth_curves(known - guess, mask)

    def _recalled(self, inverse: Tensor, seen: Tensor, eye: Tensor, own: Tensor | None) -> Tensor:
        """sum_i w_i z_i (B, K)."""
        every = slice(None, None, _LEARNING if self.training else 1)
        codes, clips = self.codes[every], self.clips[every]
        square = (codes @ (eye - inverse / self.variance**2) * codes).sum(-1)
        odds = seen @ codes.mT / self.variance - square / 2
        if own is not None:
            odds = odds.masked_fill(clips == own[:, None], -torch.inf)
        return odds.softmax(-1).nan_to_num(0.0) @ codes


def _matern(frames: int) -> Tensor:
    """Covariance (T, T) of the curves' process, float64, variance 1."""
    time = torch.arange(frames, dtype=torch.float64)
    far = 3**0.5 * (time[:, None] - time).abs() / _FRAMES
    return (1 + far) * torch.exp(-far)


def smooth_curves(x: Tensor, known: Tensor) -> Tensor:
    """Computes x (B, T, D) with smooth curves through what is known (bool, B T D), 0 in a column that knows nothing.
    What x holds elsewhere is never read."""
    patterns, which = torch.unique(known.mT.reshape(-1, x.shape[-2]), dim=0, return_inverse=True)
    told = torch.where(known, x, 0.0)
    drawn = torch.einsum("cij,cj->ci", curve_weights(patterns).to(x)[which], told.mT.reshape(len(which), -1))
    return torch.where(known, x, drawn.unflatten(0, (len(x), -1)).mT)


def curve_weights(patterns: Tensor) -> Tensor:
    """Computes what a smooth curve is of what it knows: (P, T, T), float64, for patterns of known frames (P, T)."""
    seen, cov = patterns.double(), _matern(patterns.shape[-1]).to(patterns.device)
    square = seen[:, :, None] * cov * seen[:, None] + torch.diag_embed(1 - seen + _NOISE)
    return cov @ (seen[:, :, None] * torch.linalg.inv(square) * seen[:, None])
