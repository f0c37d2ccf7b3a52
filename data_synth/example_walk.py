"""The motion of ``motionlab/examples/walk.bvh``; ``python -m data_synth.example_walk`` writes that file again."""

from __future__ import annotations

import torch

from data_synth.actions import WRITERS
from data_synth.perform import perform
from data_synth.score import Score
from data_synth.subjects import SUBJECTS
from motionlab.examples import WALK
from motionlab.io import bvh
from motionlab.motion import Motion


def example_walk() -> Motion:
    """Somebody of standard size who walks for four seconds, turns to the right, stops and waves, at 30 fps."""
    score = Score(SUBJECTS[0], torch.Generator().manual_seed(6))
    WRITERS["walk"](score, seconds=3.6, speed=1.25, turn=-1.1)
    WRITERS["wave"](score, times=2)
    return perform(score, fps=30.0).motion


if __name__ == "__main__":
    bvh.save(WALK, example_walk())
