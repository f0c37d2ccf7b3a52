"""Training of the denoiser: losses, several processes, files, judges and the command."""

import json
import math
import os
import socket
import subprocess
import sys
from dataclasses import asdict, replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import checkpoint, shipped, splits
from motionlab.__main__ import main
from motionlab.diffusion import denoiser, embedding, losses, training
from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.losses import LossWeights
from motionlab.diffusion.model import GAIN, DenoiserRecipe, load_denoiser, motion_model, save_denoiser
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError
from studies.nb10_diffusion import arms

TINY = {"size": 16, "layers": 1, "heads": 2, "hidden": 16}
SMALL = DenoiserRecipe(
    size="tiny", frames=8, steps=8, batch=4, lr=3e-3, warm_up=2, noising=50, weights=LossWeights(late=0.5), seed=5
)
TOLD = replace(SMALL, told=True)


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    monkeypatch.setitem(denoiser.SIZES, "tiny", TINY)


@pytest.fixture(scope="module")
def data(motions):
    return gather([on_standard(m) for m in motions], SMALL.frames)


def same(one, two):
    pairs = [(one.model.state_dict(), two.model.state_dict()), (one.average, two.average)]
    weights = all(torch.equal(a[name], b[name]) for a, b in pairs for name in a)
    return weights and torch.equal(one.generator.get_state(), two.generator.get_state())


# ----------------------------------------------------------------------------------------------------- runs
@pytest.mark.parametrize("joint", ["left_wrist", "spine2"])  # what hangs on the second is where its rotation puts it
def test_a_joint_that_no_recording_has_is_not_learnt_nor_told(motions, joint):
    data = gather([on_standard(m) for m in motions], SMALL.frames, missing=[(joint,)] * 2)
    recipe = replace(TOLD, spectral=True, weights=LossWeights(late=0.0), guessed=False)
    run = training.DenoiserTraining(recipe, data)
    with pytest.raises(DataError, match="lack joints"):
        training.DenoiserTraining(replace(recipe, guessed=True), data)
    columns, told = run._seen(torch.zeros(1, dtype=torch.long))[0], []
    assert (~columns).sum() == 6 * (1 + joint.startswith("left_"))
    run.network.register_forward_pre_hook(lambda _, given, how: told.append(how["mask"]), with_kwargs=True)
    for _ in range(20):
        run.advance()
    masks, out = torch.cat(told), run.model.network.output_process.poseFinal.weight
    assert masks[..., columns].any() and out[columns].any()  # the control: the others are told, and learnt
    assert not (masks[..., ~columns].any() or out[~columns].any())  # began at zero, and no gradient came


def test_the_same_seed_gives_the_same_weights_whatever_torch_drew_elsewhere(data):
    one = training.DenoiserTraining(SMALL, data).run(until=2)
    torch.manual_seed(77)
    state = torch.get_rng_state()
    two = training.DenoiserTraining(SMALL, data).run(until=2)
    assert same(one, two) and torch.equal(state, torch.get_rng_state())
    assert not same(one, training.DenoiserTraining(replace(SMALL, seed=6), data).run(until=2))


def test_a_run_does_not_go_on_with_other_windows(motions, data, tmp_path):
    training.DenoiserTraining(SMALL, data).run(until=1, keep=tmp_path / "run.pt")
    with pytest.raises(DataError, match="other windows"):
        training.DenoiserTraining.resume(tmp_path / "run.pt", gather(motions, SMALL.frames))
    with pytest.raises(DataError, match="windows of 9 frames at 30 fps; expected 8"):
        training.DenoiserTraining(SMALL, gather(motions, 9))
    with pytest.raises(DataError, match="at 15 fps"):
        training.DenoiserTraining(SMALL, gather([m.cut(step=2) for m in motions], SMALL.frames))
    with pytest.raises(DataError, match="without contacts"):
        training.DenoiserTraining(SMALL, gather([replace(m, contacts=None) for m in motions], SMALL.frames))


@pytest.mark.parametrize("by_signal", [False, True])
def test_the_loss_is_the_weighted_sum_of_its_parts(data, by_signal):
    weights = LossWeights(fk=2.0, velocity=0.5, known=3.0, contact=7.0, late=0.0, by_signal=by_signal)
    row = training.DenoiserTraining(replace(TOLD, weights=weights), data).advance()
    parts = row["simple"] + 2 * row["fk"] + 0.5 * row["velocity"] + 3 * row["known"] + 7 * row["contact"]
    assert row["loss"] == pytest.approx(parts, rel=1e-5)
    if by_signal:
        plain = training.DenoiserTraining(replace(TOLD, weights=replace(weights, by_signal=False)), data).advance()
        assert row["fk"] < plain["fk"] and row["simple"] == plain["simple"]


def test_the_curve_says_what_the_network_adds(data):
    run = training.DenoiserTraining(replace(TOLD, spectral=True), data)
    measure = training.held_errors(data.evenly(8))
    assert measure(run.averaged)[GAIN] == 0.0
    run.average["network.output_process.poseFinal.bias"] += 1.0  # nonsense, everywhere
    assert measure(run.averaged)[GAIN] < -0.1
    assert GAIN not in measure(training.DenoiserTraining(SMALL, data).averaged)


def test_rate_and_late_losses_follow_the_recipe(data):
    run, rates = training.DenoiserTraining(SMALL, data), []
    for _ in range(SMALL.steps):
        row = run.advance()
        rates.append(run.optimiser.param_groups[0]["lr"] / SMALL.lr)
        assert ("fk" in row) == ("contact" in row) == (run.step > SMALL.steps // 2)
    assert rates[0] == pytest.approx(0.5) and rates[1] > 0.9
    assert rates[-1] == pytest.approx(0.51 + 0.49 * math.cos(math.pi * 7 / 8))


# ------------------------------------------------------------------------------------------ several devices
class Half:
    """What a run needs of an accelerator: the second of two processes."""

    device, process_index, num_processes = torch.device("cpu"), 1, 2

    def prepare_model(self, model):
        return model

    def backward(self, loss):
        loss.backward()


def test_every_process_takes_its_share_of_one_batch(data, monkeypatch):
    seen, true = [], losses.denoising_losses

    def compare(estimate, truth, *args, **how):
        seen.append(truth)
        return true(estimate, truth, *args, **how)

    monkeypatch.setattr(training, "denoising_losses", compare)
    training.DenoiserTraining(SMALL, data).advance()
    training.DenoiserTraining(SMALL, data, accelerator=Half()).advance()
    assert torch.equal(seen[1], seen[0][1::2])
    with pytest.raises(DataError, match=r"batch of 5 does not divide among 2 processes .*multiple"):
        training.DenoiserTraining(replace(SMALL, batch=5), data, accelerator=Half())


PROCESS = """
import sys, torch
torch.set_num_threads(1)
from accelerate import Accelerator
from motionlab.diffusion import denoiser, model, training, windows
data, recipe, denoiser.SIZES["tiny"] = torch.load(sys.argv[1]).values()
recipe, data = model.DenoiserRecipe.read(recipe), windows.Windows(**data)
run = training.DenoiserTraining(recipe, data, accelerator=Accelerator(cpu=True))
run.run(until=3, keep=sys.argv[2], every=3)
torch.distributed.destroy_process_group()
"""
BIAS = "seqTransEncoder.layers.0.self_attn.in_proj_bias"


def test_two_processes_train_as_one(data, tmp_path):
    """But for keys' biases: attention does not feel them, so their gradients are rounding, which Adam scales up."""
    pytest.importorskip("accelerate")
    keep, given, recipe = tmp_path / "run.pt", tmp_path / "given.pt", replace(SMALL, dropout=0.0)
    torch.save({"data": vars(data), "recipe": asdict(recipe), "tiny": TINY}, given)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    meet = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": f"{port}", "ACCELERATE_USE_CPU": "1"}
    call = [sys.executable, "-c", PROCESS, given, keep]
    ranks = [meet | {"RANK": rank, "LOCAL_RANK": rank, "OMP_NUM_THREADS": "1"} for rank in "01"]
    children = [subprocess.Popen(call, env=os.environ | rank) for rank in ranks]
    try:
        assert [child.wait(timeout=240) for child in children] == [0, 0]
    finally:
        for child in children:
            child.kill()
            child.wait()
    one, two = training.DenoiserTraining(recipe, data).run(until=3), training.DenoiserTraining.resume(keep, data)
    assert two.step == 3
    fresh = training.DenoiserTraining(recipe, data)
    keys = slice(len(one.average[BIAS]) // 3, 2 * len(one.average[BIAS]) // 3)
    for run in (one, two):
        run.average[BIAS][keys] = 0.0
    for name, value in one.average.items():
        assert torch.allclose(two.average[name], value, rtol=0, atol=1e-6), name
    assert any((two.average[n] - fresh.average[n]).abs().max() > 2e-3 for n in fresh.average)  # it did train


# ---------------------------------------------------------------------------------------------------- files
@pytest.fixture
def model(data):
    return training.DenoiserTraining(TOLD, data).run(until=2).shipped


def test_a_model_comes_back_from_its_files(model, data, tmp_path):
    x, t = model.encode(data.evenly(3)), torch.tensor([1, 20, 49])
    for name, half, tolerance in (("full", False, 0.0), ("half", True, 5e-3)):
        save_denoiser(tmp_path / name, model, {"note": "of a test"}, half=half)
        again = load_denoiser(tmp_path / name)
        assert again.recipe == model.recipe and again.layout == model.layout
        assert torch.equal(again.normaliser.mean, model.normaliser.mean)
        assert torch.equal(again.schedule.alpha_bar, model.schedule.alpha_bar)
        mask = torch.ones_like(x)
        assert (again.denoiser(x, t, x, mask) - model.denoiser(x, t, x, mask)).abs().max() <= tolerance
        assert not again.denoiser.training
    assert json.loads((tmp_path / "full.json").read_text())["note"] == "of a test"
    assert (tmp_path / "half.safetensors").stat().st_size < 0.6 * (tmp_path / "full.safetensors").stat().st_size
    assert motion_model(str(tmp_path / "full")).recipe == model.recipe


def damage(path, how):
    tensors, about = checkpoint.load(path)
    if how == "no recipe":
        checkpoint.save(path, tensors, {"recipe": 3})
    elif how == "a field less":
        del about["recipe"]["told"]
        checkpoint.save(path, tensors, about)
    elif how == "other size":
        about["recipe"]["size"] = "compact"
        checkpoint.save(path, tensors, about)
    elif how == "unknown size":
        about["recipe"]["size"] = "huge"
        checkpoint.save(path, tensors, about)
    elif how == "no normaliser":
        checkpoint.save(path, {k: v for k, v in tensors.items() if k != "scale"}, about)
    elif how == "another normaliser":
        checkpoint.save(path, tensors | {"scale": tensors["scale"][:-1]}, about)
    elif how == "NaN":
        checkpoint.save(path, tensors | {"mean": tensors["mean"] * math.nan}, about)


@pytest.mark.parametrize(
    ("how", "complaint"),
    [
        ("no recipe", "not a motion diffusion model"), ("a field less", "no told"), ("NaN", "not finite"),
        ("other size", "not a motion diffusion model"), ("unknown size", "compact"),
        ("no normaliser", "scale"), ("another normaliser", "normaliser"),
    ],
)  # fmt: skip
def test_foreign_files_are_refused(model, tmp_path, how, complaint):
    save_denoiser(tmp_path / "m", model, {})
    damage(tmp_path / "m", how)
    with pytest.raises(DataError, match=complaint) as caught:
        load_denoiser(tmp_path / "m")
    assert caught.value.remedy and "m.safetensors" in str(caught.value)


def test_the_prior_of_humor_is_no_denoiser():
    with pytest.raises(DataError, match=r"humor_compact.*not a motion diffusion model"):
        motion_model("humor_compact")


# ---------------------------------------------------------------------------------------------------- judge
def test_the_judge_prefers_motion_like_the_held_out(motions):
    length = 20
    data, held = (gather([on_standard(m)], length, mirrored=False).evenly(60) for m in motions)
    scaled = embedding.Scaled(held)
    assert scaled.real.shape[0] == 60 and scaled.real.isfinite().all()
    unit = (scaled.real.square().sum(1) / scaled.real.shape[1]).mean()
    assert unit.item() == pytest.approx(1.0, abs=0.1)  # x . x / D of the kernel, per block and number

    class Fixed:
        def __init__(self, motion):
            self.motion = motion

        def sample(self, count, generator, steps):
            return self.motion

    noisy = replace(
        held, root=held.root + 0.05 * torch.randn(held.root.shape, generator=torch.Generator().manual_seed(0))
    )
    frozen = replace(held, root=held.root[:, :1].expand_as(held.root), rot=held.rot[:, :1].expand_as(held.rot))
    measure = embedding.kid_judge(held, count=60)
    found = [measure(Fixed(m))["kid"] for m in (held, data, noisy, frozen)]
    assert found[0] < min(found[1:]) and found[0] < 1e-3 and all(math.isfinite(x) for x in found)


def test_models_that_are_told_are_judged_by_what_they_fill_in(data):
    """One that knows the truth, one that says the mean, and one that spoils only what it was given."""
    held = data.evenly(40)
    model = training.DenoiserTraining(TOLD, data).averaged
    x0 = model.encode(held)

    class Says(torch.nn.Linear):
        def __init__(self, answer):
            super().__init__(1, 1)
            self.answer = answer

        def forward(self, x, stamps, known, mask):
            assert torch.equal(known, torch.where(mask, x0, 0.0)) and (stamps == 49).all()
            return self.answer(x0, mask)

    answers = [lambda x, m: x, lambda x, m: 0 * x, lambda x, m: torch.where(m, x + 9.0, x)]
    errors = [embedding.filling_judge(held)(replace(model, denoiser=Says(a)))["filling error"] for a in answers]
    assert errors[0] == errors[2] == 0.0 and 0.2 < errors[1] < 5.0


# -------------------------------------------------------------------------------------------------- command
@pytest.fixture
def few(motions, monkeypatch):
    """The command with two short motions and a narrow model."""
    monkeypatch.delenv("MOTIONLAB_DATA", raising=False)
    other = [perform_sequence(Corpus(seconds=5.0, seed=4), 0).motion]
    parts = {"train": {"synthetic": motions}, "choose": {"unseen": other}}
    monkeypatch.setattr(splits, "motions_by_part", lambda folder, part: parts[part])
    monkeypatch.setattr(shipped, "_HELD", 12)
    monkeypatch.setattr(shipped, "FROM", {})
    for name, recipe in shipped.DENOISER_PRESETS.items():
        small = replace(recipe, size="tiny", frames=min(recipe.frames, 8), steps=9, batch=4, noising=20, warm_up=1)
        small = replace(small, recalls=min(recipe.recalls, 20))
        monkeypatch.setitem(shipped.DENOISER_PRESETS, name, small)


def test_presets_of_real_motion_train_on_the_people_who_train(few, motions, tmp_path, monkeypatch):
    """Half of each source, what a recording lacks left out, chosen by the people who choose."""
    found = shipped.RealMotions(
        {"recordings": [motions[0]] * 4, "synthetic": [motions[1]] * 2},
        {"people who choose": motions[:1]},
        {"recordings": [("left_foot",), (), (), ("spine2",)], "synthetic": [(), ()]},
        people=3,
    )
    monkeypatch.setattr(shipped, "real_motions", lambda folder, whole: found)
    recipe = shipped.DENOISER_PRESETS["real_free"]
    learnt = shipped._learnt_from(replace(recipe, share=0.5), None)
    assert learnt.missing == {"recordings": [("left_foot",), ("spine2",)], "synthetic": [()]}
    first, out = tmp_path / "first", tmp_path / "mine"
    for where in ([str(first)], [str(out), "--start", str(first)]):
        assert main(["train", "diffusion", "--preset", "real_free", "--steps", "3", "--out", *where]) == 0
    about = checkpoint.read_recipe(out)
    assert about["people"] == 3 and "--data FOLDER" in about["made by"]
    assert about["began from"]["recipe"]["source"] == splits.REAL_MOTION
    assert list(about["minutes that chose the checkpoint"]) == ["people who choose"]
    assert "gain over the filter" in about["curve"][-1] and load_denoiser(out).denoiser.start is None


@pytest.mark.parametrize("preset", ["free", "fixed", "pose", "told"])
def test_the_command_writes_a_checkpoint_of_every_preset(few, tmp_path, capsys, preset, monkeypatch):
    monkeypatch.setattr(shipped, "_SHORT", 3)
    out = tmp_path / "mine"
    assert main(["train", "diffusion", "--preset", preset, "--steps", "3", "--seed", "8", "--out", str(out)]) == 0
    assert "mine.safetensors" in capsys.readouterr().out
    model, about = load_denoiser(out), checkpoint.read_recipe(out)
    assert model.recipe == replace(shipped.DENOISER_PRESETS[preset], steps=3, seed=8)
    assert f"--preset {preset}" in about["made by"] and "--steps 3 --seed 8" in about["made by"]
    assert about["curve"][-1]["step"] == 3 and about["windows"] and about["recordings"] == []
    by = "filling error" if preset == "told" else "kid"
    assert about["chosen"] == {"step": 3, by: about["curve"][-1][by]}
    assert not list(tmp_path.glob("*.pt"))
    drawn = model.sample(2, torch.Generator().manual_seed(0), steps=3)
    assert (drawn.contacts is None) == (preset in ("fixed", "pose"))
    assert preset != "fixed" or drawn.root[..., :2].abs().max() < 0.2  # barely trained numbers of unit size, metres


def test_what_ships_was_made_by_its_preset():
    recipes = {f"diffusion_{name}": recipe for name, recipe in shipped.DENOISER_PRESETS.items()}
    starts = {f"diffusion_{name}": shipped.begins(name, recipe) for name, recipe in shipped.DENOISER_PRESETS.items()}
    recipes |= {f"arm_{name}": recipe for name, recipe in arms.ARMS.items()}
    starts |= {f"arm_{name}": checkpoint.SHIPPED / f"arm_{start}" for name, start in arms.FROM.items()}
    for name, recipe in recipes.items():
        if name.startswith("diffusion_real_") and not (checkpoint.SHIPPED / f"{name}.json").exists():
            continue  # may be trained, does not ship
        about, begun = checkpoint.read_recipe(checkpoint.SHIPPED / name), starts.get(name)
        assert DenoiserRecipe.read(about["recipe"]) == recipe, name
        assert ("began from" in about) == (begun is not None), name
        assert not begun or about["began from"]["sha256"] == checkpoint.read_recipe(begun)["sha256"], name


def test_an_arm_is_trained_by_name_and_goes_on(few, motions, tmp_path, monkeypatch):
    recipe = replace(shipped.DENOISER_PRESETS["free"], steps=3, seed=1)
    monkeypatch.setattr(arms, "ARMS", {"mine": recipe})
    data = gather(splits.prepared(motions, recipe), recipe.frames)
    training.DenoiserTraining(recipe, data).run(until=2, keep=tmp_path / "arm_mine.partial.pt")
    arms.command(["mine", "--out", str(tmp_path)])
    assert load_denoiser(tmp_path / "arm_mine").recipe == recipe
    assert "arms mine" in checkpoint.read_recipe(tmp_path / "arm_mine")["made by"]
    assert not list(tmp_path.glob("*.pt"))
    with pytest.raises(SystemExit):
        arms.command(["yours", "--out", str(tmp_path)])


def test_the_command_goes_on_where_it_was_stopped(few, motions, tmp_path):
    assert main(["train", "diffusion", "--steps", "4", "--seed", "3", "--out", str(tmp_path / "whole")]) == 0
    recipe = replace(shipped.DENOISER_PRESETS["free"], steps=4, seed=3)
    data = gather(splits.prepared(motions, recipe), recipe.frames)
    training.DenoiserTraining(recipe, data).run(until=2, keep=tmp_path / "part.partial.pt")
    assert main(["train", "diffusion", "--out", str(tmp_path / "part"), "--resume"]) == 0
    (whole, about), (part, again) = (checkpoint.load(tmp_path / name) for name in ("whole", "part"))
    assert all(torch.equal(whole[name], part[name]) for name in whole)
    assert again["made by"] == about["made by"] and again["recipe"] == about["recipe"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["diffusion", "--preset", "official"], "no preset 'official'"),
        (["humor", "--preset", "free"], "no preset 'free'"),
        (["humor", "--size", "thesis"], "no sizes"),
        (["diffusion", "--resume"], "without --resume"),
        (["diffusion", "--preset", "real_free"], "with --data"),
    ],
)
def test_the_command_says_what_is_wrong(few, tmp_path, capsys, arguments, complaint):
    assert main(["train", *arguments, "--out", str(tmp_path / "never")]) == 2
    assert complaint in capsys.readouterr().err


def test_a_run_can_begin_from_another_model_and_goes_on_with_its_normaliser(data, tmp_path):
    first = training.DenoiserTraining(SMALL, data).run(until=2).averaged
    other = replace(first, normaliser=Normaliser(first.normaliser.mean + 1.0, first.normaliser.scale * 2.0))
    run = training.DenoiserTraining(SMALL, data, start=other)
    assert all(torch.equal(run.model.state_dict()[k], v) for k, v in other.denoiser.state_dict().items())
    run.run(until=1, keep=tmp_path / "run.pt")
    again = training.DenoiserTraining.resume(tmp_path / "run.pt", data)
    assert torch.equal(run.shipped.normaliser.mean, other.normaliser.mean)
    assert torch.equal(again.normaliser.scale, other.normaliser.scale)
    with pytest.raises(DataError, match="another one"):
        training.DenoiserTraining(replace(SMALL, patch=2), data, start=other)
    with pytest.raises(DataError, match="other features"):
        training.DenoiserTraining(replace(SMALL, frame="world"), data, start=other)


def test_a_model_that_is_told_can_begin_from_one_that_is_told_nothing(data):
    first = training.DenoiserTraining(replace(SMALL, spectral=True), data).run(until=4).averaged
    run = training.DenoiserTraining(replace(TOLD, spectral=True), data, start=first)
    x = torch.randn(3, SMALL.frames, run.layout.size, generator=torch.Generator().manual_seed(0))
    stamps, mask = torch.tensor([1, 20, 40]), torch.rand(x.shape, generator=torch.Generator().manual_seed(1)) < 0.5
    with torch.no_grad():
        here, there = run.averaged.denoiser.network(x, stamps, x, mask), first.denoiser.network(x, stamps)
    assert torch.allclose(here, there, atol=1e-5) and there.abs().max() > 1e-3
    assert run.model.start.factor.abs().max() > 0 and run.normaliser is first.normaliser
    size, weight = run.layout.size, run.model.network.input_process.poseEmbedding.weight
    assert not weight[:, size:].any()
    run.run(until=3)
    assert weight[:, size : 2 * size].any() and weight[:, 2 * size :].any()  # the start and the mask are heard
    with pytest.raises(DataError, match="another one"):
        training.DenoiserTraining(replace(TOLD, spectral=True, before=True), data, start=first)
