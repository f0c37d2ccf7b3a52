"""Windows of motion that was recorded of people: the same number of each person, who is in which, and what it lacks."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from motionlab.corpus import Take
from motionlab.diffusion.windows import gather, on_standard
from motionlab.errors import DataError
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD


class PersonWindows(NamedTuple):
    """motion (N, T) on the standard body, whose it is (N,), and which units (N, 1, U) of a frame its figure lacks."""

    motion: Motion
    whose: Tensor
    lacks: Tensor


def person_windows(takes: Sequence[Take], frames: int, each: int) -> PersonWindows:
    """At most ``each`` windows of every person, evenly over what there is; shorter takes are left out."""
    people: dict[str, list[Take]] = {}
    for take in takes:
        if take.motion.frames >= frames:
            people.setdefault(take.person, []).append(take)
    rows, whose, lacks = [], [], []
    for person, some in enumerate(people.values()):
        data = gather([on_standard(t.motion) for t in some], frames, mirrored=False)
        at = torch.linspace(0, len(data.begins) - 1, min(each, len(data.begins))).round().long()
        rows.append(data.evenly(each))
        whose.append(torch.full((len(at),), person))
        units = [[name in take.missing for name in STANDARD.names] + [False, False] for take in some]
        lacks.append(torch.tensor(units)[data.clip[data.begins[at]]])
    if not rows:
        raise DataError(f"nobody has {frames} frames of motion", remedy="name a folder with more recordings")
    parts = [torch.cat([getattr(m, name) for m in rows]) for name in ("root", "rot", "contacts")]
    return PersonWindows(
        Motion(STANDARD, *parts[:2], rows[0].fps, parts[2]), torch.cat(whose), torch.cat(lacks)[:, None]
    )


def by_person(values: Tensor, whose: Tensor) -> Tensor:
    """The mean (P,) of values (N,) of each person; windows without a value do not count."""
    mine = one_hot(whose).double() * values.isfinite()[:, None]
    return (mine * values.nan_to_num().double()[:, None]).sum(0) / mine.sum(0)
