"""Short takes by the dozen, for experiments that need many people doing certain things."""

from collections.abc import Sequence

import torch

from data_synth.actions import ACTIONS
from data_synth.perform import Take
from data_synth.subjects import SUBJECTS


def draw(
    count: int, generator: torch.Generator, *, actions: Sequence[str] = tuple(ACTIONS), fps: float = 30.0
) -> list[Take]:
    """``count`` takes: the actions in turn, each by the next person, each with draws of its own."""
    takes = []
    for i in range(count):
        person = SUBJECTS[(i + i // len(actions)) % len(SUBJECTS)]
        own = torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator)))
        takes.append(ACTIONS[actions[i % len(actions)]](person, own, fps=fps))
    return takes
