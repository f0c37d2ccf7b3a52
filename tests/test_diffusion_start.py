"""What a model that is told begins with: lines, recalled motion, and how far from them the truth may be."""

import numpy as np
import pytest
import scipy.special
import scipy.stats
import torch
from hypothesis import given
from hypothesis import strategies as st

from motionlab.diffusion.start import _PARTS, _RIDGE, _SURE, InitialGuess, doubt, lines_between, smooth_curves
from motionlab.errors import ShapeError


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


def test_doubt_is_zero_where_known_and_one_where_nothing_is():
    known = torch.zeros(1, 12, 2, dtype=torch.bool)
    known[0, [2, 7], 0] = True
    found = doubt(known)
    assert (found[0, [2, 7], 0] == 0).all() and (found[0, :, 1] == 1).all()
    assert found[0, 4, 0] == pytest.approx(((2 * 3 / 5) / (2 * 3 / 5 + _SURE)) ** 2)  # 2 and 3 frames away
    assert found[0, 11, 0] == pytest.approx((4 / (4 + _SURE)) ** 2)  # known on one side only


# -------------------------------------------------------------------------------------------------- with correlations
CLIPS = torch.arange(200) // 10


@pytest.fixture
def windows(generator):
    """Correlated rows (N, T, D), more of them than principal parts."""
    mixed = torch.randn(200, 30, generator=generator) @ torch.randn(30, 8 * 12, generator=generator)
    return 2.0 + mixed.unflatten(1, (8, 12)) + 0.1 * torch.randn(200, 8, 12, generator=generator)


def measured(windows, generator, recalls=0):
    start = InitialGuess(8, 12, recalls)
    start.measure(windows, CLIPS, generator)
    return start.eval()


def by_bayes(start, x, mask, left_out=()):
    """The mixture's conditional mean by its densities and covariances, component by component, in SciPy."""
    mean, factor, codes = (v.double().numpy() for v in (start.mean, start.factor, start.codes))
    f, noise = factor[mask], _RIDGE * np.eye(mask.sum())
    square = start.variance * f @ f.T + noise
    odds, means = [], []
    for i, code in enumerate(codes):
        if i not in left_out:
            at = mean[mask] + f @ code
            odds.append(scipy.stats.multivariate_normal.logpdf(x[mask], at, square))
            means.append(code + start.variance * f.T @ np.linalg.solve(square, x[mask] - at))
    guess = mean + factor @ (scipy.special.softmax(odds) @ np.array(means))
    left = torch.from_numpy(x - guess).reshape(1, 8, 12)
    return guess.reshape(8, 12) + smooth_curves(left, torch.from_numpy(mask).reshape(1, 8, 12))[0].numpy()


@pytest.mark.parametrize("recalls", [0, 150])
def test_the_start_is_bayes_rule_and_curves_through_what_it_leaves(windows, generator, recalls):
    start = measured(windows, generator, recalls)
    known = torch.rand(3, 8, 12, generator=generator) < 0.4
    found = start(torch.where(known, windows[:3], torch.nan), known)
    for x, mask, line in zip(windows, known.flatten(1), found, strict=False):
        expected = by_bayes(start, x.flatten().double().numpy(), mask.numpy())
        np.testing.assert_allclose(line, expected, atol=5e-3)
    assert torch.allclose(found[known], windows[:3][known], atol=1e-4)


def test_without_recalling_it_is_ridge_regression(windows, generator):
    start = measured(windows, generator)
    known = torch.zeros(1, 8, 12, dtype=torch.bool)
    known[..., 3:] = True  # columns known throughout, so that curves add nothing elsewhere
    rows, mask = windows.flatten(1).double().numpy(), known.flatten().numpy()
    f, off = start.factor.double().numpy(), rows - start.mean.double().numpy()
    stacked = np.concatenate((f[mask], _RIDGE**0.5 * np.eye(_PARTS)))  # ridge as least squares
    learnt = np.linalg.lstsq(stacked, np.concatenate((off[0, mask], np.zeros(_PARTS))))[0]
    expected = start.mean.double().numpy() + f @ learnt
    np.testing.assert_allclose(start(windows[:1], known)[0, :, :3], expected.reshape(8, 12)[:, :3], atol=5e-3)


def test_the_motion_a_window_is_of_is_not_recalled_where_it_must_not_be(windows, generator):
    start = measured(windows, generator, 200)
    known = torch.rand(1, 8, 12, generator=generator) < 0.5
    x, mask = windows[:1], known.flatten().numpy()
    free, kept = start(x, known), start(x, known, torch.tensor([0]))
    expected = by_bayes(start, x.flatten().double().numpy(), mask, left_out=range(10))
    np.testing.assert_allclose(kept[0], expected, atol=5e-3)
    assert (free - x).square().mean() < (kept - x).square().mean()


def test_where_nothing_is_known_the_start_is_the_mean(windows, generator):
    nothing = torch.zeros(1, 8, 12, dtype=torch.bool)
    for recalls in (0, 200):
        found = measured(windows, generator, recalls)(torch.full((1, 8, 12), torch.nan), nothing)[0]
        assert torch.allclose(found, windows.mean(0), atol=1e-2)


def test_what_goes_together_is_found_where_curves_know_nothing(windows, generator):
    start = measured(windows, generator)
    known = torch.ones(200, 8, 12, dtype=torch.bool)
    known[..., :3] = False  # columns of which nothing is known
    error = (start(windows, known) - windows)[~known].square().mean()
    assert error < 0.2 * (windows.mean(0) - windows)[~known].square().mean()
    assert error < 0.2 * (smooth_curves(windows, known) - windows)[~known].square().mean()


def test_a_guess_is_kept_for_as_long_as_the_question_is_the_same(windows, generator, monkeypatch):
    start, other = measured(windows, generator), measured(windows[:150], generator)
    asked, guess = [], InitialGuess._guess
    monkeypatch.setattr(InitialGuess, "_guess", lambda self, *given: asked.append(1) or guess(self, *given))
    known = torch.rand(3, 8, 12, generator=generator) < 0.4
    first = start(windows[:3], known)
    assert torch.equal(start(torch.where(known, windows[:3], torch.nan), known.clone()), first) and len(asked) == 1
    for x, mask in ((windows[3:6], known), (windows[:3], ~known), (windows[:2], known[:2])):
        assert torch.equal(start(x, mask), guess(start, torch.where(mask, x, 0.0), mask, None))
    assert len(asked) == 4
    start.load_state_dict(other.state_dict())
    assert torch.equal(start(windows[:2], known[:2]), other(windows[:2], known[:2]))
    assert not torch.allclose(start(windows[:3], known), first)


def test_other_windows_are_refused(windows, generator):
    start = InitialGuess(8, 12)
    with pytest.raises(ShapeError, match="97 windows or more"):
        start.measure(windows[:_PARTS], CLIPS[:_PARTS], generator)
    with pytest.raises(ShapeError, match="300 windows or more"):
        InitialGuess(8, 12, 300).measure(windows, CLIPS, generator)
    with pytest.raises(ShapeError, match="8 frames of 12"):
        start(windows[:, :6], windows[:, :6] > 0)
