"""What the diffusion models train on, are chosen by, and are reported on: three parts that share no recording.

Every motion is on the standard body, 30 fps. Source: thesis 4.1.2, "Data": "several motion sequences are held out".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from data_synth import corpus
from motionlab import library
from motionlab.diffusion.trained import Recipe
from motionlab.diffusion.windows import gather, on_standard
from motionlab.frames import fix_root_horizontally
from motionlab.humor import variety
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

PARTS = ("train", "choose", "report")
SYNTHETIC, RECORDED = "synthetic", "recordings"


def sources(folder: Path | str | None, part: str, *, most: int | None = None) -> dict[str, list[Motion]]:
    """Motions (T,) by source, as they were made or recorded.

    train: all but the held-out sequences, and four of five recordings of each source. choose: other sequences of the
    same subjects, and every second held-out recording; what chooses a checkpoint. report: a subject, and recordings,
    that nothing was trained on or chosen by.

    Args:
        folder: of recordings (``MOTIONLAB_DATA``), or None. most: so many motions of a source, evenly over it.

    Raises:
        ValueError: no such part.
    """
    if part not in PARTS:
        raise ValueError(f"part: expected one of {', '.join(PARTS)}, got {part!r}")
    made = corpus.build(version="B")
    sequences = {"train": made.train, "choose": made.heldout_sequences, "report": made.heldout_subject}[part]
    found = {SYNTHETIC: library.spread([s.motion for s in sequences], most)}
    used, left = library.trainable(folder)
    if used:
        recorded = {"train": used, "choose": left[::2], "report": left[1::2]}[part]
        found[RECORDED] = library.spread(recorded, most)
    return found


def prepared(motions: Sequence[Motion], recipe: Recipe, *, copies: int = 0) -> list[Motion]:
    """On the standard body, of the recipe's version of the data, each with so many copies held otherwise."""
    generator, found = torch.Generator().manual_seed(recipe.seed), []
    for motion in map(on_standard, motions):
        for each in (motion, *(variety.held_otherwise(motion, generator) for _ in range(copies))):
            found.append(fix_root_horizontally(each) if recipe.version == "A" else each)
    return found


def tested(
    recipe: Recipe, folder: Path | str | None, part: str, count: int, *, most: int | None = None
) -> dict[str, Motion]:
    """Windows (at most ``count``, T) by source, evenly over a part: the same at every call.

    In the form of the recipe's data; all have one body, so their skeleton has no window axis.
    """
    found = {}
    for source, motions in sources(folder, part, most=most).items():
        cut = gather(prepared(motions, recipe), recipe.frames).evenly(count)
        found[source] = replace(cut, skeleton=STANDARD)
    return found
