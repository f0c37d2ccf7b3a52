"""Noise that goes along where notebook 12 puts a window: without it the world's rows would be compared unfairly."""

from dataclasses import replace

import pytest
import torch

from data_synth.corpus import Recipe as Corpus
from data_synth.corpus import perform_sequence
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.model import DenoiserRecipe, Trained
from motionlab.diffusion.sampling import cosine
from motionlab.diffusion.windows import gather, on_standard
from motionlab.skeleton import STANDARD
from studies.nb12_worlds import frames


@pytest.fixture(scope="module")
def clips():
    """Windows (40, 40) of one walking, stopping and turning person."""
    motion = on_standard(perform_sequence(Corpus(seconds=40.0, seed=3), 0).motion)
    return replace(gather([motion], 40).evenly(40), skeleton=STANDARD)


def test_noise_turns_with_the_window(clips, generator):
    """x_t of a moved window is the moved x_t, but for the columns' means, which both lose here."""
    layout = Layout("world")
    network = torch.nn.Module()
    network.forward = lambda x, stamps: x
    normaliser = Normaliser.measure(layout.encode(clips), layout)
    normaliser = replace(normaliser, mean=torch.zeros_like(normaliser.mean))
    model = Trained(network, cosine(100), layout, normaliser, DenoiserRecipe(frame="world"))
    noise = frames.noise_for(model, clips, generator)
    move = frames.away(len(clips.root), 0.0, generator)  # no shift, so that fading to the origin is the same
    move = replace(frames.somewhere(len(clips.root), 0.0, generator), shift=move.shift)
    here = frames.guess(model, clips, 0.3, noise)
    there = frames.guess(model, frames.moved(clips, move), 0.3, frames.turned_noise(noise, move, layout))
    assert frames.apart(frames.moved_back(there, move), here).max() < 1e-4
    unturned = frames.guess(model, frames.moved(clips, move), 0.3, noise)
    assert frames.apart(frames.moved_back(unturned, move), here).mean() > 0.01
