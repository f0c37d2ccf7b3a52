"""The preconditioned denoiser: against scipy's transform, the exact Gaussian denoiser, and the identity at no noise."""

import numpy as np
import pytest
import scipy.fft
import torch
from torch import nn

from motionlab import baselines
from motionlab.diffusion import gaussian_guess
from motionlab.diffusion import start as initial
from motionlab.diffusion.denoiser import Denoiser, _until_known
from motionlab.diffusion.sampling import cosine
from motionlab.errors import ShapeError


class Says(nn.Module):
    """A network that says the same number everywhere."""

    def __init__(self, value: float, told: bool) -> None:
        super().__init__()
        self.value, self.told = value, told

    def forward(self, x, stamps, known=None, mask=None, guess=None):
        return torch.full_like(x, self.value)


def made(spectrum, value=0.0, told=False, **how):
    frames, features = spectrum.shape
    model = gaussian_guess.Spectral(Says(value, told), cosine(1000).alpha_bar, frames, features, **how)
    model.spectrum.copy_(spectrum)
    return model


def test_the_transform_is_scipys(generator):
    x = torch.randn(3, 12, 5, generator=generator)
    expected = scipy.fft.dct(x.numpy(), axis=1, norm="ortho")
    assert np.abs((baselines.cosine_transform(12) @ x).numpy() - expected).max() < 1e-5


def test_without_a_network_it_is_the_exact_denoiser_of_gaussian_motion(generator):
    """Against the conditional mean by the covariance in time, no transform used."""
    frames, a = 8, cosine(1000).alpha_bar[400]
    power = torch.linspace(2.0, 0.1, frames)[:, None]
    basis = baselines.cosine_transform(frames)
    covariance = basis.T @ torch.diag(power[:, 0]) @ basis
    x = torch.randn(4, frames, 1, generator=generator)
    a = a.float()
    gain = a.sqrt() * covariance @ torch.linalg.inv(a * covariance + (1 - a) * torch.eye(frames))
    estimate = made(power)(x, torch.full((4,), 400))
    assert torch.allclose(estimate, gain @ x, atol=1e-5)
    assert not torch.allclose(made(torch.ones(frames, 1))(x, torch.full((4,), 400)), gain @ x, atol=1e-2)


def test_what_the_network_says_counts_in_units_of_the_filters_uncertainty(generator):
    """Over many Gaussian motions the filter's error has the deviation by which the network's word is scaled."""
    frames, t = 6, 300
    power = torch.linspace(1.5, 0.2, frames)[:, None].expand(frames, 2)
    schedule = cosine(1000)
    basis = baselines.cosine_transform(frames)
    x0 = basis.T @ (power.sqrt() * torch.randn(20_000, frames, 2, generator=generator))
    xt = schedule.noised(x0, t, torch.randn(x0.shape, generator=generator))
    stamps = torch.full((len(x0),), t)
    error = (basis @ (x0 - made(power)(xt, stamps))).std(0)
    scale = basis @ (made(power, 1.0)(xt, stamps) - made(power)(xt, stamps))[0]
    units = scale / (basis @ torch.ones(frames, 2))
    assert torch.allclose(error[:1], units[:1].abs(), rtol=0.03)  # a constant is in the first coefficient alone
    assert torch.allclose(gaussian_guess.power(x0), power, rtol=0.06)
    seen = torch.rand(len(x0), 2, generator=generator) < 0.5
    some = torch.where(seen[:, None], x0, 1e3)  # what was not recorded is not read
    assert torch.allclose(gaussian_guess.power(some, seen), power, rtol=0.08)


def test_where_there_is_no_noise_the_network_hardly_matters(generator):
    x, model = torch.randn(2, 10, 3, generator=generator), made(torch.ones(10, 3), value=5.0)
    first, last = (model(x, torch.full((2,), t)) - x for t in (0, 999))
    assert first.abs().max() < 0.2 and last.abs().max() > 1.0


# ------------------------------------------------------------------------------------------------- told what is known
@pytest.fixture
def told(generator):
    """x_t, its step, the known values (NaN elsewhere) and their mask."""
    known = torch.zeros(2, 12, 3, dtype=torch.bool)
    known[:, [1, 5]], known[1, :, 2] = True, False
    values = torch.randn(2, 12, 3, generator=generator)
    return torch.randn(2, 12, 3, generator=generator), torch.tensor([350, 600]), values, known


def test_what_is_known_comes_out_and_what_is_not_is_never_read(told):
    x, stamps, values, known = told
    model = made(torch.rand(12, 3) + 0.1, value=2.0, told=True)
    out = model(x, stamps, torch.where(known, values, torch.nan), known)
    assert torch.allclose(out[known], values[known], atol=1e-6) and out.isfinite().all()
    assert not torch.allclose(model(x, stamps)[known], values[known], atol=1e-2)


def test_without_a_guess_the_network_corrects_smooth_curves(told):
    x, stamps, values, known = told
    model, end = made(torch.rand(12, 3) + 0.1, told=True, guessed=False), torch.full((2,), 999)
    lines, seen = initial.smooth_curves(values, known), []
    model.network.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    out = model(x, stamps, values, known)
    assert model.start is None and torch.allclose(out[known], values[known], atol=1e-6)
    assert torch.allclose(model(x, end, values, known), lines, atol=1e-2) and not torch.allclose(out, lines, atol=1e-2)
    assert torch.allclose(seen[1], lines, atol=1e-2)  # from pure noise it sees no noise


def test_the_network_sees_its_start_and_what_a_model_that_is_told_nothing_sees(told):
    x, stamps, values, known = told
    model, plain = made(torch.rand(12, 3) + 0.1, told=True), made(torch.ones(12, 3))
    plain.spectrum.copy_(model.spectrum)
    seen = []
    for each in (model, plain):
        each.network.register_forward_pre_hook(lambda _, given, how: seen.append((given[0], how)), with_kwargs=True)
    model(x, stamps, values, known), plain(x, stamps)
    assert torch.equal(seen[0][0], seen[1][0]) and "guess" not in seen[1][1]
    assert torch.equal(seen[0][1]["guess"], model.start(values, known))


def test_with_a_flat_spectrum_it_is_bayes_rule_number_by_number(told):
    """Prior N(line, doubt^2 s), one observation x_t: mean and deviation by precisions, as in any textbook."""
    x, stamps, values, known = told
    s, a = 0.7, cosine(1000).alpha_bar.float()[stamps][:, None, None]
    line, prior = initial.smooth_curves(values, known), initial.doubt(known).square() * s
    precision = 1 / prior + a / (1 - a)
    mean = (line / prior + a.sqrt() * x / (1 - a)) / precision
    silent, loud = (made(torch.full((12, 3), s), v, told=True)(x, stamps, values, known) for v in (0.0, 1.0))
    free = ~known
    assert torch.allclose(silent[free], mean[free], atol=1e-5)
    assert torch.allclose((loud - silent)[free], precision.rsqrt()[free], atol=1e-5)


# --------------------------------------------------------------------------------------------- several frames a token
def test_tokens_of_several_frames_halve_the_sequence_and_keep_the_order(generator):
    model = Denoiser(4, size=16, layers=1, heads=2, hidden=16, dropout=0.0, patch=3).eval()
    lengths = []
    model.seqTransEncoder.register_forward_hook(lambda module, tokens, _: lengths.append(len(tokens[0])))
    x = torch.randn(2, 12, 4, generator=generator)
    with torch.no_grad():
        out = model(x, torch.tensor([3, 7]))
        model.output_process.poseFinal.weight.zero_()
        model.output_process.poseFinal.bias.copy_(torch.arange(12.0))
        order = model(x, torch.tensor([3, 7]))
    assert out.shape == x.shape and lengths[0] == 12 // 3 + 1
    assert torch.equal(order[0, :3], torch.arange(12.0).reshape(3, 4)) and torch.equal(order[0, 3:6], order[0, :3])
    with pytest.raises(ShapeError, match="tokens of 3"):
        model(x[:, :10], torch.tensor([3, 7]))


def test_frames_until_the_next_known_one_against_counting():
    mask = torch.zeros(1, 9, 3)
    mask[0, [0, 4]] = 1.0
    mask[0, 6, :2] = 1.0  # not whole
    assert _until_known(mask).tolist() == [[0, 3, 2, 1, 0, 9, 9, 9, 9]]


def test_a_model_that_counts_to_the_next_known_frame_notices_where_it_is(generator):
    how = {"size": 16, "layers": 1, "heads": 2, "hidden": 16, "dropout": 0.0, "told": True}
    x, mask = torch.randn(1, 8, 4, generator=generator), torch.zeros(1, 8, 4)
    mask[:, 7] = 1.0
    torch.manual_seed(0)
    plain, counting = Denoiser(4, **how).eval(), Denoiser(4, **how, arrival=True).eval()
    counting.load_state_dict(plain.state_dict())
    stamps = torch.tensor([5])
    with torch.no_grad():
        assert not torch.allclose(plain(x, stamps, x, mask), counting(x, stamps, x, mask))
    with pytest.raises(ValueError, match="arrival"):
        Denoiser(4, size=16, layers=1, heads=2, hidden=16, arrival=True)
