"""The same clips for both chapters: who sees what, who takes how long."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.model import DenoiserRecipe, Trained
from motionlab.diffusion.repair import Way
from motionlab.diffusion.windows import gather, on_standard
from motionlab.humor.testops import Schedule
from motionlab.skeleton import STANDARD
from studies.nb15_evaluation import chapters_compared
from studies.shared import cases
from studies.shared.rivals import Rivals

QUICK = Schedule(steps=(1, 2, 1), inner=4, refine=(1, 1))


@pytest.fixture(scope="module")
def windows():
    motion = on_standard(perform_sequence(Corpus(seconds=20.0, seed=3), 0).motion)
    return replace(gather([motion], 24).evenly(60), skeleton=STANDARD)


@pytest.fixture(scope="module")
def clips(windows):
    return windows.clip(slice(10, 12))


@pytest.fixture(scope="module")
def fitted(clips, kit):
    seen = chapters_compared.above_the_knees(clips, 0.01, torch.Generator().manual_seed(0))
    return chapters_compared.optimised(seen, kit, QUICK)


@pytest.fixture
def model(windows):
    """A model that says zero, the mean, whatever it is shown."""
    recipe = DenoiserRecipe(frames=24, noising=20)
    network = torch.nn.Module()
    network.forward = lambda x, stamps: 0 * x
    rows = recipe.layout.encode(windows)
    return Trained(network, recipe.schedule, recipe.layout, Normaliser.measure(rows, recipe.layout), recipe)


def test_nobody_reads_the_legs_of_the_estimate(fitted, model, windows, generator):
    """Other legs in stage 2's estimate, the same result."""
    rivals = Rivals.fit(windows, generator, parts=16)
    start = chapters_compared.known_above(fitted.stages[2])
    rot = start.rot.clone()
    rot[..., STANDARD.indices(cases.HIDDEN), :, :] = torch.eye(3)
    other = replace(start, rot=rot)
    for make in (
        lambda: chapters_compared.by_diffusion(model, Way(steps=4), torch.Generator().manual_seed(1)),
        lambda: chapters_compared.by_rival(rivals, "regression"),
        lambda: chapters_compared.by_rival(rivals, "nearest"),
    ):
        assert torch.allclose(make()(start).positions, make()(other).positions, atol=1e-5)
