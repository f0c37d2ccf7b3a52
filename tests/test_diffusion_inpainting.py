"""Known parts put back: what is exact, what is noised, and what the seam looks like."""

import pytest
import torch

from motionlab.diffusion import sampling
from motionlab.diffusion.sampling import Inpainting, cosine
from studies.nb10_how_it_works.checks import GaussianData

T = 24


@pytest.fixture(scope="module")
def data():
    """Smooth curves (T numbers, one column): the covariance of a slow random walk."""
    at = torch.arange(T, dtype=torch.float64)
    return GaussianData(torch.zeros(T).double(), torch.exp(-0.5 * ((at[:, None] - at) / 6) ** 2) + 1e-4 * torch.eye(T))


@pytest.fixture(scope="module")
def denoise(data):
    inner = data.denoiser(SCHEDULE)
    return lambda x, stamps: inner(x[..., 0], stamps)[..., None]


SCHEDULE = cosine(1000).respaced(60)
M = torch.zeros(T, 1)
M[:8], M[-3:] = 1, 1


def curves(data, count, generator):
    factor = torch.linalg.cholesky(data.covariance)
    return (torch.randn(count, T, generator=generator, dtype=torch.float64) @ factor.T)[..., None]


def made(denoise, known, generator, mask=M, **how):
    return sampling.inpaint(denoise, cosine(1000), known, mask.bool(), generator, Inpainting(60, **how))


def test_the_known_part_is_noised_to_the_step_before(generator):
    """Eq. 4.10: mean and spread of what is put back behind a step are those of the next one's x_t."""
    known, seen = torch.full((20_000, T, 1), 2.0, dtype=torch.float64), {}
    x = made(lambda x, stamps: seen.setdefault(int(stamps[0]), x) * 0 - 7.0, known, generator)
    for t in (0, 29, 58):
        a, x_t = SCHEDULE.alpha_bar[t], seen[int(SCHEDULE.stamps[t])]
        assert x_t[:, 0].mean() == pytest.approx(2 * a.sqrt().item(), abs=0.03)
        assert x_t[:, 0].std() == pytest.approx((1 - a).sqrt().item(), abs=0.03)
    assert torch.equal(x[:, :8], known[:, :8]) and (x[:, 12] == -7).all()


def conditional(data, known):
    """Mean (B, T) and standard deviation (T,) of the unknown given the known, exactly."""
    sure = M[:, 0].bool()
    a, b = data.covariance[~sure][:, sure], data.covariance[sure][:, sure]
    gain = a @ torch.linalg.inv(b)
    return known[:, sure, 0] @ gain.T, (data.covariance[~sure][:, ~sure] - gain @ a.T).diagonal().clamp(min=0).sqrt()


def test_guidance_comes_nearer_to_the_exact_conditional(data, denoise, generator):
    """Distance of the samples' mean from the true conditional mean, over many samples of each of a few curves."""
    known = curves(data, 6, generator).repeat_interleave(150, 0)
    truth, _ = conditional(data, known)

    def miss(x):
        mean = x[:, ~M[:, 0].bool(), 0].reshape(6, 150, -1).mean(1)
        return (mean - truth[::150]).square().mean().sqrt().item()

    plain, guided = made(denoise, known, generator), made(denoise, known, generator, guidance_weight=2.0)
    ignorant = made(denoise, known, generator, 0 * M)
    assert miss(guided) < 0.85 * miss(plain) < 0.7 * miss(ignorant)


def test_soft_masks_fall_beside_what_is_known():
    known = torch.zeros(10, 2, dtype=torch.bool)
    known[:3, 0] = True
    _, soft = sampling._softened(torch.zeros(10, 2), known, 3)
    assert soft[:, 0].tolist() == pytest.approx([1, 1, 1, 0.75, 0.5, 0.25, 0, 0, 0, 0])
    assert soft[:, 1].abs().max() == 0
    assert torch.equal(sampling._softened(torch.zeros(10, 2), known, 0)[1], known.float())


def test_the_finish_is_exact_and_smooth():
    """A line, known two units higher at both ends with another slope: no jump of value or velocity anywhere."""
    time = torch.arange(60, dtype=torch.float64)
    x = (0.1 * time)[None, :, None]
    known = (2 + 0.2 * time)[None, :, None]
    m = torch.zeros(60, 1)
    m[:10], m[-10:] = 1, 1
    found = sampling.offset_decay(x, known, m, 15)
    assert torch.equal(found[:, :10], known[:, :10]) and torch.equal(found[:, -10:], known[:, -10:])
    assert torch.equal(found[:, 26:34], x[:, 26:34])  # beyond both fades
    bend = found.diff(n=2, dim=1).abs().max()
    pasted = torch.where(m.bool(), known, x).diff(n=2, dim=1).abs().max()
    assert bend < 0.25 < 2 < pasted  # six offsets over the fade squared, at most


def test_the_finish_in_a_short_gap_and_at_one_side(generator):
    x, known = (torch.randn(2, 20, 3, generator=generator).cumsum(1) for _ in range(2))
    m = torch.ones(20, 3)
    m[8:11], m[15:, 2] = 0, 0
    found = sampling.offset_decay(x, known, m, 10)
    sure = m.bool().expand_as(x)
    assert torch.equal(found[sure], known[sure]) and found.isfinite().all()
    same = sampling.offset_decay(known, known, m, 10)
    assert torch.equal(same, known)
    nothing = sampling.offset_decay(x, known, torch.zeros(20, 3), 10)
    assert torch.equal(nothing, x)
