"""Noise on motion, and its removal by a model."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from motionlab import rotation
from motionlab.baselines import Noise
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.model import DenoiserRecipe, MotionDiffusion
from motionlab.diffusion.windows import gather, on_standard
from motionlab.skeleton import STANDARD
from studies.nb12_filling_in.noise import ReverseProcess, _begin, denoise

FRAMES = 20


@pytest.fixture(scope="module")
def motion(motions):
    """Six windows of 20 frames of somebody who walks about."""
    return replace(gather([on_standard(motions[0])], FRAMES).evenly(6), skeleton=STANDARD)


class Fixed(nn.Module):
    """An x_0 estimate that is given, or what it got, without the factor of its step."""

    def __init__(self, schedule, x0=None):
        super().__init__()
        self.schedule, self.x0, self.seen = schedule, x0, []
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, x, stamps):
        self.seen.append(int(stamps[0]))
        return self.x0 if self.x0 is not None else x / self.schedule.alpha_bar[stamps[0]].sqrt().to(x)


def model_of(motion, x0=None):
    recipe = DenoiserRecipe(frames=FRAMES)
    normaliser = Normaliser.measure(recipe.layout.encode(motion), recipe.layout)
    return MotionDiffusion(Fixed(recipe.schedule, x0), recipe.schedule, recipe.layout, normaliser, recipe)


def test_noise_has_the_size_it_says_and_lasts_as_long(motion, generator):
    long = replace(motion, root=motion.root.repeat(40, 1, 1), rot=motion.rot.repeat(40, 1, 1, 1, 1), contacts=None)
    noise = Noise.of(5, 2, lasting=0.9)
    noisy = noise.on(long, generator)
    angle = rotation.geodesic(noisy.rot, long.rot)
    assert angle.square().mean().sqrt().rad2deg() == pytest.approx(5 * 3**0.5, rel=0.02)
    shift = noisy.root - long.root
    assert shift.std() == pytest.approx(0.02, rel=0.05)
    assert (shift[:, 1:] * shift[:, :-1]).mean() / shift.square().mean() == pytest.approx(0.9, abs=0.02)
    fresh = Noise.of(5, 2).on(long, generator).root - long.root
    assert (fresh[:, 1:] * fresh[:, :-1]).mean() / fresh.square().mean() == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("size", [0.05, 0.3, 2.0])
def test_the_reverse_process_begins_where_it_is_as_noisy(size):
    schedule = DenoiserRecipe().schedule
    a = schedule.alpha_bar[_begin(schedule, size)]
    assert ((1 - a) / a).sqrt() == pytest.approx(size, rel=0.05)


@pytest.mark.parametrize("start", [ReverseProcess(), ReverseProcess(looks=3, level=2.0)])
def test_a_perfect_denoiser_gives_the_truth_from_the_step_it_should_start_at(motion, generator, start):
    noise, plain = Noise.of(5, 2), model_of(motion)
    model = model_of(motion, plain.encode(motion))
    made = denoise(model, noise.on(motion, generator), motion, noise, generator, start)
    assert (made.positions - motion.positions).abs().max() < 1e-4
    seen = model.denoiser.seen
    layout = Layout("world")
    noisy = layout.encode(replace(noise.on(motion, generator), contacts=motion.contacts))
    off = ((noisy - layout.encode(motion)) / model.normaliser.scale)[..., : layout.slices["contacts"].start]
    size = off.square().mean().sqrt().item()
    assert len(seen) == start.looks
    assert max(seen) == pytest.approx(_begin(model.schedule, start.level * size), abs=40)
