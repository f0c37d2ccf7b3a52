"""Who is filled in: windows of validation people (for settings) and of test people, and what rivals learn from.

Without recordings, the sequences of the synthetic subject whom nobody trained on stand for people.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from data_synth import corpus as synthetic
from motionlab import splits
from motionlab.bench import PersonWindows, person_windows
from motionlab.contact import with_contacts
from motionlab.corpus import Take
from motionlab.diffusion.windows import gather, on_standard
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD
from motionlab.training.courses import learnt_from
from studies.shared.clips import recorded

FRAMES = 60  # of a window
_SHORT = 8.0  # seconds of a synthetic sequence that count as one recording


@dataclass(frozen=True, eq=False)
class Cast:
    """val, test: windows of validation and of test people. takes: of both, by part. learnt (N, T):
    windows of the training people, of the clips (N,)."""

    val: PersonWindows
    test: PersonWindows
    takes: dict[str, list[Take]]
    learnt: Motion
    clips: Tensor

    @classmethod
    def of(cls, folder: Path | str | None, each: int, val: int, library: int, generator: torch.Generator) -> Self:
        """each, val: windows of each test person and of validation people. library: N."""
        if folder:
            found = recorded(folder)
            takes, data = {part: found.part(part) for part in ("val", "test")}, learnt_from(folder, FRAMES)[0]
        else:
            made = synthetic.build(version="B")
            takes = {"val": _cut(made.heldout_sequences), "test": _cut(made.heldout_subject)}
            data = gather([on_standard(s.motion) for s in made.train], FRAMES)
        windows = {part: person_windows(takes[part], FRAMES, n) for part, n in (("val", val), ("test", each))}
        learnt, clips = data.drawn(library, generator)
        return cls(windows["val"], windows["test"], takes, replace(learnt, skeleton=STANDARD), clips)


def _cut(sequences: Sequence[synthetic.Sequence]) -> list[Take]:
    """Stretches of synthetic sequences, each as one recording of another action."""
    found, frames = [], round(_SHORT * 30)
    for s in sequences:
        for at in range(0, s.motion.frames - frames + 1, frames):
            part = with_contacts(s.motion.cut(at, at + frames))
            found.append(Take(part, f"{s.name} {at}", splits.SYNTHETIC, s.name, f"from {at}", 30.0, ()))
    return found


def some(windows: PersonWindows, each: int) -> Tensor:
    """Rows of at most so many windows of every person, evenly."""
    mine = [(windows.whose == person).nonzero()[:, 0] for person in windows.whose.unique()]
    return torch.cat([m[torch.linspace(0, len(m) - 1, min(each, len(m))).round().long()] for m in mine])


def only(windows: PersonWindows, rows: Tensor) -> PersonWindows:
    """These windows alone."""
    return PersonWindows(windows.motion.clip(rows), windows.whose[rows], windows.lacks[rows])
