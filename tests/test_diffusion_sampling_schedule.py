"""The noising process: tables, noise and fewer steps. Against Bayes and diffusers: ``test_diffusion_checks``."""

import math

import pytest
import torch

from motionlab.diffusion.sampling import MOST, NoiseSchedule, cosine
from motionlab.errors import ShapeError


@pytest.fixture(scope="module")
def thousand():
    return cosine(1000)


def test_the_cosine_is_the_paper_s(thousand):
    f = [math.cos((t / 1000 + 0.008) / 1.008 * math.pi / 2) ** 2 for t in range(1001)]
    for t in (0, 1, 499, 900):
        assert thousand.alpha_bar[t].item() == pytest.approx(f[t + 1] / f[0], rel=1e-12)
    assert thousand.beta.max() <= MOST + 1e-12 and thousand.alpha_bar.dtype == torch.float64


def test_the_printed_form_never_lets_noise_win(thousand):
    printed = cosine(1000, power=1)
    assert printed.alpha_bar[499] == pytest.approx(0.703, abs=1e-3) and thousand.alpha_bar[499] == pytest.approx(
        0.494, abs=1e-3
    )
    assert printed.alpha_bar[998] > 500 * thousand.alpha_bar[998]


def test_noise_goes_in_and_comes_out(thousand, generator):
    x0, noise = torch.randn(4, 5, 3, generator=generator), torch.randn(4, 5, 3, generator=generator)
    t = torch.tensor([0, 10, 500, 990])
    xt = thousand.noised(x0, t, noise)
    torch.testing.assert_close(thousand.noise_of(x0, xt, t), noise, atol=1e-3, rtol=1e-3)
    assert torch.equal(thousand.noised(x0, -1, noise), x0)
    mean, variance = thousand.posterior(x0, xt, 0)
    torch.testing.assert_close(mean, x0)
    assert variance.abs().max() < 1e-15
    one_by_one = torch.stack([thousand.noised(x0[i], int(t[i]), noise[i]) for i in range(4)])
    torch.testing.assert_close(xt, one_by_one)


def test_fewer_steps_keep_first_last_and_level(thousand):
    ten = thousand.respaced(10)
    assert ten.stamps.tolist() == [0, 111, 222, 333, 444, 555, 666, 777, 888, 999]
    assert torch.equal(ten.alpha_bar, thousand.alpha_bar[ten.stamps])
    assert torch.allclose((1 - ten.beta).cumprod(0), ten.alpha_bar)
    assert thousand.respaced(1000).stamps.tolist() == list(range(1000))
    assert thousand.respaced(1).stamps.tolist() == [999]
    assert ten.respaced(4).stamps.tolist() == [0, 333, 666, 999]


@pytest.mark.parametrize("count", [0, 1001])
def test_impossible_spacings(thousand, count):
    with pytest.raises(ValueError, match="steps"):
        thousand.respaced(count)


def test_tables_that_are_none():
    with pytest.raises(ShapeError):
        NoiseSchedule(torch.tensor([0.5, 0.6]), torch.arange(2))
    with pytest.raises(ShapeError):
        NoiseSchedule(torch.tensor([0.6, 0.5]), torch.arange(3))
    with pytest.raises(ValueError, match="steps"):
        cosine(0)
