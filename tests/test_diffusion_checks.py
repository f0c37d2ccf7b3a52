"""The checks that notebook 10 shows: they hold for ours, and find what is wrong."""

import math

import pytest

from motionlab.diffusion.sampling import cosine
from studies.nb10_diffusion import checks


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
