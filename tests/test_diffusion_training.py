"""Training of the denoiser: runs, files and the command."""

import json
import math
from dataclasses import replace

import pytest
import torch

from motionlab import checkpoint
from motionlab.__main__ import main
from motionlab.diffusion.features import Normaliser, units
from motionlab.diffusion.model import LOSS_WEIGHTS, SIZES, DenoiserRecipe, load_denoiser, motion_model, save_denoiser
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError
from motionlab.skeleton import STANDARD
from motionlab.training import denoiser_training

TINY = {"size": 16, "layers": 1, "heads": 2, "hidden": 16}
SMALL = DenoiserRecipe(size="tiny", frames=8, steps=8, batch=4, lr=3e-3, warm_up=2, noising=50, seed=5)


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    monkeypatch.setitem(SIZES, "tiny", TINY)


@pytest.fixture(scope="module")
def data(motions):
    return gather([on_standard(m) for m in motions], SMALL.frames)


def same(one, two):
    pairs = [(one.model.state_dict(), two.model.state_dict()), (one.average, two.average)]
    weights = all(torch.equal(a[name], b[name]) for a, b in pairs for name in a)
    return weights and torch.equal(one.generator.get_state(), two.generator.get_state())


# ----------------------------------------------------------------------------------------------------- runs
@pytest.mark.parametrize("joint", ["left_wrist", "spine2"])  # what hangs on the second is where its rotation puts it
def test_a_joint_that_no_recording_has_is_not_learnt(motions, joint):
    run = denoiser_training.DenoiserTraining(
        SMALL, gather([on_standard(m) for m in motions], SMALL.frames, missing=[(joint,)] * 2)
    )
    lost = STANDARD.indices([joint, joint.replace("left", "right")])
    mine = torch.isin(units(run.layout), torch.tensor(lost))
    out = run.model.output_process.poseFinal.weight
    before = out.detach().clone()
    run.run(until=4)
    assert mine.sum() == 6 * len(set(lost)) and torch.equal(out[mine], before[mine])  # no gradient came
    assert (out != before)[~mine].any(-1).all()  # the control: the others are learnt


def test_the_same_seed_gives_the_same_weights_whatever_torch_drew_elsewhere(data):
    one = denoiser_training.DenoiserTraining(SMALL, data).run(until=2)
    torch.manual_seed(77)
    state = torch.get_rng_state()
    two = denoiser_training.DenoiserTraining(SMALL, data).run(until=2)
    assert same(one, two) and torch.equal(state, torch.get_rng_state())
    assert not same(one, denoiser_training.DenoiserTraining(replace(SMALL, seed=6), data).run(until=2))


def test_windows_that_the_recipe_is_not_of_are_refused(motions):
    with pytest.raises(DataError, match="windows of 9 frames at 30 fps: not 8"):
        denoiser_training.DenoiserTraining(SMALL, gather(motions, 9))
    with pytest.raises(DataError, match="at 15 fps"):
        denoiser_training.DenoiserTraining(SMALL, gather([m.cut(step=2) for m in motions], SMALL.frames))
    with pytest.raises(DataError, match="without contacts"):
        denoiser_training.DenoiserTraining(SMALL, gather([replace(m, contacts=None) for m in motions], SMALL.frames))


def test_the_loss_is_the_weighted_sum_of_its_parts(data):
    weights = LOSS_WEIGHTS | {"fk": 2.0, "velocity": 0.5, "contact": 7.0}
    row = denoiser_training.DenoiserTraining(replace(SMALL, weights=weights), data).advance()
    parts = row["simple"] + 2 * row["fk"] + 0.5 * row["velocity"] + 7 * row["contact"]
    assert row["loss"] == pytest.approx(parts, rel=1e-5)


def test_the_rate_follows_the_recipe(data):
    run, rates = denoiser_training.DenoiserTraining(SMALL, data), []
    for _ in range(SMALL.steps):
        run.advance()
        rates.append(run.optimiser.param_groups[0]["lr"] / SMALL.lr)
    assert rates[0] == pytest.approx(0.5) and rates[1] > 0.9
    assert rates[-1] == pytest.approx(0.51 + 0.49 * math.cos(math.pi * 7 / 8))


def test_a_model_measures_its_errors_on_held_out_windows(data):
    """Of its own noise, so that models compare: the same again, and other windows have others."""
    model = denoiser_training.DenoiserTraining(SMALL, data).averaged
    one, again, other = (model.errors(data.evenly(n), torch.Generator().manual_seed(0)) for n in (8, 8, 5))
    assert list(one) == [f"x0 error at t = {t}" for t in (2, 10, 20, 29, 39)] and one == again != other


# ---------------------------------------------------------------------------------------------------- files
@pytest.fixture
def model(data):
    return denoiser_training.DenoiserTraining(SMALL, data).run(until=2).shipped


def test_a_model_comes_back_from_its_files(model, data, tmp_path):
    x, t = model.encode(data.evenly(3)), torch.tensor([1, 20, 49])
    save_denoiser(tmp_path / "m", model, {"note": "of a test"})
    again = load_denoiser(tmp_path / "m")
    assert again.recipe == model.recipe and again.layout == model.layout
    assert torch.equal(again.normaliser.mean, model.normaliser.mean)
    assert torch.equal(again.schedule.alpha_bar, model.schedule.alpha_bar)
    assert (again.denoiser(x, t) - model.denoiser(x, t)).abs().max() <= 5e-3
    assert not again.denoiser.training
    assert json.loads((tmp_path / "m.json").read_text())["note"] == "of a test"
    kept = {x.dtype for name, x in checkpoint.load(tmp_path / "m")[0].items() if name.startswith("denoiser.")}
    assert kept == {torch.float16}
    assert motion_model(str(tmp_path / "m")).recipe == model.recipe


FOREIGN = {  # changes of tensors (t) and recipe (r), and the complaint
    "no recipe": (lambda t, r: (t, 3), "not a motion diffusion model"),
    "a field more": (lambda t, r: (t, r | {"told": True}), "told"),  # of a kind of model that is no more
    "other size": (lambda t, r: (t, r | {"size": "compact"}), "not a motion diffusion model"),
    "unknown size": (lambda t, r: (t, r | {"size": "huge"}), "huge"),
    "no normaliser": (lambda t, r: ({k: v for k, v in t.items() if k != "scale"}, r), "scale"),
}


@pytest.mark.parametrize("how", FOREIGN)
def test_foreign_files_are_refused(model, tmp_path, how):
    save_denoiser(tmp_path / "m", model, {})
    (change, complaint), (tensors, about) = FOREIGN[how], checkpoint.load(tmp_path / "m")
    tensors, recipe = change(tensors, about["recipe"])
    checkpoint.save(tmp_path / "m", tensors, about | {"recipe": recipe})
    with pytest.raises(DataError, match=complaint) as caught:
        load_denoiser(tmp_path / "m")
    assert caught.value.remedy and "m" in str(caught.value)


# -------------------------------------------------------------------------------------------------- command
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["small", "--more"], "takes no --more"),
        (["diffusion_plain"], "with --data"),
        (["small"], "with --data"),
    ],
)
def test_the_command_says_what_is_wrong(tmp_path, monkeypatch, capsys, arguments, complaint):
    monkeypatch.delenv("MOTIONLAB_DATA", raising=False)
    assert main(["train", *arguments, "--out", str(tmp_path / "never")]) == 2
    assert complaint in capsys.readouterr().err


def test_a_run_can_begin_from_another_model_and_goes_on_with_its_normaliser(data, tmp_path):
    first = denoiser_training.DenoiserTraining(SMALL, data).run(until=2).averaged
    other = replace(first, normaliser=Normaliser(first.normaliser.mean + 1.0, first.normaliser.scale * 2.0))
    run = denoiser_training.DenoiserTraining(SMALL, data, start=other)
    assert all(torch.equal(run.model.state_dict()[k], v) for k, v in other.denoiser.state_dict().items())
    run.run(until=1, keep=tmp_path / "run.pt")
    again = denoiser_training.DenoiserTraining.resume(tmp_path / "run.pt", data)
    assert torch.equal(run.shipped.normaliser.mean, other.normaliser.mean)
    assert torch.equal(again.normaliser.scale, other.normaliser.scale)
