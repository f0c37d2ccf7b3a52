"""Short takes by the dozen, for experiments that need many people doing certain things."""

from collections.abc import Sequence

import torch

from data_synth.actions import ACTIONS
from data_synth.perform import Take
from data_synth.subjects import SUBJECTS, Subject


def draw(
    count: int, generator: torch.Generator, *, actions: Sequence[str] = tuple(ACTIONS),
    subjects: Sequence[Subject] = SUBJECTS, fps: float = 30.0, **options: object,
) -> list[Take]:  # fmt: skip
    """``count`` takes: the actions in turn, each by the next person, each with draws of its own.

    options go to every action and must fit each of them.

    Raises:
        KeyError: no such action; lists them.
    """
    for name in actions:
        if name not in ACTIONS:
            raise KeyError(f"no action {name!r}; actions are {', '.join(ACTIONS)}")
    takes = []
    for i in range(count):
        person = subjects[(i + i // len(actions)) % len(subjects)]
        seed = int(torch.randint(2**62, (), generator=generator))
        own = torch.Generator().manual_seed(seed)
        takes.append(ACTIONS[actions[i % len(actions)]](person, own, fps=fps, **options))
    return takes
