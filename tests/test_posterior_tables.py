from types import SimpleNamespace

import pytest
import torch

from studies.nb09_posterior import tables
from studies.nb09_posterior.trials import Draws


def clip(size=4):
    hidden = torch.ones(5, 6, dtype=torch.bool)
    return SimpleNamespace(
        point=SimpleNamespace(hidden=hidden, size=99),
        directions=SimpleNamespace(spread=torch.ones(size).double(), share=0.6),
        size=size, width=lambda: 0.02,
    )  # fmt: skip


def draws(generator, count=300):
    ways = 0.01 * torch.randn(count, 5, 6, 3, generator=generator)
    return Draws(None, None, ways, torch.randn(count, 4, generator=generator, dtype=torch.float64))


def test_refused_chains_are_left_out_and_said_so(generator):
    clips, exact = [clip()] * 3, [torch.zeros(4).double()] * 3
    found = tables.judged(clips, [draws(generator), None, draws(generator)], exact)
    assert found.clips == [0, 2] and found.ranks.shape == (2, 4)
    assert found.width == pytest.approx(100 * (4 / 30) ** 0.5, rel=0.1)
    assert tables.held(found, generator).endswith("n = 2")
    assert tables.judged(clips, [None] * 3, exact) is None and tables.held(None, generator) == "refused"
