"""Training of the transition prior: examples, losses, schedules, and the command."""

import math
from dataclasses import asdict, replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab import checkpoint, shipped, train
from motionlab.__main__ import main
from motionlab.errors import DataError, ShapeError
from motionlab.humor import pretrained, state, training
from motionlab.humor.cvae import Cvae, Gaussian
from motionlab.humor.examples import examples
from motionlab.humor.state import SLICES
from motionlab.humor.training import Predicted, Scales
from motionlab.skeleton import STANDARD

SMALL = training.PriorRecipe(width=64, steps=8, batch=6, length=3, chain=2, seed=5)
OFFICIAL = replace(SMALL, official=True, chain=1)


@pytest.fixture(scope="module")
def data(motions):
    return examples(motions, SMALL.length + 1)


@pytest.fixture
def transitions(motions):
    """Past and now (N, 339) in the frame of the past, contacts of now (N, 9)."""
    return *training.transition_pairs(state.from_motion(motions[0]).float()), motions[0].contacts[1:].float()


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
    found = Scales.measure(past, now)
    scales = Scales(found.mean.double(), found.std.double(), found.change.double())
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


def gaussians(count, shift=0.0):
    nil = torch.zeros(count, 48)
    return Gaussian(nil + shift, nil), Gaussian(nil, nil)


def compare(after, transitions, logits=None, shift=0.0, **how):
    _, now, contacts = transitions
    logits = 20.0 * (2 * contacts - 1) if logits is None else logits
    q, p = gaussians(len(now), shift)
    bones = STANDARD.offsets.expand(len(now), -1, -1)
    return training._transition_losses(Predicted(after, logits, q, p), now, contacts, bones, **how)


def test_the_truth_costs_nothing(motions, transitions):
    _, now, contacts = transitions
    q, p = gaussians(len(now))
    bones = motions[0].skeleton.offsets.expand(len(now), -1, -1)
    for official in (False, True):
        parts = training._transition_losses(
            Predicted(now, 20 * (2 * contacts - 1), q, p), now, contacts, bones, official=official
        )
        assert parts["reconstruction"] == 0 and parts["kl"] == 0
        assert parts["kinematics"] < 1e-4 and parts["contact"] < 1e-6


def test_an_error_of_one_unit_counts_alike_in_every_part(transitions):
    """Half its square over 3, Huber's form; the official recipe takes the plain square of the numbers."""
    _, now, _ = transitions
    for name, part in SLICES.items():
        off = now.clone()
        off[:, part] += training.ERROR_UNITS[name]
        assert compare(off, transitions)["reconstruction"].item() == pytest.approx(1 / 6, rel=1e-3), name
        found = compare(off, transitions, official=True)["reconstruction"].item()
        assert found == pytest.approx(training.ERROR_UNITS[name] ** 2, rel=1e-2), name


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


# ----------------------------------------------------------------------------------------------------- runs


def test_windows_of_another_length_are_refused(motions):
    with pytest.raises(DataError, match="frames for"):
        training.PriorTraining(SMALL, examples(motions, 9))


def test_only_the_official_recipe_skips_what_is_not_finite_and_clips_nothing(data, monkeypatch):
    spoil(monkeypatch, lambda call: call == 2)  # the second of the official recipe
    official, compact = (training.PriorTraining(replace(r, kinematics=1e4), data) for r in (OFFICIAL, SMALL))
    for run in (official, compact):
        run.run(until=1)
        norm = torch.nn.utils.get_total_norm([p.grad for p in run.model.parameters()])
        assert norm > 10 if run is official else norm <= 1.001
    official.run(until=3, every=2)
    assert official.curve[-2] == {"step": 2, "skipped": 1} and official.give_up == 100
    spoil(monkeypatch, lambda call: True)
    with pytest.raises(DataError, match=r"the loss is not finite .*learning rate"):
        compact.run()


def spoil(monkeypatch, which, number=math.nan):
    """Make the losses of some steps, counted from 0, another number."""
    true, calls = training._transition_losses, iter(range(10_000))

    def compare(*args, **how):
        parts = true(*args, **how)
        return parts | {"kl": parts["kl"] * number} if which(next(calls)) else parts

    monkeypatch.setattr(training, "_transition_losses", compare)


def test_the_kl_weight_grows_from_nought_in_the_official_recipe_only(data, monkeypatch):
    official, compact = (training.PriorTraining(recipe, data) for recipe in (OFFICIAL, SMALL))
    end, full = SMALL.annealed, SMALL.kl
    assert [official._kl(end * part) for part in (0, 0.5, 1, 2)] == pytest.approx([0, full / 2, full, full])
    assert official._kl(0) == 0
    assert [compact._kl(end * part) for part in (0, 0.5, 1)] == pytest.approx([0.1 * full, 0.6 * full, full])
    spoil(monkeypatch, lambda call: True, 1e6)  # an enormous KL: without weight it changes nothing at the first step
    rows = [run.advance() for run in (official, compact)]
    for recipe, row in zip((OFFICIAL, SMALL), rows, strict=True):
        weights = {"reconstruction": 1.0, "kinematics": recipe.kinematics, "contact": recipe.contact}
        rest = sum(weight * row[name] for name, weight in (weights | {"slide": recipe.slide}).items())
        assert (row["loss"] == pytest.approx(rest)) is (recipe is OFFICIAL)


def test_rates_fall_as_written(data):
    official, compact = (training.PriorTraining(replace(recipe, steps=100), data) for recipe in (OFFICIAL, SMALL))

    def rates(run, steps):
        found = []
        for run.step in steps:
            found.append(run._rate() / run.recipe.lr)
        return found

    assert rates(official, (0, 30, 50, 90)) == [1, 0.5, 0.25, 0.125]
    falling = rates(compact, (50, 60, 75, 99))
    assert rates(compact, (0,))[0] == pytest.approx(1 / 50)
    assert falling == sorted(falling, reverse=True) and falling[0] == pytest.approx(0.51) and falling[-1] < 0.05


@pytest.mark.parametrize("width", [0, 16, 48, 100])
def test_widths_that_the_norms_cannot_have(width):
    with pytest.raises(ShapeError, match="multiple of 32"):
        Cvae(width)


# -------------------------------------------------------------------------------------------------- command
@pytest.fixture
def few(motions, monkeypatch):
    """The command with two short motions and a narrow model."""
    other = [perform_sequence(Corpus(seconds=5.0, seed=4), 0).motion.cut(0, 61)]
    monkeypatch.setattr(
        train, "_training_sources", lambda folder: ({"synthetic": motions}, {"synthetic, unseen": other})
    )
    monkeypatch.setitem(training.PRIOR_PRESETS, "compact", replace(SMALL, steps=9))


def test_the_command_writes_a_checkpoint_with_its_recipe(few, tmp_path, capsys):
    assert main(["train", "humor", "--steps", "3", "--seed", "8", "--out", str(tmp_path / "mine")]) == 0
    assert "mine.safetensors" in capsys.readouterr().out
    tensors, recipe = checkpoint.load(tmp_path / "mine")
    assert len(tensors) == 50 and not list(tmp_path.glob("*.pt"))
    assert recipe["recipe"]["seed"] == 8 and recipe["recipe"]["steps"] == 3 and "--steps 3" in recipe["made by"]
    assert recipe["curve"][-1]["step"] == 3 and recipe["examples"] and recipe["recordings"] == []
    row = recipe["quality, held out"]["synthetic, unseen"]
    assert row["one step, hold, cm"] > 0 and row["2 s, hold, cm"] > row["one step, hold, cm"]
    pretrained.load_motion_prior(str(tmp_path / "mine"))


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
    torch.save({"recipe": asdict(replace(training.PRIOR_PRESETS["compact"], steps=4, seed=3))}, kept)
    monkeypatch.setattr(train, "_training_sources", None)  # it is told before any motion is made
    assert main(["train", "humor", "--out", str(tmp_path / "part"), "--resume", *arguments]) == 2
    said = capsys.readouterr().err
    assert complaint in said and str(kept) in said and "without --resume" in said
    assert kept.exists() and not (tmp_path / "part.safetensors").exists()


@pytest.mark.parametrize("steps", ["0", "-3", "many"])
def test_the_command_wants_steps_that_can_be_counted(few, steps, capsys):
    with pytest.raises(SystemExit):
        main(["train", "humor", f"--steps={steps}"])
    assert "above 0" in capsys.readouterr().err


def test_the_recipe_names_the_recordings_that_were_there(tmp_path):
    assert train._found_in(tmp_path) == []
    for name in ("deepmimic", "bandai_namco"):  # the licence of the second does not let weights be shipped
        (tmp_path / name).mkdir()
    assert train._found_in(tmp_path) == ["deepmimic"]


# ------------------------------------------------------------------------------------------------ small priors
def test_the_command_trains_the_small_priors(motions, tmp_path, monkeypatch):
    """End to end with little data: both checkpoints load, and their recipes say what they are."""
    some = [m for seed in (1, 2) for m in (perform_sequence(Corpus(seconds=6.0, seed=seed), 0).motion, *motions)]
    monkeypatch.setattr(train, "_training_sources", lambda folder: ({"synthetic": some}, {"unseen": motions[:1]}))
    assert main(["train", "small", "--steps", "3", "--seed", "2", "--out", str(tmp_path)]) == 0
    pose, initial = (
        pretrained.load_pose_prior(str(tmp_path / "pose_prior_compact")),
        pretrained.load_initial(str(tmp_path / "init_gmm_compact")),
    )
    turns = pose.decode(torch.zeros(2, 32))
    assert torch.allclose(turns @ turns.mT, torch.eye(3).expand_as(turns), atol=1e-5)
    features = shipped._first_states(motions[:1], 20)
    assert initial.log_prob(features).isfinite().all() and initial.means.shape == (12, 138)
    recipes = [checkpoint.read_recipe(tmp_path / f"{name}_compact") for name in ("pose_prior", "init_gmm")]
    assert [recipe["command"] for recipe in recipes] == [
        "python -m motionlab train small --steps 3 --seed 2", "python -m motionlab train small --seed 2",
    ]  # fmt: skip
    assert recipes[0]["data"] == recipes[1]["data"] == {"synthetic": sum(m.frames for m in some)}
    assert recipes[0]["steps"] == 3 and recipes[0]["held out"]["unseen"]["degrees"] > 0
    assert recipes[1]["held-out log-likelihood, nats per frame"]["unseen"]["frames"] == -(-motions[0].frames // 3)
