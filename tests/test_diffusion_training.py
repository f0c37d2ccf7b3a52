"""Training of the denoiser: a run that a kill does not change, the choice of its weights, files and the command."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
from copy import deepcopy
from dataclasses import asdict, replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import diffusion_data, train_diffusion
from motionlab.__main__ import main
from motionlab.diffusion import denoiser, judge, losses, trained, training
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.losses import Weights
from motionlab.diffusion.trained import Recipe, silenced
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError
from motionlab.humor import checkpoint

TINY = {"size": 16, "layers": 1, "heads": 2, "hidden": 16}
SMALL = Recipe(
    size="tiny", frames=8, steps=8, batch=4, lr=3e-3, warm_up=2, noising=50, weights=Weights(late=0.5), seed=5
)
TOLD = replace(SMALL, told=True)


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    monkeypatch.setitem(denoiser.SIZES, "tiny", TINY)


@pytest.fixture(scope="module")
def motions():
    return [perform_sequence(Corpus(seconds=6.0, seed=3), index).motion for index in (0, 1)]


@pytest.fixture(scope="module")
def data(motions):
    return gather([on_standard(m) for m in motions], SMALL.frames)


@pytest.fixture
def whole(data):
    """A run without an interruption."""
    return training.Training(SMALL, data).run(every=4)


def same(one, two):
    pairs = [(one.model.state_dict(), two.model.state_dict()), (one.average, two.average)]
    weights = all(torch.equal(a[name], b[name]) for a, b in pairs for name in a)
    return weights and torch.equal(one.generator.get_state(), two.generator.get_state())


# ----------------------------------------------------------------------------------------------------- runs
def test_losses_fall(data):
    recipe = replace(SMALL, steps=120, batch=16, lr=1e-2, dropout=0.0)
    run = training.Training(recipe, data)
    before = run.averaged.errors(data.evenly(32), torch.Generator().manual_seed(1))
    run.run(every=40)
    after = run.averaged.errors(data.evenly(32), torch.Generator().manual_seed(1))
    assert list(before) == [f"x0 error at t = {t}" for t in (2, 10, 20, 29, 39)]
    assert all(after[name] < 0.7 * before[name] for name in before)
    assert after["x0 error at t = 2"] < after["x0 error at t = 39"]


def test_the_same_seed_gives_the_same_weights_whatever_torch_drew_elsewhere(data):
    one = training.Training(SMALL, data).run(until=2)
    torch.manual_seed(77)
    state = torch.get_rng_state()
    two = training.Training(SMALL, data).run(until=2)
    assert same(one, two) and torch.equal(state, torch.get_rng_state())
    assert not same(one, training.Training(replace(SMALL, seed=6), data).run(until=2))


def test_dropout_drops(data):
    run, dry = (training.Training(replace(SMALL, dropout=p), data).run(until=2) for p in (0.3, 0.0))
    assert any(not torch.equal(run.average[name], dry.average[name]) for name in run.average)


@pytest.mark.parametrize(("stop", "recipe"), [(1, SMALL), (5, SMALL), (3, TOLD)])
def test_a_stopped_run_goes_on_to_the_bit(data, tmp_path, stop, recipe):
    held, judged = data.evenly(5), lambda model: {"kid": float(next(model.denoiser.parameters()).sum())}
    how = {"every": 1, "judge_every": 2, "held": held, "judge": judged}
    whole = training.Training(recipe, data).run(**how)
    training.Training(recipe, data).run(until=stop, keep=tmp_path / "run.pt", **{**how, "judge_every": 99})
    again = training.resume(tmp_path / "run.pt", data)
    assert again.step == stop and again.recipe == recipe
    again.run(**how)
    assert same(whole, again) and again.step == whole.step == recipe.steps
    assert again.curve[-1] == whole.curve[-1] and "kid" in whole.curve[-1]


def test_control_a_forgotten_generator_changes_the_run(whole, data, tmp_path):
    training.Training(SMALL, data).run(until=4, keep=tmp_path / "run.pt")
    again = training.resume(tmp_path / "run.pt", data)
    again.generator.manual_seed(0)
    assert not same(whole, again.run())


CHILD = """
import sys, torch
torch.set_num_threads(1)
from motionlab.diffusion import denoiser, training, trained, windows
data, recipe, denoiser.SIZES["tiny"] = torch.load(sys.argv[1]).values()
run = training.Training(trained.Recipe.read(recipe), windows.Windows(**data))
run.run(keep=sys.argv[2], every=1)
"""


def test_a_killed_process_leaves_a_run_that_can_go_on(whole, data, tmp_path):
    keep, given = tmp_path / "run.pt", tmp_path / "given.pt"
    torch.save({"data": vars(data), "recipe": asdict(SMALL), "tiny": TINY}, given)
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, given, keep], env=os.environ | {"OMP_NUM_THREADS": "1"}
    ) as child:
        deadline = time.monotonic() + 100
        while not keep.exists() and time.monotonic() < deadline and child.poll() is None:
            time.sleep(0.002)
        child.send_signal(signal.SIGKILL)
    again = training.resume(keep, data)
    assert 1 <= again.step <= SMALL.steps
    assert same(whole, again.run())


@pytest.mark.parametrize("where", ["draw", "loss", "judge"])
def test_ctrl_c_keeps_what_was_reached(whole, data, tmp_path, monkeypatch, where):
    run = training.Training(SMALL, data).run(until=3)

    def stop(*args, **how):
        raise KeyboardInterrupt

    with monkeypatch.context() as m:
        if where == "draw":
            m.setattr(training, "noise_like", stop)
        if where == "loss":
            m.setattr(losses, "compare", stop)
        with pytest.raises(KeyboardInterrupt):
            run.run(keep=tmp_path / "run.pt", judge=stop if where == "judge" else None, every=4, judge_every=4)
    again = training.resume(tmp_path / "run.pt", data)
    assert again.step == (4 if where == "judge" else 3)
    assert same(whole, again.run())


def test_ctrl_c_between_weights_and_average_keeps_the_file_before(whole, data, tmp_path):
    run = training.Training(SMALL, data).run(until=3, keep=tmp_path / "run.pt")
    step = run.optimiser.step

    def stop():
        step()
        raise KeyboardInterrupt

    run.optimiser.step = stop
    with pytest.raises(KeyboardInterrupt):
        run.run(keep=tmp_path / "run.pt")
    again = training.resume(tmp_path / "run.pt", data)
    assert again.step == 3 and same(whole, again.run())


@pytest.mark.parametrize("content", [None, b"", b"not a run", "half", "humor"])
def test_damaged_runs_are_refused(data, tmp_path, content):
    path = tmp_path / "run.pt"
    if content == "half":
        training.Training(SMALL, data).run(until=1, keep=path)
        path.write_bytes(path.read_bytes()[:3000])
    elif content == "humor":
        torch.save({"recipe": {"width": 64}, "step": 1}, path)
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"run.pt.*without --resume"):
        training.resume(path, data)


def test_a_run_does_not_go_on_with_other_windows(motions, data, tmp_path):
    training.Training(SMALL, data).run(until=1, keep=tmp_path / "run.pt")
    with pytest.raises(DataError, match="other windows"):
        training.resume(tmp_path / "run.pt", gather(motions, SMALL.frames))
    with pytest.raises(DataError, match="windows of 9 frames at 30 fps; expected 8"):
        training.Training(SMALL, gather(motions, 9))
    with pytest.raises(DataError, match="at 15 fps"):
        training.Training(SMALL, gather([m.cut(step=2) for m in motions], SMALL.frames))
    with pytest.raises(DataError, match="without contacts"):
        training.Training(SMALL, gather([replace(m, contacts=None) for m in motions], SMALL.frames))


def spoil(monkeypatch, which):
    """Make the losses of some steps, counted from 0, no number."""
    true, calls = losses.compare, iter(range(10_000))

    def compare(*args, **how):
        parts = true(*args, **how)
        return parts | {"simple": parts["simple"] * math.nan} if which(next(calls)) else parts

    monkeypatch.setattr(losses, "compare", compare)


def test_a_batch_without_a_loss_is_skipped(data, monkeypatch, tmp_path):
    spoil(monkeypatch, lambda call: call in (2, 3))
    run = training.Training(SMALL, data).run(until=2)
    before = deepcopy((run.model.state_dict(), run.average))
    run.run(until=4, keep=tmp_path / "run.pt")
    for a, b in zip(before, (run.model.state_dict(), run.average), strict=True):
        assert all(torch.equal(a[name], b[name]) for name in a)
    assert run.curve[-1] == {"step": 4, "skipped": 2}
    again = training.resume(tmp_path / "run.pt", data)
    assert (again.skipped, again.in_a_row) == (2, 2)
    run.run()
    assert run.skipped == 2 and run.in_a_row == 0
    assert not torch.equal(before[1]["output_process.poseFinal.weight"], run.average["output_process.poseFinal.weight"])
    assert all(value.isfinite().all() for value in run.average.values())


def test_a_run_of_nothing_but_such_batches_ends(data, monkeypatch):
    spoil(monkeypatch, lambda call: True)
    run = training.Training(replace(SMALL, steps=100), data)
    with pytest.raises(DataError, match=r"not finite, 20 batches in a row .*learning rate"):
        run.run()
    assert run.skipped == training.GIVE_UP


def test_rate_average_and_late_losses_follow_the_recipe(data):
    run = training.Training(replace(SMALL, average=0.3), data)
    rates = []
    for _ in range(SMALL.steps):
        before = {name: value.clone() for name, value in run.average.items()}
        row = run._advance()
        rates.append(run.optimiser.param_groups[0]["lr"] / SMALL.lr)
        assert ("fk" in row) == ("contact" in row) == (run.step > SMALL.steps // 2)
        keep = min(0.3, (1 + run.step) / (10 + run.step))
        for name, value in run.model.state_dict().items():
            assert torch.allclose(run.average[name], keep * before[name] + (1 - keep) * value, atol=1e-6)
    assert rates[0] == pytest.approx(0.5) and rates[1] > 0.9
    assert rates[-1] == pytest.approx(0.51 + 0.49 * math.cos(math.pi * 7 / 8))


def test_kinematics_count_by_the_signal_or_by_what_is_known(data, monkeypatch):
    seen, compare = {}, losses.compare

    def spied(*args, **how):
        seen.update(how)
        return compare(*args, **how)

    monkeypatch.setattr(losses, "compare", spied)
    weights = Weights(by_signal=True, late=0.0)
    told = replace(TOLD, weights=weights, blind=1.0, batch=16)  # all from pure noise, where there is no signal
    training.Training(told, data)._advance()
    share = seen["known"].float().mean((1, 2))
    assert share.max() > 0.3 and share.min() == 0
    assert torch.allclose(seen["trust"], share, atol=1e-3)
    training.Training(replace(told, told=False), data)._advance()
    assert seen["trust"].max() < 1e-3


@pytest.mark.parametrize("by_signal", [False, True])
def test_the_loss_is_the_weighted_sum_of_its_parts(data, by_signal):
    weights = Weights(fk=2.0, velocity=0.5, known=3.0, contact=7.0, late=0.0, by_signal=by_signal)
    row = training.Training(replace(TOLD, weights=weights), data)._advance()
    parts = row["simple"] + 2 * row["fk"] + 0.5 * row["velocity"] + 3 * row["known"] + 7 * row["contact"]
    assert row["loss"] == pytest.approx(parts, rel=1e-5)
    if by_signal:
        plain = training.Training(replace(TOLD, weights=replace(weights, by_signal=False)), data)._advance()
        assert row["fk"] < plain["fk"] and row["simple"] == plain["simple"]


def test_the_judge_chooses_the_weights_that_ship(data, tmp_path):
    seen, marks = [], iter([3.0, 1.0, 2.0, float("nan")])

    def verdict(model):
        seen.append(model.denoiser.state_dict())
        return {"kid": next(marks)}

    run = training.Training(SMALL, data).run(every=1, judge_every=2, judge=verdict, until=6, keep=tmp_path / "run.pt")
    again = training.resume(tmp_path / "run.pt", data)
    again.run(every=1, judge_every=2, judge=verdict)
    assert [row.get("kid") for row in run.curve] == [None, 3.0, None, 1.0, None, 2.0]
    for each in (run, again):
        assert each.best["step"] == 4 and each.best["kid"] == 1.0
        assert all(torch.equal(seen[1][name], value) for name, value in each.shipped.denoiser.state_dict().items())
    assert not torch.equal(seen[1]["output_process.poseFinal.bias"], again.average["output_process.poseFinal.bias"])


def test_a_network_that_corrects_begins_as_what_it_corrects(data):
    run = training.Training(replace(TOLD, spectral=True), data)
    assert run.averaged.errors(data.evenly(8), torch.Generator().manual_seed(0)) == silenced(run.averaged).errors(
        data.evenly(8), torch.Generator().manual_seed(0)
    )
    run.run(until=2)
    assert run.averaged.denoiser.network.output_process.poseFinal.weight.abs().max() > 0


def test_the_curve_says_what_the_network_adds(data):
    run = training.Training(replace(TOLD, spectral=True), data)
    held = data.evenly(8)
    assert run._measured(held, None)[training.GAIN] == 0.0
    run.average["network.output_process.poseFinal.bias"] += 1.0  # nonsense, everywhere
    row = run._measured(held, None)
    assert row[training.GAIN] < -0.1
    assert training.GAIN not in training.Training(SMALL, data)._measured(held, None)


def test_early_averages_are_not_judged(data):
    run = training.Training(SMALL, data).run(every=1, judge_every=2, judge_from=0.6, judge=lambda model: {"kid": 1.0})
    judged = [row["step"] for row in run.curve if "kid" in row]
    assert judged == [step for step in range(2, SMALL.steps + 1, 2) if step >= 0.6 * SMALL.steps]
    assert run.best["step"] == judged[0] > 2


def test_without_a_judge_the_last_average_ships(whole, data):
    shipped = whole.shipped
    assert all(torch.equal(whole.average[name], value) for name, value in shipped.denoiser.state_dict().items())
    assert not any(p.requires_grad for p in shipped.denoiser.parameters()) and not shipped.denoiser.training


def test_numbers_are_of_unit_size_whatever_the_seed(data):
    one, two = (training.Training(replace(SMALL, seed=seed), data) for seed in (0, 1))
    assert torch.equal(one.normaliser.scale, two.normaliser.scale)
    x = one.averaged.encode(data.draw(300, torch.Generator().manual_seed(9)))
    for name, part in Layout().slices.items():
        assert x[..., part].square().mean().sqrt().item() == pytest.approx(1.0, abs=0.15), name


# ------------------------------------------------------------------------------------------ several devices
class Half:
    """What a run needs of an accelerator: the second of two processes."""

    device, process_index, num_processes = torch.device("cpu"), 1, 2

    def prepare_model(self, model):
        return model

    def backward(self, loss):
        loss.backward()


def test_every_process_takes_its_share_of_one_batch(data, monkeypatch):
    seen, true = [], losses.compare

    def compare(estimate, truth, *args, **how):
        seen.append(truth)
        return true(estimate, truth, *args, **how)

    monkeypatch.setattr(losses, "compare", compare)
    training.Training(SMALL, data)._advance()
    training.Training(SMALL, data, accelerator=Half())._advance()
    assert torch.equal(seen[1], seen[0][1::2])
    with pytest.raises(DataError, match=r"batch of 5 does not divide among 2 processes .*multiple"):
        training.Training(replace(SMALL, batch=5), data, accelerator=Half())


PROCESS = """
import sys, torch
torch.set_num_threads(1)
from accelerate import Accelerator
from motionlab.diffusion import denoiser, training, trained, windows
data, recipe, denoiser.SIZES["tiny"] = torch.load(sys.argv[1]).values()
run = training.Training(trained.Recipe.read(recipe), windows.Windows(**data), accelerator=Accelerator(cpu=True))
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
    one, two = training.Training(recipe, data).run(until=3), training.resume(keep, data)
    assert two.step == 3
    fresh = training.Training(recipe, data)
    keys = slice(len(one.average[BIAS]) // 3, 2 * len(one.average[BIAS]) // 3)
    for run in (one, two):
        run.average[BIAS][keys] = 0.0
    for name, value in one.average.items():
        assert torch.allclose(two.average[name], value, rtol=0, atol=1e-6), name
    assert any((two.average[n] - fresh.average[n]).abs().max() > 2e-3 for n in fresh.average)  # it did train


# ---------------------------------------------------------------------------------------------------- files
@pytest.fixture
def model(data):
    return training.Training(TOLD, data).run(until=2).shipped


def test_a_model_comes_back_from_its_files(model, data, tmp_path):
    x, t = model.encode(data.evenly(3)), torch.tensor([1, 20, 49])
    for name, half, tolerance in (("full", False, 0.0), ("half", True, 5e-3)):
        trained.save(tmp_path / name, model, {"note": "of a test"}, half=half)
        again = trained.load(tmp_path / name)
        assert again.recipe == model.recipe and again.layout == model.layout
        assert torch.equal(again.normaliser.mean, model.normaliser.mean)
        assert torch.equal(again.schedule.alpha_bar, model.schedule.alpha_bar)
        mask = torch.ones_like(x)
        assert (again.denoiser(x, t, x, mask) - model.denoiser(x, t, x, mask)).abs().max() <= tolerance
        assert not again.denoiser.training
    assert json.loads((tmp_path / "full.json").read_text())["note"] == "of a test"
    assert (tmp_path / "half.safetensors").stat().st_size < 0.6 * (tmp_path / "full.safetensors").stat().st_size
    assert trained.motion_model(str(tmp_path / "full")).recipe == model.recipe


def test_loading_draws_nothing_from_torchs_generator(model, tmp_path):
    trained.save(tmp_path / "m", model, {})
    state = torch.get_rng_state()
    trained.load(tmp_path / "m")
    assert torch.equal(state, torch.get_rng_state())


def damage(path, how):
    tensors, about = checkpoint.load(path)
    if how == "no tensors":
        path.with_suffix(".safetensors").unlink()
    elif how == "cut":
        path.with_suffix(".safetensors").write_bytes(path.with_suffix(".safetensors").read_bytes()[:500])
    elif how == "no recipe":
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
        ("no tensors", "No such file"), ("cut", "sha256"), ("no recipe", "not a motion diffusion model"),
        ("a field less", "no told"), ("other size", "not a motion diffusion model"), ("unknown size", "compact"),
        ("no normaliser", "scale"), ("another normaliser", "normaliser"), ("NaN", "not finite"),
    ],
)  # fmt: skip
def test_damaged_and_foreign_files_are_refused(model, tmp_path, how, complaint):
    trained.save(tmp_path / "m", model, {})
    damage(tmp_path / "m", how)
    with pytest.raises(DataError, match=complaint) as caught:
        trained.load(tmp_path / "m")
    assert caught.value.remedy and "m.safetensors" in str(caught.value)


def test_the_prior_of_humor_is_no_denoiser():
    with pytest.raises(DataError, match=r"humor_compact.*not a motion diffusion model"):
        trained.motion_model("humor_compact")


def test_samples_are_motions_of_the_recipes_length(model):
    one, same, other = (model.sample(3, torch.Generator().manual_seed(s), steps=4) for s in (0, 0, 1))
    assert one.positions.shape == (3, 8, 22, 3) and one.positions.isfinite().all() and one.contacts.shape == (3, 8, 9)
    assert torch.equal(one.root, same.root) and not torch.equal(one.root, other.root)


# ---------------------------------------------------------------------------------------------------- judge
def test_the_judge_prefers_motion_like_the_held_out(motions):
    length = 20
    data, held = (gather([on_standard(m)], length, mirrored=False).evenly(60) for m in motions)
    scaled = judge.Scaled(held)
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
    measure = judge.judge(held, count=60)
    found = [measure(Fixed(m))["kid"] for m in (held, data, noisy, frozen)]
    assert found[0] < min(found[1:]) and found[0] < 1e-3 and all(math.isfinite(x) for x in found)


def test_models_that_are_told_are_judged_by_what_they_fill_in(data):
    """One that knows the truth, one that says the mean, and one that spoils only what it was given."""
    held = data.evenly(40)
    model = training.Training(TOLD, data).averaged
    x0 = model.encode(held)

    class Says(torch.nn.Linear):
        def __init__(self, answer):
            super().__init__(1, 1)
            self.answer = answer

        def forward(self, x, stamps, known, mask):
            assert torch.equal(known, torch.where(mask, x0, 0.0)) and (stamps == 49).all()
            return self.answer(x0, mask)

    answers = [lambda x, m: x, lambda x, m: 0 * x, lambda x, m: torch.where(m, x + 9.0, x)]
    errors = [judge.filling(held)(replace(model, denoiser=Says(a)))["filling error"] for a in answers]
    assert errors[0] == errors[2] == 0.0 and 0.2 < errors[1] < 5.0


def test_single_poses_are_judged_by_their_joints(motions):
    held = gather([on_standard(motions[0])], 1).evenly(50)
    scaled = judge.Scaled(held)
    assert scaled.real.shape == (50, 66)


# -------------------------------------------------------------------------------------------------- command
@pytest.fixture
def few(motions, monkeypatch):
    """The command with two short motions and a narrow model."""
    monkeypatch.delenv("MOTIONLAB_DATA", raising=False)
    other = [perform_sequence(Corpus(seconds=5.0, seed=4), 0).motion]
    parts = {"train": {"synthetic": motions}, "choose": {"unseen": other}}
    monkeypatch.setattr(diffusion_data, "sources", lambda folder, part: parts[part])
    monkeypatch.setattr(train_diffusion, "HELD", 12)
    monkeypatch.setattr(train_diffusion, "FROM", {})
    for name, recipe in train_diffusion.PRESETS.items():
        small = replace(recipe, size="tiny", frames=min(recipe.frames, 8), steps=9, batch=4, noising=20, warm_up=1)
        small = replace(small, recalls=min(recipe.recalls, 20))
        monkeypatch.setitem(train_diffusion.PRESETS, name, small)


@pytest.mark.parametrize("preset", ["free", "fixed", "world", "pose", "told"])
def test_the_command_writes_a_checkpoint_of_every_preset(few, tmp_path, capsys, preset, monkeypatch):
    monkeypatch.setattr(train_diffusion, "SHORT", 3)
    out = tmp_path / "mine"
    assert main(["train", "diffusion", "--preset", preset, "--steps", "3", "--seed", "8", "--out", str(out)]) == 0
    assert "mine.safetensors" in capsys.readouterr().out
    model, about = trained.load(out), checkpoint.read_recipe(out)
    assert model.recipe == replace(train_diffusion.PRESETS[preset], steps=3, seed=8)
    assert f"--preset {preset}" in about["made by"] and "--steps 3 --seed 8" in about["made by"]
    assert about["curve"][-1]["step"] == 3 and about["windows"] and about["recordings"] == []
    by = "filling error" if preset == "told" else "kid"
    assert about["chosen"] == {"step": 3, by: about["curve"][-1][by]}
    assert not list(tmp_path.glob("*.pt"))
    drawn = model.sample(2, torch.Generator().manual_seed(0), steps=3)
    assert (drawn.contacts is None) == (preset in ("fixed", "pose"))
    if preset == "fixed":
        assert drawn.root[..., :2].abs().max() < 0.2  # barely trained numbers of unit size, metres


def test_a_preset_goes_on_from_what_ships_unless_its_size_is_another(few, tmp_path, monkeypatch):
    monkeypatch.setattr(train_diffusion, "FROM", {"told": "diffusion_stuck"})
    monkeypatch.setattr(checkpoint, "SHIPPED", tmp_path)
    assert main(["train", "diffusion", "--preset", "stuck", "--steps", "2"]) == 0
    assert main(["train", "diffusion", "--preset", "told", "--steps", "2"]) == 0
    about = checkpoint.read_recipe(tmp_path / "diffusion_told")
    assert about["began from"]["recipe"]["told"] is False and about["recipe"]["told"] is True
    told = train_diffusion.PRESETS["told"]
    assert train_diffusion.begins("told", replace(told, size="small")) is None
    assert train_diffusion.begins("stuck", told) is None


def test_what_ships_was_made_by_its_preset():
    for name, recipe in train_diffusion.PRESETS.items():
        about = checkpoint.read_recipe(checkpoint.SHIPPED / (name if "arm_" in name else f"diffusion_{name}"))
        assert Recipe.read(about["recipe"]) == recipe, name
        begun = train_diffusion.begins(name, recipe)
        assert ("began from" in about) == (begun is not None), name
        assert not begun or about["began from"]["sha256"] == checkpoint.read_recipe(begun)["sha256"], name


def test_the_command_goes_on_where_it_was_stopped(few, motions, tmp_path):
    assert main(["train", "diffusion", "--steps", "4", "--seed", "3", "--out", str(tmp_path / "whole")]) == 0
    recipe = replace(train_diffusion.PRESETS["free"], steps=4, seed=3)
    data = gather(diffusion_data.prepared(motions, recipe), recipe.frames)
    training.Training(recipe, data).run(until=2, keep=tmp_path / "part.partial.pt")
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
    ],
)
def test_the_command_says_what_is_wrong(few, tmp_path, capsys, arguments, complaint):
    assert main(["train", *arguments, "--out", str(tmp_path / "never")]) == 2
    assert complaint in capsys.readouterr().err


def test_copies_and_versions_of_the_data(motions):
    plain, twice = (diffusion_data.prepared(motions, replace(SMALL, seed=1), copies=n) for n in (0, 1))
    assert len(plain) == 2 and len(twice) == 4
    assert torch.equal(twice[0].rot, plain[0].rot) and not torch.equal(twice[1].rot, plain[0].rot)
    fixed = diffusion_data.prepared(motions, replace(SMALL, version="A"))
    assert all(m.contacts is None and not m.root[:, :2].any() for m in fixed)
    assert torch.equal(fixed[0].rot, plain[0].rot)


def test_a_run_can_begin_from_another_model_and_goes_on_with_its_normaliser(data, tmp_path):
    first = training.Training(SMALL, data).run(until=2).averaged
    other = replace(first, normaliser=Normaliser(first.normaliser.mean + 1.0, first.normaliser.scale * 2.0))
    run = training.Training(SMALL, data, start=other)
    assert all(torch.equal(run.model.state_dict()[k], v) for k, v in other.denoiser.state_dict().items())
    run.run(until=1, keep=tmp_path / "run.pt")
    again = training.resume(tmp_path / "run.pt", data)
    assert torch.equal(run.shipped.normaliser.mean, other.normaliser.mean)
    assert torch.equal(again.normaliser.scale, other.normaliser.scale)
    with pytest.raises(DataError, match="another one"):
        training.Training(replace(SMALL, patch=2), data, start=other)
    with pytest.raises(DataError, match="other features"):
        training.Training(replace(SMALL, frame="world"), data, start=other)


def test_a_model_that_is_told_can_begin_from_one_that_is_told_nothing(data):
    first = training.Training(replace(SMALL, spectral=True), data).run(until=4).averaged
    run = training.Training(replace(TOLD, spectral=True), data, start=first)
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
        training.Training(replace(TOLD, spectral=True, before=True), data, start=first)
