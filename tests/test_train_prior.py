"""What the transition prior is trained on without end: both bodies, what was asked, and a file that gives it back."""

from dataclasses import replace

import pytest
import torch

from motionlab import splits, train_more, train_prior
from motionlab.diffusion.windows import gather, on_standard
from motionlab.humor.chain_training import ChainRecipe
from motionlab.skeleton import STANDARD
from tests.draws import seeded

SMALL = ChainRecipe(width=64, steps=4, batch=4, length=3, chain=2)


@pytest.fixture
def course(motions):
    own = [replace(m, skeleton=replace(m.skeleton, offsets=1.1 * m.skeleton.offsets)) for m in motions]
    bodies = {"own bones": own, "standard body": [*map(on_standard, own)]}
    people = ["a", *["b"] * (len(own) - 1)] * 2
    windows = gather([m for some in bodies.values() for m in some], SMALL.length + 2, people=people)
    held = {body: splits.state_windows(some, causal=True) for body, some in bodies.items()}
    return train_prior.Course("transition", SMALL, None, (windows, held))


def test_half_of_the_windows_are_on_the_standard_body(course):
    windows = replace(course.windows, mirrored=False)
    bodies = windows.draw(400, seeded()).skeleton.offsets[:, 0]
    share = (bodies == STANDARD.offsets).all((1, 2)).float().mean()
    assert 0.35 < share < 0.65


def test_what_was_asked_chooses(course, motions):
    model = course.begun(SMALL, None).averaged
    row = course.measured(model)
    assert next(iter(row)) == train_prior.CHOSEN
    shares = []
    for body in course.held:
        cv = row[f"{body}: one step, constant velocity, cm"]
        shares += [
            row[f"{body}: one step, prior mean, cm"] / cv / 0.75,
            row[f"{body}: one step, posterior, cm"] / cv / 0.25,
        ]
        shares += [row[f"{body}: 2 s, posterior z, cm"] / 5, row[f"{body}: 2 s, closed loop, cm"] / 2]
    assert row[train_prior.CHOSEN] == pytest.approx(sum(shares) / len(shares))


def test_it_goes_on_from_what_it_wrote(course, tmp_path, monkeypatch):
    monkeypatch.setenv("MOTIONLAB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(train_more, "_give_way", lambda: None)
    out = tmp_path / "mine"
    train_more.go_on(course, out, every=2, schedules=1)
    first = course.load(out)
    about = train_more.checkpoint.read_recipe(out)
    assert about["step"] in (2, 4) and about["people"] == 1
    run = course.begun(SMALL, first)
    assert run.recipe.supervised == 0 and run.recipe.width == 64
    past = torch.randn(5, 339, generator=seeded())
    again = run.averaged
    assert torch.allclose(again.prior(past).mean, first.prior(past).mean, atol=1e-3)
