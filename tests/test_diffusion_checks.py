"""The checks that notebook 10 shows: they hold for ours, and find what is wrong."""

import math

import pytest
import torch

from motionlab.diffusion.denoiser import SIZES, Denoiser
from motionlab.diffusion.sampling import cosine
from studies.nb10_diffusion import checks, network_checks


@pytest.fixture(scope="module")
def printed():
    return cosine(1000, power=1)


def test_every_formula_holds_and_the_printed_one_is_found(generator, printed):
    rows = checks.of_schedule(cosine(1000), generator)
    assert len(rows) == 8 and all(row.holds for row in rows), [row for row in rows if not row.holds]
    wrong = {row.what for row in checks.of_schedule(printed, generator) if not row.holds}
    assert {"alpha-bar", "beta", "x_t from x_0", "posterior mean", "posterior variance"} <= wrong
    assert "noise from x_0 and x_t" not in wrong  # consistent in itself, whatever the schedule


def test_samplers_are_diffusers_and_the_printed_schedule_is_not(generator, printed):
    rows = checks.of_samplers(cosine(50), generator)
    assert [row.holds for row in rows] == [True, True]
    assert not any(row.holds for row in checks.of_samplers(cosine(50, power=1), generator))


def test_an_error_that_is_no_number_does_not_hold():
    assert not checks.Check("x", "", "", math.nan).holds


def test_gaussians_end_to_end(generator):
    found = checks.end_to_end(cosine(1000), 20, 20_000, generator)
    assert found["chain"] < 4.5 < found["bias"]  # 20 steps sample what the chain says, which is not quite the data
    assert checks.end_to_end(cosine(1000), 20, 20_000, generator, off=0.1)["chain"] > 6


def test_official_tensors_are_those_of_the_thesis_size():
    expected = network_checks.official()
    tensors = Denoiser(150, **SIZES["thesis"]).state_dict()
    assert network_checks.differing(tensors, expected) == []
    assert sum(math.prod(shape) for shape in expected.values()) == network_checks.PARAMETERS
    other = Denoiser(150, **SIZES["thesis"] | {"layers": 7}).state_dict()
    assert len(network_checks.differing(other, expected)) == 12


def test_the_twin_agrees_with_the_step_it_was_told(generator):
    model, other = (network_checks.seeded(10, seed, size=16, layers=2, heads=4, hidden=24) for seed in (0, 1))
    x = torch.randn(2, 12, 10, generator=generator)
    found = model(x, torch.tensor([7, 999]))
    for window, step, ours in zip(x, (7, 999), found, strict=True):
        assert (network_checks.twin(model, window, step) - ours).abs().max() < 1e-5
    assert (network_checks.twin(model, x[0], 500) - found[0]).abs().max() > 1e-3
    assert (network_checks.twin(other, x[0], 7) - found[0]).abs().max() > 1e-3
