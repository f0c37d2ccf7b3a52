"""Training of the transition prior: examples, losses, schedules, and a run that a kill does not change."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import train
from motionlab.__main__ import main
from motionlab.errors import DataError
from motionlab.humor import checkpoint, losses, state, training
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.examples import examples
from motionlab.humor.losses import Predicted, Scales
from motionlab.humor.state import DELTA_SLICES, SLICES
from motionlab.motion import mirror
from motionlab.skeleton import STANDARD

SMALL = training.Recipe(width=64, steps=12, batch=6, length=4, chain=2, seed=5)


@pytest.fixture(scope="module")
def motions():
    return [perform_sequence(Corpus(seconds=6.0, seed=3), index).motion for index in (0, 1)]


@pytest.fixture(scope="module")
def data(motions):
    return examples(motions, SMALL.length + 1)


@pytest.fixture
def transitions(motions):
    """Past and now (N, 339) in the frame of the past, contacts of now (N, 9)."""
    return *losses.pairs(state.from_motion(motions[0]).float()), motions[0].contacts[1:].float()


# ------------------------------------------------------------------------------------------------- examples
def test_windows_lie_inside_one_motion_and_its_mirror_image(motions):
    data = examples(motions, 11)
    frames = sum(m.frames for m in motions)
    assert len(data.states) == 2 * frames and len(data.begins) == 2 * (frames - 10 * len(motions))
    ends = torch.tensor([m.frames for m in motions for _ in range(2)]).cumsum(0)
    assert torch.equal(
        torch.searchsorted(ends, data.begins, right=True), torch.searchsorted(ends, data.begins + 10, right=True)
    )
    x, contacts, bones = data.draw(40, torch.Generator().manual_seed(0))
    assert x.shape == (40, 11, 339) and contacts.shape == (40, 11, 9) and bones.shape == (40, 22, 3)
    speed = 30 * (x[:, 2:] - x[:, :-2])[..., SLICES["trans"]] / 2  # central: as stored, so that no window has a seam
    assert torch.allclose(speed, x[:, 1:-1, SLICES["trans_vel"]], atol=1e-3)


def test_mirror_images_are_those_of_the_motion(motions):
    data = examples(motions[:1], 11)
    n = motions[0].frames
    assert torch.equal(data.states[n:], state.from_motion(mirror(motions[0])).float())
    assert len(examples(motions[:1], 11, mirrored=False).states) == n


def test_a_draw_follows_its_generator_and_the_digest_the_numbers(motions, data):
    draws = [data.draw(9, torch.Generator().manual_seed(seed))[0] for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1]) and not torch.equal(draws[0], draws[2])
    other = replace(motions[0], root=motions[0].root + torch.tensor([0.0, 0.0, 1e-3]))
    assert examples(motions, 5).digest == data.digest != examples([other, motions[1]], 5).digest


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda m: m.cut(0, 8), "11 frames"),
        (lambda m: replace(m, contacts=None), "without contacts"),
        (lambda m: replace(m, root=m.root * torch.nan), "not finite"),
    ],
)
def test_motions_that_cannot_be_learned_from(motions, change, complaint):
    with pytest.raises(DataError, match=complaint):
        examples([change(motions[0])], 11)


# --------------------------------------------------------------------------------------------------- losses
def test_scales_fold_into_the_weights_exactly(transitions):
    past, now, _ = (x.double() for x in transitions)
    torch.manual_seed(1)
    model = Cvae(64).double()
    scales = Scales(*(x.double() for x in vars(Scales.measure(past, now)).values()))
    plain = scales.folded(model)
    z = torch.randn(len(past), 48, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for a, b in (
        (scales.posterior(model, past, now).mean, plain.posterior(past, now).mean),
        (scales.posterior(model, past, now).log_var, plain.posterior(past, now).log_var),
        (scales.prior(model, past).mean, plain.prior(past).mean),
        (scales.decode(model, past, z), plain.decode(past, z)),
    ):
        assert (a - b).abs().max() < 1e-10
    assert not torch.allclose(model.prior(past).mean, plain.prior(past).mean, atol=1e-3)  # the scales do matter


def test_scales_of_the_official_recipe_change_nothing(transitions):
    past, _, _ = transitions
    torch.manual_seed(1)
    model, scales = Cvae(64), Scales.none()
    z = torch.zeros(len(past), 48)
    assert torch.equal(scales.decode(model, past, z), model.decode(past, z))
    assert torch.equal(scales.prior(model, past).mean, model.prior(past).mean)


def gaussians(count, shift=0.0):
    nil = torch.zeros(count, 48)
    return Gaussian(nil + shift, nil), Gaussian(nil, nil)


def compare(after, transitions, logits=None, shift=0.0, **how):
    _, now, contacts = transitions
    logits = 20.0 * (2 * contacts - 1) if logits is None else logits
    q, p = gaussians(len(now), shift)
    bones = STANDARD.offsets.expand(len(now), -1, -1)
    return losses.compare(Predicted(after, logits, q, p), now, contacts, bones, **how)


def test_the_truth_costs_nothing(motions, transitions):
    _, now, contacts = transitions
    q, p = gaussians(len(now))
    bones = motions[0].skeleton.offsets.expand(len(now), -1, -1)
    for official in (False, True):
        parts = losses.compare(Predicted(now, 20 * (2 * contacts - 1), q, p), now, contacts, bones, official=official)
        assert parts["reconstruction"] == 0 and parts["kl"] == 0
        assert parts["kinematics"] < 1e-4 and parts["contact"] < 1e-6


def test_an_error_of_one_unit_counts_alike_in_every_part(transitions):
    """Half its square over 3, Huber's form; the official recipe takes the plain square of the numbers."""
    _, now, _ = transitions
    for name, part in SLICES.items():
        off = now.clone()
        off[:, part] += losses.UNITS[name]
        assert compare(off, transitions)["reconstruction"].item() == pytest.approx(1 / 6, rel=1e-3), name
        found = compare(off, transitions, official=True)["reconstruction"].item()
        assert found == pytest.approx(losses.UNITS[name] ** 2, rel=1e-2), name


def test_far_errors_count_linearly_but_for_the_official_recipe(transitions):
    _, now, _ = transitions
    off, further = now.clone(), now.clone()
    off[:, SLICES["joints"]] += 0.3
    further[:, SLICES["joints"]] += 0.6
    near, far = compare(off, transitions)["reconstruction"], compare(further, transitions)["reconstruction"]
    assert far / near == pytest.approx(2, rel=0.02)
    near, far = (compare(x, transitions, official=True)["reconstruction"] for x in (off, further))
    assert far / near == pytest.approx(4, rel=1e-3)


def test_kl_and_contacts_are_what_they_are_called(transitions):
    _, now, contacts = transitions
    assert compare(now, transitions, shift=0.5)["kl"].item() == pytest.approx(48 * 0.125)
    assert compare(now, transitions, logits=torch.zeros_like(contacts))["contact"].item() == pytest.approx(
        0.6931, abs=1e-3
    )
    speed = now[:, SLICES["joints_vel"]].unflatten(-1, (22, 3))[:, STANDARD.contact_indices].square().sum(-1)
    always = compare(now, transitions, logits=torch.full_like(contacts, 30.0))["slide"]
    assert torch.allclose(always, speed.mean())
    assert compare(now, transitions, logits=torch.full_like(contacts, -30.0))["slide"] < 1e-8


def test_scales_measure_the_change_of_a_transition(transitions):
    past, now, _ = transitions
    scales = Scales.measure(past, now)
    assert torch.allclose(
        scales.change[DELTA_SLICES["joints"]], (now - past)[:, SLICES["joints"]].std(0).clamp(min=1e-4)
    )
    assert (scales.std >= 1e-3).all() and (scales.change > 0).all()


# ----------------------------------------------------------------------------------------------------- runs
@pytest.fixture(scope="module")
def whole(data):
    """A run without an interruption."""
    return training.Training(SMALL, data).run(every=4)


def test_losses_fall(data):
    run = training.Training(replace(SMALL, steps=80, batch=12, supervised=1.0, sampled=2.0), data)
    begin = sum(run._advance()["reconstruction"] for _ in range(5))
    while run.step < 75:
        run._advance()
    assert sum(run._advance()["reconstruction"] for _ in range(5)) < 0.7 * begin


def test_the_same_seed_gives_the_same_weights(data):
    one, two = (training.Training(SMALL, data).run(until=3) for _ in range(2))
    assert same(one, two)
    assert not same(one, training.Training(replace(SMALL, seed=6), data).run(until=3))


def same(one, two):
    pairs = [(one.model.state_dict(), two.model.state_dict()), (one.average, two.average)]
    weights = all(torch.equal(a[name], b[name]) for a, b in pairs for name in a)
    return weights and torch.equal(one.generator.get_state(), two.generator.get_state())


@pytest.mark.parametrize(("stop", "official"), [(1, False), (11, False), (4, True)])
def test_a_stopped_run_goes_on_to_the_bit(data, tmp_path, stop, official):
    recipe = replace(SMALL, official=official, chain=1 if official else 2)
    whole = training.Training(recipe, data).run(every=4)
    training.Training(recipe, data).run(until=stop, keep=tmp_path / "run.pt", every=4)
    again = training.resume(tmp_path / "run.pt", data)
    assert again.step == stop and again.recipe == recipe
    again.run(every=4)
    assert same(whole, again) and again.step == whole.step == recipe.steps
    assert again.curve[-1] == whole.curve[-1]


def test_control_a_forgotten_generator_changes_the_run(whole, data, tmp_path):
    training.Training(SMALL, data).run(until=4, keep=tmp_path / "run.pt")
    again = training.resume(tmp_path / "run.pt", data)
    again.generator.manual_seed(0)
    assert not same(whole, again.run())


CHILD = """
import sys, torch
torch.set_num_threads(1)
sys.path.insert(0, {tests!r})
from test_humor_training import SMALL, perform_sequence, Corpus, examples, training
motions = [perform_sequence(Corpus(seconds=6.0, seed=3), index).motion for index in (0, 1)]
training.Training(SMALL, examples(motions, 5)).run(keep={keep!r}, every=1)
"""


def test_a_killed_process_leaves_a_run_that_can_go_on(whole, data, tmp_path):
    keep = tmp_path / "run.pt"
    program = CHILD.format(tests=os.path.dirname(__file__), keep=str(keep))
    with subprocess.Popen([sys.executable, "-c", program], env=os.environ | {"OMP_NUM_THREADS": "1"}) as child:
        deadline = time.monotonic() + 100
        while not keep.exists() and time.monotonic() < deadline and child.poll() is None:
            time.sleep(0.002)
        child.send_signal(signal.SIGKILL)
    again = training.resume(keep, data)
    assert 1 <= again.step <= SMALL.steps
    assert same(whole, again.run())


def test_ctrl_c_keeps_what_was_reached(whole, data, tmp_path):
    def stop(model):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        training.Training(SMALL, data).run(keep=tmp_path / "run.pt", validate=stop, every=3)
    again = training.resume(tmp_path / "run.pt", data)
    assert again.step == 3
    assert same(whole, again.run())


@pytest.mark.parametrize("content", [None, b"", b"not a run", "half"])
def test_damaged_runs_are_refused(data, tmp_path, content):
    path = tmp_path / "run.pt"
    if content == "half":
        training.Training(SMALL, data).run(until=1, keep=path)
        path.write_bytes(path.read_bytes()[:3000])
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match="without --resume"):
        training.resume(path, data)


def test_a_run_does_not_go_on_with_other_examples(motions, data, tmp_path):
    training.Training(SMALL, data).run(until=1, keep=tmp_path / "run.pt")
    with pytest.raises(DataError, match="other examples"):
        training.resume(tmp_path / "run.pt", examples(motions[:1], SMALL.length + 1))
    with pytest.raises(DataError, match="frames for"):
        training.Training(SMALL, examples(motions, 9))


def test_a_loss_that_is_not_finite_stops_the_run(data):
    run = training.Training(replace(SMALL, kl=float("nan")), data)
    with pytest.raises(DataError, match="learning rate"):
        run.run()


def test_rates_fall_as_written(data):
    official = training.Training(replace(SMALL, official=True), data)
    assert [official._rate(share) for share in (0, 0.3, 0.5, 0.9)] == [1, 0.5, 0.25, 0.125]
    run = training.Training(SMALL, data)
    run.step = 100
    rates = [run._rate(share) for share in (0, 0.25, 0.5, 0.75, 1.0)]
    assert rates == sorted(rates, reverse=True) and rates[0] == 1 and 0 < rates[-1] < 0.05


def test_the_official_preset_is_the_official_recipe():
    """humor.md, section 3: width 1024, 200 windows of 10 pairs, Adamax at 1e-4, KL 4e-4, no gradient through time."""
    recipe = training.PRESETS["official"]
    assert (recipe.width, recipe.batch, recipe.length, recipe.chain) == (1024, 200, 10, 1)
    assert (recipe.lr, recipe.kl, recipe.contact, recipe.slide) == (1e-4, 4e-4, 0.01, 0.01)
    epochs = [200 * share for share in (recipe.supervised, recipe.sampled, recipe.annealed, *training.DECAYS)]
    assert epochs == pytest.approx([10, 20, 50, 50, 80, 140])


def test_what_ships_is_the_moving_average(data):
    run = training.Training(SMALL, data).run()
    model = Cvae(SMALL.width)
    model.load_state_dict(run.average)
    x = data.states[:7]
    past = state.localise(x, state.heading(x))
    assert torch.allclose(run.prior.prior(past).mean, run.scales.prior(model, past).mean, atol=1e-3)
    assert len(run.prior.state_dict()) == 50 and not any(p.requires_grad for p in run.prior.parameters())


# -------------------------------------------------------------------------------------------------- command
@pytest.fixture
def few(motions, monkeypatch):
    """The command with two short motions and a narrow model."""
    long = [perform_sequence(Corpus(seconds=5.0, seed=4), 0).motion]
    monkeypatch.setattr(train, "sources", lambda folder: ({"synthetic": motions}, {"synthetic, unseen": long}))
    monkeypatch.setitem(training.PRESETS, "compact", replace(SMALL, steps=9))


def test_the_command_writes_a_checkpoint_with_its_recipe(few, tmp_path, capsys):
    assert main(["train", "humor", "--steps", "3", "--seed", "8", "--out", str(tmp_path / "mine")]) == 0
    assert "mine.safetensors" in capsys.readouterr().out
    tensors, recipe = checkpoint.load(tmp_path / "mine")
    assert len(tensors) == 50 and not list(tmp_path.glob("*.pt"))
    assert recipe["recipe"]["seed"] == 8 and recipe["recipe"]["steps"] == 3 and "--steps 3" in recipe["made by"]
    assert recipe["curve"][-1]["step"] == 3 and recipe["examples"] and recipe["recordings"] == []
    row = recipe["quality, held out"]["synthetic, unseen"]
    assert row["one step, hold, cm"] > 0 and row["2 s, hold, cm"] > row["one step, hold, cm"]
    checkpoint.motion_prior(str(tmp_path / "mine"))


def test_the_command_goes_on_where_it_was_stopped(few, tmp_path, monkeypatch):
    arguments = ["train", "humor", "--steps", "4", "--out"]
    assert main([*arguments, str(tmp_path / "whole")]) == 0
    data = examples(train.sources(None)[0]["synthetic"], SMALL.length + 1)
    run = training.Training(replace(training.PRESETS["compact"], seed=0, steps=4), data)
    run.run(until=2, keep=tmp_path / "part.partial.pt")
    assert main([*arguments, str(tmp_path / "part"), "--resume"]) == 0
    whole, part = (checkpoint.load(tmp_path / name)[0] for name in ("whole", "part"))
    assert all(torch.equal(whole[name], part[name]) for name in whole)


def test_the_command_says_what_is_missing(few, tmp_path, capsys):
    assert main(["train", "humor", "--out", str(tmp_path / "never"), "--resume"]) == 2
    assert "without --resume" in capsys.readouterr().err
