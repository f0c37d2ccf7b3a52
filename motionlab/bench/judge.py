"""Judges whoever completes motions, on windows of people: cases, errors by person, the energy score of draws.

    windows = people("recordings", "val")
    judged(lambda motion, known: mine(motion, known), CASES["legs hidden"], windows)["cm"].mean()

Source: thesis 4.2.1 (cases). Gneiting and Raftery 2007, Eq. 22: the energy score, which rewards calibrated draws, as
the error of a single answer cannot.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from motionlab import corpus, splits
from motionlab.bench import cases
from motionlab.bench.cases import PersonWindows, by_person, person_windows
from motionlab.motion import Motion

FRAMES = 60  # of a window
#: Windows (B, T) and what is known of them (B, T, U) -> windows; only what is known may be read, and where a window
#: begins and faces.
Fill = Callable[[Motion, Tensor], Motion]


@dataclass(frozen=True)
class Case:
    """A mask for so many windows, the joints whose error counts (None: all), and whether it has edges in time."""

    mask: Callable[[int], Tensor]
    joints: tuple[str, ...] | None = None
    edges: bool = False


def _joints(count: int, share: float) -> Tensor:
    return cases.whole_window(count, FRAMES, share, torch.Generator().manual_seed(7))


CASES: Mapping[str, Case] = {
    "legs hidden": Case(lambda n: cases.legs(n, FRAMES), cases.LOWER),
    "gap of 30 frames": Case(lambda n: cases.gap(n, FRAMES, 30), edges=True),
    "gap of 45 frames": Case(lambda n: cases.gap(n, FRAMES, 45), edges=True),
    "every 15th frame": Case(lambda n: cases.keys(n, FRAMES, 15), edges=True),
    "half of the joints": Case(partial(_joints, share=0.5)),
    "a quarter of the joints": Case(partial(_joints, share=0.25)),
}


def people(folder: Path | str, part: str, each: int = 24) -> PersonWindows:
    """Reads windows of the people of a part ("train", "val", "test"), at most so many of each."""
    return person_windows(corpus.assemble(folder, splits.real_sources(folder)).part(part), FRAMES, each)


def judged(
    fill: Fill, case: Case, windows: PersonWindows, *, show_missing: bool = False, draws: int = 1
) -> dict[str, Tensor]:
    """Computes by person (P,) what becomes of the windows: error in cm, sliding in mm a frame, acceleration over the
    truth's; in the mean over so many draws, and of several also their energy score and how far apart they are, in cm.

    Nobody is asked for a joint that a figure lacks: it stays as it came. show_missing: who fills in is told of it.
    """
    motion, whose, lacks = windows
    known = case.mask(len(motion.root))
    told = known if show_missing else known & ~lacks
    made = [cases.restore_known(fill(motion, told), motion, known | lacks) for _ in range(draws)]
    rows = {
        "cm": [cases.error_cm(m, motion, known, case.joints) for m in made],
        "slide": [cases.slide_mm(m, motion) for m in made],
        "acceleration": [cases.acceleration_ratio(m, motion) for m in made],
    }
    found = {name: torch.stack(each).mean(0) for name, each in rows.items()}
    if draws > 1:
        found["score"] = energy_score(made, motion, known, case.joints)
        found["spread"] = 2 * (found["cm"] - found["score"])
    return {name: by_person(x, whose) for name, x in found.items()}


def energy_score(
    draws: Sequence[Motion], truth: Motion, known: Tensor, joints: tuple[str, ...] | None = None
) -> Tensor:
    """Computes the energy score (B,) in cm of several draws of windows: their mean error less half of their mean
    distance from each other. Of a single answer it is the error; less is better."""
    errors = torch.stack([cases.error_cm(made, truth, known, joints) for made in draws]).mean(0)
    if len(draws) == 1:
        return errors
    pairs = [(a, b) for k, a in enumerate(draws) for b in draws[:k]]
    apart = torch.stack([cases.error_cm(a, b, known, joints) for a, b in pairs]).mean(0)
    return errors - apart / 2
