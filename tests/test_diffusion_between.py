"""What a model that is told begins with: straight lines, and how far from them the truth may be."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from motionlab.diffusion.between import SURE, between, doubt


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
