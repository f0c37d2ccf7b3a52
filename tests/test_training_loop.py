"""The training loop: a run that neither a stop nor a kill changes, bad batches, averages and the choice of weights."""

import math
from copy import deepcopy
from dataclasses import dataclass

import pytest
import torch

from motionlab.errors import DataError
from motionlab.training.training_loop import TrainingRun


@dataclass(frozen=True)
class Recipe:
    steps: int = 8
    average: float = 0.9
    lr: float = 0.05


@dataclass
class Data:
    digest: str = "numbers"


class Fit(TrainingRun):
    """A line through noisy points; ``spoilt``: steps whose loss is not finite, and what it is instead."""

    give_up, clip = 3, 1.0
    spoilt, bad = (), math.nan

    def __init__(self, recipe, data):
        model = torch.nn.Linear(2, 1)
        with torch.no_grad():
            model.weight.fill_(1.0)
            model.bias.zero_()
        optimiser = torch.optim.Adam(model.parameters(), lr=recipe.lr)
        super().__init__(recipe, data.digest, torch.Generator().manual_seed(3), model, optimiser)

    Recipe = Recipe

    def _rate(self):
        return self.recipe.lr * (1 - self.step / self.recipe.steps)

    def _draw(self):
        return torch.randn(5, 2, generator=self.generator)

    def _loss(self):
        x = self._draw()
        miss = (self.model(x) - 3 * x[:, :1] + 1).square().mean() * (self.bad if self.step in self.spoilt else 1.0)
        return 2 * miss, {"miss": miss}


@pytest.fixture
def whole():
    """A run without an interruption."""
    return Fit(Recipe(), Data()).run(every=4)


def same(one, two):
    pairs = [(one.model.state_dict(), two.model.state_dict()), (one.average, two.average)]
    weights = all(torch.equal(a[name], b[name]) for a, b in pairs for name in a)
    return weights and torch.equal(one.generator.get_state(), two.generator.get_state()) and one.step == two.step


def total(model):
    return {"kid": float(sum(p.sum() for p in model.parameters()))}


# ---------------------------------------------------------------------------------------------------- interruption
@pytest.mark.parametrize("stop", [1, 5, 8])
def test_a_stopped_run_goes_on_to_the_bit(tmp_path, stop):
    how = {"every": 1, "judge_every": 2, "judge": total}
    whole = Fit(Recipe(), Data()).run(**how)
    Fit(Recipe(), Data()).run(until=stop, keep=tmp_path / "run.pt", **how | {"judge_every": 99})
    again = Fit.resume(tmp_path / "run.pt", Data())
    assert again.step == stop and again.recipe == Recipe()
    again.run(**how)
    assert same(whole, again) and again.curve[-1] == whole.curve[-1] and "kid" in whole.curve[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["run.pt"]


def test_a_run_that_cannot_be_written_leaves_the_one_before(tmp_path, monkeypatch):
    run = Fit(Recipe(), Data()).run(until=3, keep=tmp_path / "run.pt")

    def half(content, path):
        path.write_bytes(b"half a run")
        raise OSError

    monkeypatch.setattr(torch, "save", half)
    with pytest.raises(OSError):
        run.run(keep=tmp_path / "run.pt")
    assert Fit.resume(tmp_path / "run.pt", Data()).step == 3


def test_ctrl_c_leaves_what_was_saved_last(whole, tmp_path):
    run = Fit(Recipe(), Data()).run(until=3, keep=tmp_path / "run.pt")
    step = run.optimiser.step

    def stop():
        step()
        raise KeyboardInterrupt

    run.optimiser.step = stop
    with pytest.raises(KeyboardInterrupt):
        run.run(keep=tmp_path / "run.pt")
    again = Fit.resume(tmp_path / "run.pt", Data())
    assert again.step == 3 and same(whole, again.run())


@pytest.mark.parametrize("content", [None, b"", b"not a run", "half", "another model's"])
def test_damaged_runs_are_refused(tmp_path, content):
    path = tmp_path / "run.pt"
    if content == "half":
        Fit(Recipe(), Data()).run(until=1, keep=path)
        path.write_bytes(path.read_bytes()[:1500])
    elif content == "another model's":
        torch.save({"recipe": {"width": 64}, "step": 1}, path)
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"run.pt.*without --more"):
        Fit.resume(path, Data())


def test_a_run_does_not_go_on_with_other_data(tmp_path):
    Fit(Recipe(), Data()).run(until=1, keep=tmp_path / "run.pt")
    with pytest.raises(DataError, match=r"trained on other windows .*without --more"):
        Fit.resume(tmp_path / "run.pt", Data("others"))


# ---------------------------------------------------------------------------------------------------- bad batches
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_batch_that_is_not_finite_is_skipped(tmp_path, bad):
    run = Fit(Recipe(), Data())
    run.spoilt, run.bad = (2, 3), bad
    run.run(until=2)
    before = deepcopy((run.model.state_dict(), run.average, run.optimiser.state_dict()["state"]))
    run.run(until=4, keep=tmp_path / "run.pt")
    after = (run.model.state_dict(), run.average, run.optimiser.state_dict()["state"])
    assert all(alike(a, b) for a, b in zip(before, after, strict=True))
    assert run.curve[-1] == {"step": 4, "skipped": 2}
    again = Fit.resume(tmp_path / "run.pt", Data())
    assert (again.skipped, again.in_a_row) == (2, 2)
    run.run()
    assert run.step == 8 and run.skipped == 2 and run.in_a_row == 0
    assert not alike(before[0], run.model.state_dict())
    assert all(value.isfinite().all() for value in run.average.values())


def alike(a, b):
    """Nested numbers and tensors, equal to the bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(alike(a[key], b[key]) for key in a)
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def test_a_run_of_nothing_but_such_batches_ends():
    run = Fit(Recipe(steps=20), Data())
    run.spoilt = (0, 1, *range(3, 20))  # two in a row are skipped, then a good one, then three
    with pytest.raises(DataError, match=r"step 5: the loss is not finite, 3 batches in a row .*learning rate"):
        run.run()
    assert run.skipped == 5


@pytest.mark.parametrize("clip", [math.inf, 1.0, 0.1])
def test_gradients_are_clipped_only_where_that_is_asked_for(clip):
    run = Fit(Recipe(), Data())
    run.clip, run.bad, run.spoilt = clip, 1e4, (0,)
    run.advance()
    norm = torch.nn.utils.get_total_norm([p.grad for p in run.model.parameters()])
    assert norm > 100 if clip == math.inf else norm == pytest.approx(clip, rel=1e-4)


# ------------------------------------------------------------------------------------------------- what is kept
def test_losses_fall_and_rate_and_average_follow_the_recipe():
    run = Fit(Recipe(steps=200, average=0.3), Data())
    rows = []
    for step in range(200):
        before = {name: value.clone() for name, value in run.average.items()}
        rows.append(run.advance())
        assert run.optimiser.param_groups[0]["lr"] == pytest.approx(0.05 * (1 - step / 200))
        keep = min(0.3, (2 + step) / (11 + step))
        for name, value in run.model.state_dict().items():
            assert torch.allclose(run.average[name], keep * before[name] + (1 - keep) * value, atol=1e-6)
    assert rows[-1]["miss"] < 0.01 * rows[0]["miss"] and rows[0]["loss"] == pytest.approx(2 * rows[0]["miss"])


def test_the_judge_chooses_the_weights_that_ship(tmp_path):
    seen, marks = [], iter([3.0, 1.0, 2.0, math.nan])

    def verdict(model):
        seen.append(model.state_dict())
        return {"kid": next(marks), "another": 0.0}

    how = {"every": 1, "judge_every": 2, "judge": verdict}
    run = Fit(Recipe(), Data()).run(until=6, keep=tmp_path / "run.pt", **how)
    again = Fit.resume(tmp_path / "run.pt", Data()).run(**how)
    assert [row.get("kid") for row in run.curve] == [None, 3.0, None, 1.0, None, 2.0]
    for each in (run, again):
        assert each.best["step"] == 4 and each.best["kid"] == 1.0
        assert alike(dict(seen[1]), dict(each.shipped.state_dict()))
    assert not alike(dict(seen[1]), again.average)
