"""Curves through what is known: against dense algebra one column at a time, and what they are for."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import gamma, kv

from motionlab.baselines import _FRAMES, _NOISE, _matern, lines_between, smooth_curves

FRAMES = 24


def test_the_covariance_is_matern_s_with_the_bessel_function():
    """Rasmussen and Williams 2006, Eq. 4.14, nu = 3/2."""
    far = np.arange(1, FRAMES) / _FRAMES * np.sqrt(3.0)
    expected = 2 ** (1 - 1.5) / gamma(1.5) * far**1.5 * kv(1.5, far)
    np.testing.assert_allclose(_matern(FRAMES)[0, 1:], expected, rtol=1e-12)
    assert _matern(FRAMES).diagonal().unique() == 1


@given(seed=st.integers(0, 10_000), chance=st.floats(0.0, 1.0))
def test_it_is_the_process_s_conditional_mean_column_by_column(seed, chance):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(2, FRAMES, 3, generator=generator)
    known = torch.rand(x.shape, generator=generator) < chance
    found = smooth_curves(torch.where(known, x, torch.nan), known, torch.arange(3))
    cov = _matern(FRAMES).numpy()
    for rows, columns, curve in zip(x.numpy(), known.numpy(), found.numpy(), strict=True):
        for d in range(3):
            at = np.flatnonzero(columns[:, d])
            seen = cov[np.ix_(at, at)] + _NOISE * np.eye(len(at))
            expected = cov[:, at] @ np.linalg.solve(seen, rows[at, d]) if len(at) else np.zeros(FRAMES)
            expected[at] = rows[at, d]
            np.testing.assert_allclose(curve[:, d], expected, atol=2e-3)


@given(seed=st.integers(0, 10_000), chance=st.floats(0.0, 1.0))
def test_between_is_numpys_interpolation(seed, chance):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(2, 17, 3, generator=generator)
    known = torch.rand(x.shape, generator=generator) < chance
    found = lines_between(torch.where(known, x, torch.nan), known)
    for rows, columns, line in zip(x, known, found, strict=True):
        for d in range(3):
            at = np.flatnonzero(columns[:, d])
            expected = np.interp(np.arange(17), at, rows[at, d]) if len(at) else np.zeros(17)
            np.testing.assert_allclose(line[:, d], expected, atol=1e-5)


def test_smooth_motion_is_found_again_nearer_than_by_straight_lines_and_without_a_kink():
    time = torch.arange(60.0)
    x = torch.stack((torch.sin(time / 9), torch.cos(time / 14)), -1)[None]
    known = torch.ones_like(x, dtype=torch.bool)
    known[:, 22:38] = False
    smooth, straight = smooth_curves(x, known, torch.arange(2)), lines_between(x, known)
    assert torch.equal(smooth[known], x[known])
    assert (smooth - x).abs().max() < 0.25 * (straight - x).abs().max()
    bends = [m.diff(n=2, dim=1).abs()[:, [20, 21, 36, 37]].max() for m in (smooth, straight, x)]
    assert bends[0] < 2 * bends[2] < bends[1]


def test_far_from_what_is_known_it_is_zero_again():
    known = torch.zeros(1, 400, 1, dtype=torch.bool)
    known[:, 0] = True
    curve = smooth_curves(torch.ones(1, 400, 1), known, torch.arange(1))[0, :, 0]
    assert curve[0] == 1 and curve[-1].abs() < 1e-6 and (curve.diff() <= 0).all()
    assert smooth_curves(torch.ones(1, 4, 1), known[:, 1:5], torch.arange(1)).abs().max() == 0
