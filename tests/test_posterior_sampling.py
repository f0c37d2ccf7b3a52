import emcee
import numpy as np
import pytest
import torch

from motionlab import posterior
from motionlab.errors import DataError, NotConverged, ShapeError
from motionlab.posterior import _guess, _times, mixed, sample, walk

COV = torch.tensor([[1.0, 1.8, 0.0], [1.8, 4.0, 0.0], [0.0, 0.0, 0.01]], dtype=torch.float64)
MEAN = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
PRECISION = COV.inverse()


def gaussian(x):
    return -0.5 * ((x - MEAN) @ PRECISION * (x - MEAN)).sum(-1)


def near(generator, walkers=24, spread=1.0):
    noise = torch.randn(walkers, 3, generator=generator, dtype=torch.float64)
    return MEAN + spread * noise @ torch.linalg.cholesky(COV).mT


@pytest.mark.parametrize("moves", ["mixed", "mixed, wrong guess"])
def test_correlated_gaussian_is_found_within_sampling_error(generator, moves):
    guess = {
        "mixed": mixed(MEAN, torch.linalg.cholesky(COV)),
        "mixed, wrong guess": mixed(MEAN + 0.5 * torch.linalg.cholesky(COV)[:, 0], 0.75 * torch.linalg.cholesky(COV)),
    }[moves]
    found = sample(gaussian, near(generator), names="abc", generator=generator, steps=20_000, block=500, moves=guess)
    draws = found.draws()
    effective = len(draws) / found.times.amax().item()  # walkers are not independent: this is the most there can be
    assert effective > 24 * 50 * 0.99
    sigma = COV.diagonal().sqrt()
    assert ((draws.mean(0) - MEAN).abs() < 5 * sigma / effective**0.5).all()
    assert ((draws.std(0) / sigma - 1).abs() < 5 / (2 * effective) ** 0.5).all()
    assert draws.mT.corrcoef()[0, 1] == pytest.approx(0.9, abs=5 * (1 - 0.81) / effective**0.5)


def test_interval_and_report_say_what_the_gaussian_says(generator):
    found = sample(
        gaussian, near(generator), names="abc", units=("m", "s", "kg"), generator=generator, steps=20_000, block=1000,
        moves=mixed(MEAN, torch.linalg.cholesky(COV)),
    )  # fmt: skip
    median, low, high = found.summary(0.9)["b"]
    assert median == pytest.approx(-2.0, abs=0.2)
    assert (low, high) == (pytest.approx(-2 - 2 * 1.645, abs=0.3), pytest.approx(-2 + 2 * 1.645, abs=0.3))
    row = found.report()[1]
    assert row["number"] == "b" and row["unit"] == "s" and float(row["length, such times"]) >= posterior.LEAST


def test_times_of_a_process_with_a_known_one(generator):
    """AR(1) with coefficient 0.9: (1 + 0.9) / (1 - 0.9) = 19 steps."""
    random = np.random.default_rng(3)
    x, chain = random.normal(size=16), np.empty((40_000, 16, 1))
    for step in range(len(chain)):
        x = 0.9 * x + (1 - 0.81) ** 0.5 * random.normal(size=16)
        chain[step, :, 0] = x
    assert _times(torch.from_numpy(chain)).item() == pytest.approx(19, rel=0.1)
    assert _times(torch.from_numpy(random.normal(size=(4000, 16, 1)))).item() == pytest.approx(1, abs=0.05)


def test_control_short_chain_of_a_slow_sampler_is_refused(generator):
    lazy = [(emcee.moves.GaussianMove(1e-4), 1.0)]
    found = sample(gaussian, near(generator), names="abc", generator=generator, steps=600, moves=lazy)
    assert not found.long_enough and len(found.chain) + found.burned == 600
    for ask in (found.draws, found.summary, found.report):
        with pytest.raises(NotConverged, match=r"needs 50.*remedy") as caught:
            ask()
        assert caught.value.history == found.times.tolist()


def test_control_one_look_at_a_long_chain_is_not_enough(generator):
    """The first look is long by the same estimate that decides when to stop; the next one has to agree."""
    how = {"names": "abc", "generator": generator, "moves": mixed(MEAN, torch.linalg.cholesky(COV))}
    once = sample(gaussian, near(generator), steps=1000, block=1000, **how)
    assert (once.lengths >= posterior.LEAST).all() and once.looks == 1 and not once.long_enough
    with pytest.raises(NotConverged, match="2 looks in a row, it had them at 1"):
        once.draws()
    assert sample(gaussian, near(generator), steps=2000, block=1000, **how).long_enough


def test_a_short_look_between_two_long_ones_begins_the_count_anew(generator, monkeypatch):
    looks = iter([True, False, True, True, True])
    monkeypatch.setattr(posterior, "_long", lambda lengths, least: next(looks))
    found = sample(gaussian, near(generator), names="abc", generator=generator, steps=1000, block=10)
    assert found.looks == 2 and len(found.chain) + found.burned == 40


def test_control_walker_that_never_moves_is_refused(generator):
    still = [(emcee.moves.MHMove(lambda points, random: (points + 1e6, np.zeros(len(points)))), 1.0)]
    found = sample(gaussian, near(generator), names="abc", generator=generator, steps=200, moves=still)
    assert found.acceptance == 0 and not found.long_enough
    with pytest.raises(NotConverged):
        found.draws()


def test_the_same_generator_the_same_chain_and_another_another():
    def run(seed):
        start = near(torch.Generator().manual_seed(9))
        return sample(gaussian, start, names="abc", generator=torch.Generator().manual_seed(seed), steps=50).chain

    assert torch.equal(run(1), run(1)) and not torch.equal(run(1), run(2))
    np.random.seed(0)  # noqa: NPY002  what others do to the global state does not matter, nor do we touch it
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    assert torch.equal(run(1), run(1)) and (np.random.get_state()[1] == before).all()  # noqa: NPY002


def test_what_is_not_finite_is_impossible(generator):
    def half(x):
        return torch.where(x[:, 0] > 0, gaussian(x), torch.nan)

    start = near(generator)
    start[:, 0] = start[:, 0].abs() + 0.01
    found = sample(half, start, names="abc", generator=generator, steps=400)
    assert (found.chain[..., 0] > 0).all()
    assert found.log_prob.isfinite().all()
    with pytest.raises(DataError, match="24 of 24 walkers"):
        sample(lambda x: x[:, 0] * torch.nan, start, names="abc", generator=generator)


def test_ctrl_c_keeps_the_chain(generator):
    calls = 0

    def interrupted(x):
        nonlocal calls
        calls += 1
        if calls == 150:
            raise KeyboardInterrupt
        return gaussian(x)

    found = sample(interrupted, near(generator), names="abc", generator=generator, steps=5000)
    assert found.stopped and 60 < len(found.chain) + found.burned < 100


@pytest.mark.parametrize(
    ("start", "names", "error"),
    [
        (torch.zeros(5, 3), "abc", ShapeError),
        (torch.zeros(24, 3), "ab", ShapeError),
        (torch.zeros(3), "abc", ShapeError),
    ],
)
def test_bad_input_is_refused(generator, start, names, error):
    with pytest.raises(error):
        sample(gaussian, start, names=names, generator=generator)


def test_guess_of_a_gaussian_is_that_gaussian(generator):
    start = MEAN + torch.tensor([0.5, 1.0, -0.05]), 0.6 * torch.linalg.cholesky(COV)
    mean, factor = _guess(gaussian, *start, generator)
    assert torch.allclose(mean, MEAN, atol=1e-6)
    assert torch.allclose(factor @ factor.mT, COV, rtol=1e-6, atol=1e-9)


def test_guess_survives_cliffs(generator):
    """Half of the space is impossible, and far off all is wild."""

    def cliff(x):
        far = (x - MEAN).square().sum(-1) > 9
        return torch.where(x[:, 0] > MEAN[0] + 1.0, -torch.inf, gaussian(x) - 1e4 * far)

    mean, factor = _guess(cliff, MEAN, torch.linalg.cholesky(COV), generator)
    assert mean.isfinite().all() and factor.isfinite().all()
    assert (mean - MEAN).abs().max() < 1.5


def test_walk_finds_a_bent_ridge_from_a_poor_start(generator):
    """Haario's banana: its draws, bent back, are Gaussian."""

    def banana(x):
        straight = x[:, 1] + 0.3 * (x[:, 0].square() - 4.0)
        return -0.5 * (x[:, 0].square() / 4.0 + straight.square())

    found = walk(
        banana, torch.tensor([1.0, 1.0]), 0.5 * torch.eye(2), walkers=24, names="xy", generator=generator,
        steps=20_000, block=500,
    )  # fmt: skip
    x, y = found.draws().unbind(1)
    tolerance = 5 / (len(x) / found.times.amax().item()) ** 0.5
    assert x.std() == pytest.approx(2.0, rel=tolerance) and abs(x.mean()) < 2 * tolerance
    straight = y + 0.3 * (x.square() - 4.0)
    assert straight.std() == pytest.approx(1.0, rel=tolerance) and abs(straight.mean()) < tolerance
