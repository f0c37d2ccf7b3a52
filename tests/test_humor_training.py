"""Training of the transition prior: examples, losses, schedules, and a run that a kill does not change."""

import math
import os
import signal
import subprocess
import sys
import time
from copy import deepcopy
from dataclasses import asdict, replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import train, train_small
from motionlab.__main__ import main
from motionlab.errors import DataError, ShapeError
from motionlab.humor import checkpoint, losses, priors, state, training
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.examples import examples
from motionlab.humor.losses import Predicted, Scales
from motionlab.humor.state import DELTA_SLICES, SLICES
from motionlab.motion import mirror
from motionlab.skeleton import STANDARD

SMALL = training.Recipe(width=64, steps=8, batch=6, length=3, chain=2, seed=5)
OFFICIAL = replace(SMALL, official=True, chain=1)


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
    assert (
        examples(motions, SMALL.length + 1).digest
        == data.digest
        != examples([other, motions[1]], SMALL.length + 1).digest
    )


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
    recipe = replace(SMALL, steps=40, batch=24, length=1, chain=1, supervised=1.0, sampled=2.0, lr=0.03)
    run = training.Training(recipe, replace(data, length=2))
    begin = sum(run._advance()["reconstruction"] for _ in range(5))
    while run.step < 35:
        run._advance()
    assert sum(run._advance()["reconstruction"] for _ in range(5)) < 0.7 * begin


def test_the_same_seed_gives_the_same_weights(data):
    one, two = (training.Training(SMALL, data).run(until=2) for _ in range(2))
    assert same(one, two)
    assert not same(one, training.Training(replace(SMALL, seed=6), data).run(until=2))


def same(one, two):
    pairs = [(one.model.state_dict(), two.model.state_dict()), (one.average, two.average)]
    weights = all(torch.equal(a[name], b[name]) for a, b in pairs for name in a)
    return weights and torch.equal(one.generator.get_state(), two.generator.get_state())


@pytest.mark.parametrize(("stop", "recipe"), [(1, SMALL), (7, SMALL), (3, OFFICIAL)])
def test_a_stopped_run_goes_on_to_the_bit(data, tmp_path, stop, recipe, request):
    whole = request.getfixturevalue("whole") if recipe is SMALL else training.Training(recipe, data).run(every=4)
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
from motionlab.humor import examples, training
data, recipe = torch.load(sys.argv[1]).values()
training.Training(training.Recipe(**recipe), examples.Examples(**data)).run(keep=sys.argv[2], every=1)
"""


def test_a_killed_process_leaves_a_run_that_can_go_on(whole, data, tmp_path):
    keep, given = tmp_path / "run.pt", tmp_path / "given.pt"
    torch.save({"data": vars(data), "recipe": vars(SMALL)}, given)
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
    with pytest.raises(DataError, match=r"the loss is not finite .*learning rate"):
        run.run()
    assert run.step == 0 and not run.optimiser.state


def spoil(monkeypatch, which, number=math.nan):
    """Make the losses of some steps, counted from 0, another number."""
    true, calls = losses.compare, iter(range(10_000))

    def compare(*args, **how):
        parts = true(*args, **how)
        return parts | {"kl": parts["kl"] * number} if which(next(calls)) else parts

    monkeypatch.setattr(losses, "compare", compare)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_the_official_recipe_skips_a_batch_without_a_loss(data, monkeypatch, tmp_path, number):
    spoil(monkeypatch, lambda call: call in (2, 3), number)
    run = training.Training(OFFICIAL, data).run(until=2)
    before = deepcopy((run.model.state_dict(), run.average, run.optimiser.state_dict()["state"]))
    run.run(until=4, keep=tmp_path / "run.pt")
    assert alike(before, (run.model.state_dict(), run.average, run.optimiser.state_dict()["state"]))
    assert run.curve[-1] == {"step": 4, "skipped": 2} and run.in_a_row == 2
    again = training.resume(tmp_path / "run.pt", data)
    assert (again.skipped, again.in_a_row) == (2, 2)
    run.run()
    assert run.step == OFFICIAL.steps and run.curve[-1]["skipped"] == 2 and run.in_a_row == 0
    assert not alike(before[0], run.model.state_dict())
    assert all(value.isfinite().all() for value in run.model.state_dict().values())


def alike(a, b):
    """Nested numbers and tensors, equal to the bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(alike(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(alike, a, b))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def test_gradients_that_are_not_finite_change_nothing_either(data):
    for recipe in (OFFICIAL, SMALL):
        run = training.Training(recipe, data).run(until=1)
        before = deepcopy((run.model.state_dict(), run.optimiser.state_dict()["state"]))
        weight = run.model.decoder.net[-1].bias
        weight.register_hook(lambda gradient: gradient * math.nan)
        if recipe is OFFICIAL:
            run.run(until=2)
            assert run.skipped == 1
        else:
            with pytest.raises(DataError, match="gradient is not finite"):
                run.run(until=2)
        assert alike(before, (run.model.state_dict(), run.optimiser.state_dict()["state"]))


def test_the_official_recipe_gives_up_when_every_batch_fails(data, monkeypatch):
    monkeypatch.setattr(training, "GIVE_UP", 3)
    spoil(monkeypatch, lambda call: call != 2)  # two in a row are skipped, then a good one, then three
    run = training.Training(OFFICIAL, data)
    with pytest.raises(DataError, match="step 5: the loss is not finite, 3 batches in a row"):
        run.run()
    assert run.skipped == 5


def test_only_the_compact_recipe_clips_its_gradients(data, monkeypatch):
    def refuse(*args, **how):
        raise AssertionError("clipped")

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", refuse)
    training.Training(OFFICIAL, data).run(until=1)
    with pytest.raises(AssertionError, match="clipped"):
        training.Training(SMALL, data).run(until=1)


def test_clipped_gradients_are_at_most_of_length_one(data):
    """Adamax hides the length in its first step, so look at the gradients themselves."""
    for recipe in (SMALL, OFFICIAL):
        run = training.Training(replace(recipe, kinematics=1e4), data).run(until=1)
        norm = torch.nn.utils.get_total_norm([p.grad for p in run.model.parameters()])
        assert norm <= 1.001 if recipe is SMALL else norm > 10


def test_the_kl_weight_grows_from_nought_in_the_official_recipe_only(data, monkeypatch):
    official, compact = (training.Training(recipe, data) for recipe in (OFFICIAL, SMALL))
    end, full = SMALL.annealed, SMALL.kl
    assert [official._kl(end * part) for part in (0, 0.5, 1, 2)] == pytest.approx([0, full / 2, full, full])
    assert official._kl(0) == 0
    assert [compact._kl(end * part) for part in (0, 0.5, 1)] == pytest.approx([0.1 * full, 0.6 * full, full])
    spoil(monkeypatch, lambda call: True, 1e6)  # an enormous KL: without weight it changes nothing at the first step
    rows = [run._advance() for run in (official, compact)]
    for recipe, row in zip((OFFICIAL, SMALL), rows, strict=True):
        weights = {"reconstruction": 1.0, "kinematics": recipe.kinematics, "contact": recipe.contact}
        rest = sum(weight * row[name] for name, weight in (weights | {"slide": recipe.slide}).items())
        assert (row["loss"] == pytest.approx(rest)) is (recipe is OFFICIAL)


def test_truth_is_drawn_for_a_whole_batch_in_the_official_recipe(data, monkeypatch):
    true, shapes = torch.rand, []

    def rand(*shape, **how):
        shapes.append(shape)
        return true(*shape, **how)

    monkeypatch.setattr(torch, "rand", rand)
    for recipe, count in ((OFFICIAL, 1), (SMALL, SMALL.batch)):
        run = training.Training(recipe, data)
        shapes.clear()
        run.run(until=1)
        assert shapes == [(count, 1)] * recipe.length


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


@pytest.mark.parametrize("width", [0, 16, 48, 100])
def test_widths_that_the_norms_cannot_have(width):
    with pytest.raises(ShapeError, match="multiple of 32"):
        Cvae(width)


def test_the_least_width_that_can_learn(generator):
    """At 32 the decoder's last norm leaves nothing of the past state; 64 is the next."""
    past, z = torch.randn(2, 339, generator=generator), torch.randn(1, 48, generator=generator).expand(2, -1)
    one, two = Cvae(32).frozen().decode(past, z)
    assert torch.equal(one, two)
    model = Cvae(64).frozen()
    one, two = model.decode(past, z)
    assert (one - two).abs().max() > 1e-3
    assert model.decode(past[:1], z[:1]).isfinite().all()


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
    other = [perform_sequence(Corpus(seconds=5.0, seed=4), 0).motion.cut(0, 61)]
    monkeypatch.setattr(train, "sources", lambda folder: ({"synthetic": motions}, {"synthetic, unseen": other}))
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


def test_the_command_goes_on_where_it_was_stopped(few, tmp_path):
    """Steps and seed are those of the run that was begun, given again or not."""
    assert main(["train", "humor", "--steps", "4", "--seed", "3", "--out", str(tmp_path / "whole")]) == 0
    begin(tmp_path / "part.partial.pt")
    assert main(["train", "humor", "--out", str(tmp_path / "part"), "--resume"]) == 0
    (whole, recipe), (part, again) = (checkpoint.load(tmp_path / name) for name in ("whole", "part"))
    assert all(torch.equal(whole[name], part[name]) for name in whole)
    assert again["made by"] == recipe["made by"] and "--steps 4 --seed 3" in again["made by"]
    assert again["recipe"] == recipe["recipe"] and again["recipe"]["varied"] == 1


def begin(kept):
    recipe = replace(training.PRESETS["compact"], steps=4, seed=3)
    data = examples(train.together(train.sources(None)[0], recipe), SMALL.length + 1)
    return training.Training(recipe, data).run(until=2, keep=kept)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--steps", "5"], "begun with steps 4, not 5 "),
        (["--steps", "4", "--seed", "0"], "begun with seed 3, not 0 "),
        (["--preset", "official"], "begun with width 64, not 1024"),
    ],
)
def test_a_stopped_run_does_not_go_on_as_another(few, tmp_path, capsys, monkeypatch, arguments, complaint):
    kept = tmp_path / "part.partial.pt"
    torch.save({"recipe": asdict(replace(training.PRESETS["compact"], steps=4, seed=3))}, kept)
    monkeypatch.setattr(train, "sources", None)  # it is told before any motion is made
    assert main(["train", "humor", "--out", str(tmp_path / "part"), "--resume", *arguments]) == 2
    said = capsys.readouterr().err
    assert complaint in said and str(kept) in said and "without --resume" in said
    assert kept.exists() and not (tmp_path / "part.safetensors").exists()


@pytest.mark.parametrize("steps", ["0", "-3", "many"])
def test_the_command_wants_steps_that_can_be_counted(few, steps, capsys):
    with pytest.raises(SystemExit):
        main(["train", "humor", f"--steps={steps}"])
    assert "above 0" in capsys.readouterr().err


def test_the_command_says_what_is_missing(few, tmp_path, capsys):
    assert main(["train", "humor", "--out", str(tmp_path / "never"), "--resume"]) == 2
    assert "without --resume" in capsys.readouterr().err


def test_the_recipe_names_the_recordings_that_were_there(tmp_path):
    assert train.found_in(tmp_path) == []
    for name in ("deepmimic", "bandai_namco"):  # the licence of the second does not let weights be shipped
        (tmp_path / name).mkdir()
    assert train.found_in(tmp_path) == ["deepmimic"]


def test_copies_of_every_motion_as_many_as_the_recipe_says(motions):
    split = {"synthetic": motions, "recordings": motions[:1]}
    found = train.together(split, replace(SMALL, varied=1, varied_recordings=2))
    assert [any(m is each for each in motions) for m in found] == [True, False, True, False, True, False, False]
    again, other = (train.together(split, replace(SMALL, varied_recordings=2, seed=seed)) for seed in (5, 6))
    assert torch.equal(found[1].rot, again[1].rot) and not torch.equal(found[1].rot, other[1].rot)
    assert train.together(split, replace(SMALL, varied=0, varied_recordings=0)) == [*motions, motions[0]]


# ------------------------------------------------------------------------------------------------ small priors
def test_the_command_trains_the_small_priors(motions, tmp_path, monkeypatch):
    """End to end with little data: both checkpoints load, and their recipes say what they are."""
    some = [m for seed in (1, 2) for m in (perform_sequence(Corpus(seconds=6.0, seed=seed), 0).motion, *motions)]
    monkeypatch.setattr(train, "sources", lambda folder: ({"synthetic": some}, {"unseen": motions[:1]}))
    assert main(["train", "small", "--steps", "3", "--seed", "2", "--out", str(tmp_path)]) == 0
    pose, initial = (
        priors.pose(str(tmp_path / "pose_prior_compact")),
        priors.initial(str(tmp_path / "init_gmm_compact")),
    )
    turns = pose.decode(torch.zeros(2, 32))
    assert torch.allclose(turns @ turns.mT, torch.eye(3).expand_as(turns), atol=1e-5)
    features = train_small.first_states(motions[:1], 20)
    assert initial.log_prob(features).isfinite().all() and initial.means.shape == (12, 138)
    recipes = [checkpoint.read_recipe(tmp_path / f"{name}_compact") for name in ("pose_prior", "init_gmm")]
    assert [recipe["command"] for recipe in recipes] == [
        "python -m motionlab train small --steps 3 --seed 2", "python -m motionlab train small --seed 2",
    ]  # fmt: skip
    assert recipes[0]["data"] == recipes[1]["data"] == {"synthetic": sum(m.frames for m in some)}
    assert recipes[0]["steps"] == 3 and recipes[0]["held out"]["unseen"]["degrees"] > 0
    assert recipes[1]["held-out log-likelihood, nats per frame"]["unseen"]["frames"] == -(-motions[0].frames // 3)
