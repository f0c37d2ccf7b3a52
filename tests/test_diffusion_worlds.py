"""Measures that tell root and body apart, on motion whose answer is known."""

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


def made_of(layout, motion, answer):
    """A model whose guess of x_0 is ``answer(x_t)``."""
    network = torch.nn.Module()
    network.forward = lambda x, stamps: answer(x)
    rows = layout.encode(motion)
    return Trained(network, cosine(100), layout, Normaliser.measure(rows, layout), DenoiserRecipe(frame=layout.frame))


# ------------------------------------------------------------------------------------------ place and heading


def test_stuck_rows_do_not_know_the_place_and_world_rows_do(clips, generator):
    clips = clips.to(torch.float64)
    there = frames.moved(clips, frames.somewhere(len(clips.root), 10.0, generator))
    change = [(Layout(frame).encode(there) - Layout(frame).encode(clips)).abs().amax() for frame in ("stuck", "world")]
    assert change[0] < 1e-10 and change[1] > 1.0


# -------------------------------------------------------------------------------------------- root and body together
def test_real_roots_go_where_the_legs_push_them_and_shuffled_ones_do_not(clips, generator):
    other = frames.shuffled(clips, generator)
    true, false = frames.driven(clips), frames.driven(other)
    assert true.nanmean() > 0.9 > 0.5 > false.nanmean()
    assert frames.correlated(clips, 20).min() > 0.8
    found = {name: frames.belongs(m) for name, m in (("true", clips), ("false", other))}
    assert found["true"]["skate"].mean() < found["false"]["skate"].mean()
    assert found["true"]["slide"].nanmean() < found["false"]["slide"].nanmean() / 4


# ------------------------------------------------------------------------------------------------------- one guess
def test_noise_turns_with_the_window(clips, generator):
    """x_t of a moved window is the moved x_t, but for the columns' means, which both lose here."""
    layout = Layout("world")
    model = made_of(layout, clips, lambda x: x)
    model = replace(model, normaliser=Normaliser(torch.zeros_like(model.normaliser.mean), model.normaliser.scale))
    noise = frames.noise_for(model, clips, generator)
    move = frames.away(len(clips.root), 0.0, generator)  # no shift, so that fading to the origin is the same
    move = replace(frames.somewhere(len(clips.root), 0.0, generator), shift=move.shift)
    here = frames.guess(model, clips, 0.3, noise)
    there = frames.guess(model, frames.moved(clips, move), 0.3, frames.turned_noise(noise, move, layout))
    assert frames.apart(frames.moved_back(there, move), here).max() < 1e-4
    unturned = frames.guess(model, frames.moved(clips, move), 0.3, noise)
    assert frames.apart(frames.moved_back(unturned, move), here).mean() > 0.01
