"""The thesis's denoiser trained without end: it goes on from what it wrote, and refuses others."""

import pytest

from motionlab import checkpoint, courses, train_more
from motionlab.diffusion.model import DenoiserRecipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError
from tests.draws import seeded

SMALL = DenoiserRecipe(size="small", steps=4, batch=4)


@pytest.fixture
def course(motions):
    windows = gather([*map(on_standard, motions)], 60, people=["a", *["b"] * (len(motions) - 1)])
    return courses.DenoiserCourse("diffusion_plain", SMALL, None, (windows, windows.draw(4, seeded())))


def test_it_goes_on_from_what_it_wrote(course, tmp_path, monkeypatch):
    """With the size and the numbers of what is there; less of its error is chosen."""
    monkeypatch.setenv("MOTIONLAB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(train_more, "_give_way", lambda: None)
    out = tmp_path / "plain"
    train_more.go_on(course, out, every=2, schedules=1)
    before, first = checkpoint.read_recipe(out), course.load(out)
    row = before["quality, people who choose"]
    levels = [value for name, value in row.items() if name != courses.MEAN_ERROR]
    assert row[courses.MEAN_ERROR] == pytest.approx(sum(levels) / len(levels)) and before["recipe"]["size"] == "small"
    train_more._kept("diffusion_plain", out).unlink()
    begun = course.begun(DenoiserRecipe(steps=4, batch=4), first)
    assert begun.recipe.size == "small"
    weight = lambda model: next(iter(model.denoiser.state_dict().values()))  # noqa: E731
    assert (weight(begun.averaged) - weight(first)).abs().max() == 0
    train_more.go_on(course, out, every=2, schedules=1)
    assert checkpoint.read_recipe(out)["step"] >= before["step"]


def test_another_model_is_refused(course):
    with pytest.raises(DataError, match="not a"):
        course.load(checkpoint.SHIPPED / "completer")
