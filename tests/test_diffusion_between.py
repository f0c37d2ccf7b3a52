"""What a model that is told begins with: straight lines, and how far from them the truth may be."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from motionlab.diffusion.between import PARTS, RIDGE, SURE, Start, between, doubt
from motionlab.errors import ShapeError


@given(seed=st.integers(0, 10_000), chance=st.floats(0.0, 1.0))
def test_between_is_numpys_interpolation(seed, chance):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(2, 17, 3, generator=generator)
    known = torch.rand(x.shape, generator=generator) < chance
    found = between(torch.where(known, x, torch.nan), known)
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
    assert found[0, 4, 0] == pytest.approx((2 * 3 / 5) / (2 * 3 / 5 + SURE))  # 2 and 3 frames from what is known
    assert found[0, 11, 0] == pytest.approx(4 / (4 + SURE))  # known on one side only


def test_doubt_grows_with_the_gap():
    def middle(length):
        known = torch.ones(1, 60, 1, dtype=torch.bool)
        known[0, 10 : 10 + length] = False
        return float(doubt(known).max())

    assert 0 < middle(1) < middle(10) < middle(30) < 1


# -------------------------------------------------------------------------------------------------- with correlations
@pytest.fixture
def windows(generator):
    """Correlated rows (N, T, D), more of them than principal parts."""
    mixed = torch.randn(200, 30, generator=generator) @ torch.randn(30, 8 * 12, generator=generator)
    return 2.0 + mixed.unflatten(1, (8, 12)) + 0.1 * torch.randn(200, 8, 12, generator=generator)


def test_the_start_is_ridge_regression_and_lines_through_what_it_leaves(windows, generator):
    """Against the Gaussian's conditional mean by its covariance, in NumPy."""
    start = Start(8, 12)
    start.measure(windows, generator)
    known = torch.rand(3, 8, 12, generator=generator) < 0.4
    found = start(torch.where(known, windows[:3], torch.nan), known)
    rows = windows.flatten(1).double().numpy()
    centred = rows - rows.mean(0)
    size, parts = np.linalg.eigh(np.cov(centred.T, bias=True))
    size, parts = size[-PARTS:], parts[:, -PARTS:]
    covariance = (parts * size) @ parts.T
    for x, mask, line in zip(rows, known.flatten(1).numpy(), found, strict=False):
        square = covariance[np.ix_(mask, mask)] + RIDGE * np.eye(mask.sum())
        guess = rows.mean(0) + covariance[:, mask] @ np.linalg.solve(square, (x - rows.mean(0))[mask])
        left = torch.from_numpy(x - guess).reshape(8, 12)
        expected = guess.reshape(8, 12) + between(left, torch.from_numpy(mask).reshape(8, 12)).numpy()
        np.testing.assert_allclose(line, expected, atol=2e-3)
    assert torch.allclose(found[known], windows[:3][known], atol=1e-4)


def test_where_nothing_is_known_the_start_is_the_mean(windows, generator):
    start = Start(8, 12)
    start.measure(windows, generator)
    nothing = torch.zeros(1, 8, 12, dtype=torch.bool)
    assert torch.allclose(start(torch.full((1, 8, 12), torch.nan), nothing)[0], windows.mean(0), atol=1e-4)


def test_what_goes_together_is_found_where_lines_know_nothing(windows, generator):
    start = Start(8, 12)
    start.measure(windows, generator)
    known = torch.ones(200, 8, 12, dtype=torch.bool)
    known[..., :3] = False  # columns of which nothing is known
    error = (start(windows, known) - windows)[~known].square().mean()
    assert error < 0.2 * (windows.mean(0) - windows)[~known].square().mean()
    assert error < 0.2 * (between(windows, known) - windows)[~known].square().mean()


def test_other_windows_are_refused(windows, generator):
    start = Start(8, 12)
    with pytest.raises(ShapeError, match="more than"):
        start.measure(windows[:PARTS], generator)
    with pytest.raises(ShapeError, match="8 frames of 12"):
        start(windows[:, :6], windows[:, :6] > 0)
