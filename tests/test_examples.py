"""The walk that ships is the one performed here; ``python -m tests.test_examples`` writes it again."""

import torch

from data_synth.actions import WRITERS
from data_synth.perform import perform
from data_synth.score import Score
from data_synth.subjects import SUBJECTS
from motionlab import io
from motionlab.examples import WALK
from motionlab.io import bvh
from motionlab.motion import Motion


def example_walk() -> Motion:
    """Somebody of standard size who walks for four seconds, turns to the right, stops and waves."""
    score = Score(SUBJECTS[0], torch.Generator().manual_seed(6))
    WRITERS["walk"](score, seconds=3.6, speed=1.25, turn=-1.1)
    WRITERS["wave"](score, times=2)
    return perform(score, fps=30.0).motion


def test_the_walk_that_ships_is_what_is_performed():
    kept, made = io.load(WALK), example_walk()
    assert (kept.frames, kept.fps) == (made.frames, made.fps) == (197, 30) and WALK.stat().st_size < 300_000
    positions = made.positions[:, made.skeleton.indices(kept.skeleton.names)]
    assert (positions - kept.positions).abs().max() < 1e-5
    assert (positions[1:] - kept.positions[:-1]).abs().max() > 0.1  # control


if __name__ == "__main__":
    bvh.save(WALK, example_walk())
