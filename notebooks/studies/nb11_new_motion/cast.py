"""The motion that generated motion is held against: people nobody trained on, training people, validation people."""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from data_synth import corpus as synthetic
from motionlab import splits
from motionlab.bench import person_windows
from motionlab.corpus import Take
from motionlab.diffusion.windows import Windows, gather, on_standard
from motionlab.motion import Motion
from studies.shared.clips import recorded

FRAMES = 60  # of a window, two seconds
RECORDED, SYNTHETIC = "recordings", "synthetic"


class Cast(NamedTuple):
    """source: RECORDED or SYNTHETIC. people (N, T): as many windows of each test person, whose (N,). val
    (M, T): of those that settings are chosen on. library: all training motion on the standard body. learnt: its
    windows, drawn evenly by person."""

    source: str
    people: Motion
    whose: Tensor
    val: Motion
    library: list[Motion]
    learnt: Windows

    def training(self, count: int, generator: torch.Generator) -> Motion:
        """Draws training windows (count, T), evenly by person, on the standard body."""
        motion = self.learnt.draw(count, generator)
        return Motion(self.people.skeleton, motion.root, motion.rot, motion.fps)


def assemble(folder: Path | None, each: int, most: int | None) -> Cast:
    """Reads the parts; without a folder synthetic motion, whose clips stand for people.

    each: windows of a person. most: recordings of a part, evenly over it; None: all.
    """
    found = recorded(folder) if folder else None
    parts = {part: found.part(part) if found else _made(part) for part in ("train", "val", "test")}
    takes = {part: splits.subsample(some, most) for part, some in parts.items()}
    people, whose, _ = person_windows(takes["test"], FRAMES, each)
    library = [on_standard(take.motion) for take in takes["train"]]
    learnt = gather(library, FRAMES, mirrored=False, people=[take.person for take in takes["train"]])
    val = person_windows(takes["val"], FRAMES, each).motion
    return Cast(RECORDED if folder else SYNTHETIC, people, whose, val, library, learnt)


def _made(part: str) -> list[Take]:
    made = synthetic.build(version="B")
    sequences = {"train": made.train, "val": made.heldout_sequences, "test": made.heldout_subject}[part]
    return [Take(s.motion, s.motion.name, SYNTHETIC, s.motion.name, "", s.motion.fps, ()) for s in sequences]
