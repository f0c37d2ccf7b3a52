"""What notebook 10 measures is what it says: known truths, and controls that must come out worse."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion import denoiser
from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.model import DenoiserRecipe, Trained, silenced
from motionlab.diffusion.spectral import power
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import ShapeError
from motionlab.skeleton import STANDARD
from studies.nb10_diffusion import trials

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
    recipe = DenoiserRecipe(size="tiny", frames=16, spectral=True, noising=100)
    torch.manual_seed(0)
    network = recipe.denoiser().eval().requires_grad_(False)
    normaliser = Normaliser.measure(recipe.layout.encode(motion), recipe.layout)
    made = Trained(network, recipe.schedule, recipe.layout, normaliser, recipe)
    network.spectrum.copy_(power(made.encode(motion)))
    return made


def seeded(n=0):
    return torch.Generator().manual_seed(n)


def test_the_filter_is_what_a_silenced_network_leaves(model, motion):
    silent = silenced(model)
    found = trials.guesses(silent, motion, seeded(), (0.0, 0.2, 1.0))["x0"].mean(0)
    assert 5 * found[0] < found[1] < found[2] / 5 and found[2] == pytest.approx(1.0, abs=0.1)
    loud = deepcopy(model)  # a network that has something to say
    loud.denoiser.network.output_process.poseFinal.bias += 0.5
    said = trials.guesses(loud, motion, seeded(), (0.0, 0.2, 1.0))["x0"].mean(0)
    quiet = trials.guesses(silenced(loud), motion, seeded(), (0.0, 0.2, 1.0))["x0"].mean(0)
    assert (said[1:] > 1.01 * found[1:]).all() and torch.equal(quiet, found)
    plain = replace(model, denoiser=denoiser.Denoiser(model.layout.size, **TINY))
    with pytest.raises(ShapeError):
        silenced(plain)


@pytest.mark.parametrize("kind", trials.KINDS)
def test_inpainting_keeps_what_is_known(model, motion, kind):
    found = trials.inpainted(model, motion, kind, seeded(1), samples=2, steps=4)
    assert found["known"].max() < 1e-6 and found["known, unconditional"].median() > 0.1
    assert all(x.shape == (24,) and x.isfinite().all() for x in found.values())
    assert found["unconditional sample"].mean() > found["training mean"].mean()
