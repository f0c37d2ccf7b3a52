"""Masks of known parts of a window, as a model that takes them is trained on.

Source: CondMDI (Cohan et al. 2024), random frames x random joints; the test cases of thesis 4.2.1.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import pad

from motionlab.diffusion.features import Layout
from motionlab.skeleton import STANDARD

_EDGE = 5  # known frames on either side of what lies between
_APART = (4, 45)  # frames from one lone key to the next
_KINDS = ("nothing", "frames", "gap", "between", "onward", "keys", "joints", "entries", "legs")
LEGS = ("hip", "knee", "ankle", "foot")


def units(layout: Layout) -> Tensor:
    """Computes the joint that each number of a frame (D,) belongs to; J: the root's place, J + 1: contacts."""
    joints = len(STANDARD)
    each, root = torch.arange(joints).repeat_interleave(6), torch.full((3,), joints)
    owners = {"root": root, "orient": each[:6], "pose": each[6:], "root_vel": root, "rot_vel": each}
    owners["contacts"] = torch.full((len(STANDARD.contact_names),), joints + 1)
    return torch.cat([owners[name] for name in layout.slices])


def draw_units(frames: int, count: int, generator: torch.Generator, kinds: Mapping[str, float]) -> Tensor:
    """Draws masks (count, frames, U) over the units of a frame, bool, True where known; each window's kind is drawn by
    its odds.

    nothing: all is unknown. frames: whole frames, each by the window's own chance. gap: all but a run of frames, which
    may reach either end; between: which has ``_EDGE`` known frames or more on either side, in windows that are longer.
    onward: all behind some first frames. keys: lone frames, as far apart as animators' keys. joints: some joints, in
    all frames. entries: other joints in every frame. legs: all but both legs, with or without the root's place.
    Contacts are known with whole frames only.

    Raises:
        ValueError: an unknown kind, or odds that are not positive.
    """
    if not kinds or set(kinds) - set(_KINDS) or not all(odds > 0 for odds in kinds.values()):
        raise ValueError(f"kinds: expected odds above 0 for some of {', '.join(_KINDS)}, got {dict(kinds)}")
    chosen = torch.multinomial(torch.tensor(list(kinds.values())), count, replacement=True, generator=generator)
    names = list(kinds)
    found = [_drawn(names[kind], frames, generator) for kind in chosen.tolist()]
    return torch.stack([mask.expand(frames, len(STANDARD) + 2).bool() for mask in found])


def _drawn(kind: str, frames: int, generator: torch.Generator) -> Tensor:
    """A mask (frames or 1, U or 1) of one kind."""

    def number(low: int, high: int) -> int:
        return int(torch.randint(low, high, (), generator=generator))

    def chance(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    size, time = len(STANDARD) + 2, torch.arange(frames)[:, None]
    if kind == "nothing":
        return torch.zeros(1, 1)
    if kind == "frames":
        return chance(frames, 1) < chance(1)
    if kind == "gap":
        length = number(1, max(frames, 2))  # at least a frame stays known
        start = number(0, frames - min(length, frames) + 1)
        return (time < start) | (time >= start + length)
    if kind == "between":
        inside = _drawn("gap", max(frames - 2 * _EDGE, 1), generator)
        before = (frames - len(inside)) // 2
        return pad(inside, (0, 0, before, frames - before - len(inside)), value=True)
    if kind == "onward":
        return time < number(1, max(frames, 2))
    if kind == "keys":
        apart = number(_APART[0], _APART[1] + 1)
        return (time - number(0, min(apart, frames))) % apart == 0
    if kind == "legs":
        known = torch.ones(1, size, dtype=torch.bool)
        known[:, [j for j, name in enumerate(STANDARD.names) if name.endswith(LEGS)]] = False
        known[:, -2] = chance() < 0.5
    else:
        known = chance(1 if kind == "joints" else frames, size) < chance(1)
    known[:, -1] = False
    return known
