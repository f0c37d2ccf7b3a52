"""What is trained without end: the denoiser and the prior go on from what they wrote, and refuse others."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from motionlab import checkpoint
from motionlab.bench import PersonWindows
from motionlab.diffusion.model import DenoiserRecipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError
from motionlab.skeleton import STANDARD
from motionlab.training import courses
from motionlab.training.chain_training import ChainRecipe
from tests.draws import seeded

PLAIN = DenoiserRecipe(size="small", steps=4, batch=4)
SMALL = ChainRecipe(width=64, steps=4, batch=4, length=3, chain=2)


@pytest.fixture
def plain(motions):
    windows = gather([*map(on_standard, motions)], 60, people=["a", *["b"] * (len(motions) - 1)])
    held = PersonWindows(windows.draw(4, seeded()), None, None)
    return courses.DenoiserCourse("diffusion_plain", PLAIN, None, (windows, held))


@pytest.fixture
def prior(motions):
    own = [replace(m, skeleton=replace(m.skeleton, offsets=1.1 * m.skeleton.offsets)) for m in motions]
    bodies = {"own bones": own, "standard body": [*map(on_standard, own)]}
    people = ["a", *["b"] * (len(own) - 1)] * 2
    windows = gather([m for some in bodies.values() for m in some], SMALL.length + 2, people=people)
    held = {body: courses.person_states([Mock(motion=some[0], person="c")], 2) for body, some in bodies.items()}
    return courses.PriorCourse("transition", SMALL, None, (windows, held))


def test_half_of_the_windows_are_of_the_standard_body(prior):
    windows = replace(prior.windows, mirrored=False)
    bodies = windows.draw(400, seeded()).skeleton.offsets[:, 0]
    share = (bodies == STANDARD.offsets).all((1, 2)).float().mean()
    assert 0.35 < share < 0.65


def test_who_does_what_was_asked_has_one(prior, monkeypatch):
    """By a row that lies at the bounds exactly; twice as bad has two, whatever else is in the row."""
    for much in (1.0, 2.0):
        row = {"one step, constant velocity, cm": 0.4, "one step, prior mean, cm": 0.75 * 0.4 * much}
        row |= {"one step, posterior, cm": 0.25 * 0.4 * much, "2 s, posterior z, cm": 5.0 * much}
        row |= {"2 s, closed loop, cm": 2.0 * much, "2 s, hold, cm": 99.0}
        monkeypatch.setattr(courses, "quality_row", lambda *_, row=row: row)
        found = prior.measured(None)
        assert next(iter(found.items())) == (courses.OVER_ASKED, pytest.approx(much))
        assert found["own bones: 2 s, hold, cm"] == found["standard body: 2 s, hold, cm"] == 99.0


def test_the_prior_goes_on_from_what_it_wrote(prior, here, monkeypatch):
    """By a bare name in the folder at hand; the kept state is gone, so that the file is all there is."""
    out = Path("transition")
    next(courses.go_on(prior, out, every=2))
    before = checkpoint.read_recipe(out)
    assert before["step"] in (2, 4) and before["people"] == 1 and before["recipe"]["width"] == 64
    courses._kept("transition", out).unlink()
    monkeypatch.setattr(prior, "recipe", replace(SMALL, lr=1e-6))
    next(courses.go_on(prior, out, every=2))
    run = prior.trainer.resume(courses._kept("transition", out), prior.windows)
    assert run.earlier == before["step"] and run.step == 4 and run.recipe.sampling_end == 0
    first, again = prior.load(out), run.averaged
    past = torch.randn(5, 339, generator=seeded())
    assert torch.allclose(again.prior(past).mean, first.prior(past).mean, atol=0.02)
    new = prior.begun(replace(SMALL, seed=9), None).averaged
    assert not torch.allclose(new.prior(past).mean, first.prior(past).mean, atol=0.02)


def test_the_denoiser_goes_on_from_what_it_wrote(plain, here):
    """With the size and the numbers of what is there; less of its error is chosen."""
    out = here / "plain"
    next(courses.go_on(plain, out, every=2))
    before, first = checkpoint.read_recipe(out), plain.load(out)
    row = before["quality, validation people"]
    levels = [value for name, value in row.items() if name != courses.MEAN_ERROR]
    assert row[courses.MEAN_ERROR] == pytest.approx(sum(levels) / len(levels)) and before["recipe"]["size"] == "small"
    courses._kept("diffusion_plain", out).unlink()
    begun = plain.begun(DenoiserRecipe(steps=4, batch=4), first)
    assert begun.recipe.size == "small"
    weight = lambda model: next(iter(model.denoiser.state_dict().values()))  # noqa: E731
    assert (weight(begun.averaged) - weight(first)).abs().max() == 0
    next(courses.go_on(plain, out, every=2))
    assert checkpoint.read_recipe(out)["step"] >= before["step"]


def test_models_of_another_kind_are_refused(plain, prior):
    with pytest.raises(DataError, match="not a transition"):
        prior.load(checkpoint.SHIPPED / "humor_real")
    with pytest.raises(DataError, match="not a"):
        plain.load(checkpoint.SHIPPED / "completer")
