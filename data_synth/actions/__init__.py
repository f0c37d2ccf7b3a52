"""What people do. Each action writes a score; ``ACTIONS`` holds them as functions that return a Take.

    walk(subject, generator, *, fps=30.0, seconds=4.0, speed=None, ...) -> Take

Every action begins and ends standing at ease, wherever and whichever way the body then faces.
"""

from collections.abc import Callable
from functools import partial

import torch

from data_synth.actions import dance, floor, locomotion, seat, standing
from data_synth.perform import Take, perform
from data_synth.score import Score
from data_synth.subjects import Subject

#: The writers by name: each continues a Score.
WRITERS: dict[str, Callable[..., None]] = {write.__name__: write for write in (
    locomotion.walk, locomotion.run, locomotion.turn, standing.idle, standing.reach, standing.wave, standing.punch,
    standing.kick, seat.sit, seat.crouch, seat.jump, dance.dance, floor.floor,
)}  # fmt: skip


def _performed(
    write: Callable[..., None], subject: Subject, generator: torch.Generator, *, fps: float = 30.0, **options
) -> Take:
    score = Score(subject, generator)
    write(score, **options)
    return perform(score, fps)


#: name -> function(subject, generator, *, fps=30.0, **options) -> Take.
ACTIONS: dict[str, Callable[..., Take]] = {name: partial(_performed, write) for name, write in WRITERS.items()}
walk = ACTIONS["walk"]
