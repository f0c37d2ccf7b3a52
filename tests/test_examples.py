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


def example_walk(seed: int = 6) -> Motion:
    """Somebody of standard size who walks for four seconds, turns to the right, stops and waves."""
    score = Score(SUBJECTS[0], torch.Generator().manual_seed(seed))
    WRITERS["walk"](score, seconds=3.6, speed=1.25, turn=-1.1)
    WRITERS["wave"](score, times=2)
    return perform(score, fps=30.0).motion


def apart(a: Motion, b: Motion) -> float:
    """The largest distance between joints of one name, metres."""
    frames = min(a.frames, b.frames)
    return float(
        (a.cut(0, frames).positions[:, a.skeleton.indices(b.skeleton.names)] - b.positions[:frames]).abs().max()
    )


def test_the_walk_that_ships_is_what_is_performed():
    kept, made = io.load(WALK), example_walk()
    assert (kept.frames, kept.fps) == (made.frames, made.fps) == (197, 30)
    assert apart(made, kept) < 1e-5 and WALK.stat().st_size < 300_000
    assert apart(example_walk(seed=7), kept) > 0.1  # control


if __name__ == "__main__":
    bvh.save(WALK, example_walk())
