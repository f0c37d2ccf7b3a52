"""What notebook 10 measures is what it says: known truths, and controls that must come out worse."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion import baseline_trials as trials
from motionlab.diffusion import denoiser, trained
from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.planting import planted
from motionlab.diffusion.spectral import power
from motionlab.diffusion.trained import LEVELS, Recipe, Trained
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import ShapeError
from motionlab.skeleton import STANDARD

TINY = {"size": 16, "layers": 1, "heads": 2, "hidden": 16}


@pytest.fixture(scope="module", autouse=True)
def _tiny():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(denoiser.SIZES, "tiny", TINY)
        yield


@pytest.fixture(scope="module")
def data():
    return gather([on_standard(perform_sequence(Corpus(seconds=12.0, seed=3), k).motion) for k in (0, 1)], 16)


@pytest.fixture(scope="module")
def motion(data):
    return replace(data.evenly(24), skeleton=STANDARD)


@pytest.fixture(scope="module")
def model(data, motion):
    recipe = Recipe(size="tiny", frames=16, spectral=True, noising=100)
    torch.manual_seed(0)
    network = recipe.denoiser().eval().requires_grad_(False)
    normaliser = Normaliser.measure(recipe.layout.encode(motion), recipe.layout)
    made = Trained(network, recipe.schedule, recipe.layout, normaliser, recipe)
    network.spectrum.copy_(power(made.encode(motion)))
    return made


def seeded(n=0):
    return torch.Generator().manual_seed(n)


def test_guesses_agree_with_the_model_s_own_errors(model, motion):
    found = trials.guesses(model, motion, seeded())
    assert {x.shape for x in found.values()} == {(24, len(LEVELS))}
    own = list(model.errors(motion, seeded()).values())
    assert torch.allclose(found["x0"].mean(0), torch.tensor(own), atol=1e-5)


def test_a_model_that_knows_guesses_without_error(model, motion):
    class Knows(torch.nn.Module):
        def forward(self, x, stamps):
            return model.encode(motion)

    found = trials.guesses(replace(model, denoiser=Knows()), motion, seeded())
    assert all(x.abs().max() < 1e-3 for x in found.values())


def test_the_filter_is_what_a_silenced_network_leaves(model, motion):
    silent = trained.silenced(model)
    found = trials.guesses(silent, motion, seeded(), (0.0, 0.2, 1.0))["x0"].mean(0)
    assert 5 * found[0] < found[1] < found[2] / 5 and found[2] == pytest.approx(1.0, abs=0.1)
    loud = deepcopy(model)  # a network that has something to say
    loud.denoiser.network.output_process.poseFinal.bias += 0.5
    said = trials.guesses(loud, motion, seeded(), (0.0, 0.2, 1.0))["x0"].mean(0)
    quiet = trials.guesses(trained.silenced(loud), motion, seeded(), (0.0, 0.2, 1.0))["x0"].mean(0)
    assert (said[1:] > 1.01 * found[1:]).all() and torch.equal(quiet, found)
    plain = replace(model, denoiser=denoiser.Denoiser(model.layout.size, **TINY))
    with pytest.raises(ShapeError):
        trained.silenced(plain)


def test_pools_follow_the_minutes(motion):
    a, b = motion.clip(slice(0, 12)), motion.clip(slice(12, 24))
    pool = trials.pooled({"a": a, "b": b}, {"a": 30.0, "b": 10.0, "other": 99.0}, 16)
    assert len(pool.root) == 12 + 4 and pool.contacts.shape[0] == 16
    assert torch.equal(pool.root[0], a.root[0])
    assert torch.equal(pool.root[6, :, 0], -a.root[1, :, 0])  # every second one is seen in the mirror


def test_trivial_generators_are_what_they_are_called(model, motion):
    made = trials.trivial(model, motion, 40, seeded())
    moved = {name: trials.physics(m)["speed, m/s"] for name, m in made.items()}
    assert list(made) == ["a pose held", "two averaged", "Gaussian"]
    assert moved["a pose held"].abs().max() == 0 and moved["two averaged"].min() > 0
    rows = model.encode(replace(made["Gaussian"], contacts=torch.zeros(40, 16, 9)))[..., model.layout.slices["root"]]
    truth = model.encode(motion)[..., model.layout.slices["root"]]
    assert rows.square().mean() == pytest.approx(truth.square().mean().item(), rel=0.5)


def test_physics_finds_sliding_and_quiet(motion):
    calm = trials.physics(motion)
    drift = torch.linspace(0, 1.0, motion.frames)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    slid = trials.physics(replace(motion, root=motion.root + drift))
    assert slid["skating, %"].mean() > calm["skating, %"].mean() + 20
    name = "slide in contact, mm/frame"
    assert slid[name].nanmean() > calm[name].nanmean() + 20
    assert torch.allclose(slid["acceleration, m/s^2"], calm["acceleration, m/s^2"], atol=1e-2)
    assert "slide in contact, mm/frame" not in trials.physics(replace(motion, contacts=None))


def test_distances_know_same_from_other(generator):
    x, y = torch.randn(200, 6, generator=generator), torch.randn(200, 6, generator=generator)
    same, other = trials.distances(x, y, generator), trials.distances(y + 3, x, generator)
    assert same["KID"] < 0.1 < other["KID"] and same["precision"] > 0.6 > 0.2 > other["precision"]
    narrow = trials.distances(0.1 * x, y, generator)
    assert narrow["recall"] < 0.3 and narrow["diversity"] == pytest.approx(0.1 * same["diversity"], rel=1e-5)
    assert trials.to_others(x).mean() == pytest.approx(same["diversity"], rel=1e-5)


@pytest.mark.parametrize("kind", trials.KINDS)
def test_inpainting_keeps_what_is_known(model, motion, kind):
    found = trials.inpainted(model, motion, kind, seeded(1), samples=2, steps=4)
    assert found["known"].max() < 1e-6 and found["known, unconditional"].median() > 0.1
    assert all(x.shape == (24,) and x.isfinite().all() for x in found.values())
    assert found["unconditional sample"].mean() > found["training mean"].mean()


def test_stopped_keeps_two_sets_of_weights(data, motion):
    recipe = Recipe(size="tiny", frames=16, noising=20, steps=6, batch=4)
    models, curve = trials.stopped(recipe, data, motion, every=2, judged=16, steps=3)
    assert [row["step"] for row in curve] == [2, 4, 6] and all("kid" in row for row in curve)
    best = min(curve, key=lambda row: row["kid"])["step"]
    same = all(torch.equal(a, b) for a, b in zip(*(m.denoiser.parameters() for m in models.values()), strict=True))
    assert same == (best == 6)


def test_rests_walk_less_and_are_measured_as_samples_are(motion):
    recipe = Recipe(size="tiny", frames=16, spectral=True, noising=100, contacts=True)
    torch.manual_seed(0)
    normaliser = Normaliser.measure(recipe.layout.encode(motion), recipe.layout)
    network = recipe.denoiser().eval().requires_grad_(False)
    made = Trained(network, recipe.schedule, recipe.layout, normaliser, recipe)
    network.spectrum.copy_(power(made.encode(motion)))
    rows = trials.rests(made, motion, (0.5, 0.0, 0.5), 4, seeded(), steps=10)
    assert [row["not walked"] for row in rows] == [0.5, 0.0, 0.5]
    assert rows[0] == rows[2] != rows[1], "the same noise each"
    alone = trials.physics(planted(made.sample(4, seeded(), steps=10), slow=False))
    real = trials.physics(motion)
    for what, key in (("skating", "skating, %"), ("acceleration", "acceleration, m/s^2")):
        assert rows[1][what] == pytest.approx((alone[key].mean() / real[key].mean()).item())
    assert rows[0]["acceleration"] < rows[1]["acceleration"], "what is not walked cannot tremble"
