import pytest
import torch

from studies.nb09_posterior import calibration, tempering
from studies.nb09_posterior.trials import Draws

HOT, COUNT = 16.0, 4000


def hot(generator, stiff=1.0, count=COUNT):
    """Draws of exp(-E / HOT) in four numbers, E = stiff |c|^2 / 2; they are their own coordinates."""
    c = (HOT / stiff) ** 0.5 * torch.randn(count, 4, generator=generator, dtype=torch.float64)
    return Draws(None, c, c[:, None], c, 0.5 * stiff * c.square().sum(1))


@pytest.mark.parametrize("temperature", [4.0, 8.0, 16.0])
def test_cooled_draws_of_a_gaussian_have_the_width_of_their_temperature(generator, temperature):
    draws = hot(generator)
    found = tempering.cooled(draws, HOT, temperature, generator)
    worth = tempering.effective(tempering.weights(draws.energy, HOT, temperature))
    ratio = temperature / HOT
    assert worth == pytest.approx(COUNT * (ratio * (2 - ratio)) ** 2, rel=0.15)  # of Gaussians in four numbers
    assert found.coordinates.std(0).mean() == pytest.approx(temperature**0.5, rel=4 / (8 * worth) ** 0.5)
    assert torch.equal(found.c, found.coordinates) and torch.equal(found.ways[:, 0], found.c)
    assert len(tempering.cooled(draws, HOT, temperature, generator, 100).c) == 100


def test_control_far_below_a_fourth_few_draws_count(generator):
    assert tempering.effective(tempering.weights(hot(generator).energy, HOT, HOT / 64)) < COUNT / 500


def made(generator, clips=60, temperature=6.0):
    """Clips whose truth is a draw at a temperature that nobody was told."""
    truths = temperature**0.5 * torch.randn(clips, 4, generator=generator, dtype=torch.float64)
    return [hot(generator, count=1000) for _ in range(clips)], list(truths)


def test_the_temperature_of_the_truths_is_found_and_coverage_with_it(generator):
    found, truths = made(generator)
    needs = tempering.stretches(found, truths, HOT, generator)
    heat = tempering.chosen(needs, HOT)
    assert heat.median() == pytest.approx(6.0, rel=0.5) and len(heat.unique()) <= 3
    inside = torch.tensor(
        [
            calibration.level_of(tempering.cooled(d, HOT, float(t), generator).coordinates, x) <= 0.9
            for d, x, t in zip(found, truths, heat, strict=True)
        ]
    )
    assert 0.8 <= inside.double().mean() <= 1.0
    assert (needs[:, 0].nanquantile(0.9) > 1) and (needs[:, -1].nanquantile(0.9) < 1)  # control: neither end would do


def test_no_clip_has_a_say_in_its_own_temperature_but_on_all_every_one_has(generator):
    found, truths = made(generator, clips=10)
    needs = tempering.stretches(found, truths, HOT, generator)
    before = tempering.chosen(needs, HOT), tempering.chosen(needs, HOT, folds=2), tempering.on_all(needs, HOT)
    needs[3] = 100.0
    after = tempering.chosen(needs, HOT), tempering.chosen(needs, HOT, folds=2), tempering.on_all(needs, HOT)
    assert before[0][3] == after[0][3] and torch.equal(before[1][1::2], after[1][1::2])
    assert (after[0] >= before[0]).all() and (after[0] > before[0]).any()
    assert (before[2] == before[2][0]).all() and after[2][3] >= before[2][3]
