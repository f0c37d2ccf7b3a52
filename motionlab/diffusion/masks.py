"""Masks of known parts of a window, as a model that takes them is trained on.

Source: CondMDI (Cohan et al. 2024), random frames x random joints; the test cases of thesis 4.2.1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from motionlab.diffusion.features import Layout
from motionlab.skeleton import STANDARD

_EDGE = 5  # known frames on either side of what lies between
_APART = (4, 45)  # frames from one lone key to the next
LEGS = ("hip", "knee", "ankle", "foot")


def units(layout: Layout) -> Tensor:
    """Computes the joint that each number of a frame (D,) belongs to; J: the root's place, J + 1: contacts."""
    joints = len(layout.skeleton)
    each, root = torch.arange(joints).repeat_interleave(6), torch.full((3,), joints)
    owners = {"root": root, "orient": each[:6], "pose": each[6:], "root_vel": root, "rot_vel": each}
    owners["contacts"] = torch.full((len(layout.skeleton.contact_names),), joints + 1)
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
    if not kinds or set(kinds) - set(_MAKE) or not all(odds > 0 for odds in kinds.values()):
        raise ValueError(f"kinds: expected odds above 0 for some of {', '.join(_MAKE)}, got {dict(kinds)}")
    chosen = torch.multinomial(torch.tensor(list(kinds.values())), count, replacement=True, generator=generator)
    size, names = len(STANDARD) + 2, list(kinds)
    found = [_MAKE[names[kind]](frames, size, generator) for kind in chosen.tolist()]
    return torch.stack([mask.expand(frames, size).bool() for mask in found])


def _nothing(frames: int, size: int, generator: torch.Generator) -> Tensor:
    return torch.zeros(1, 1)


def _frames(frames: int, size: int, generator: torch.Generator) -> Tensor:
    return torch.rand(frames, 1, generator=generator) < torch.rand(1, generator=generator)


def _gap(frames: int, size: int, generator: torch.Generator) -> Tensor:
    length = int(torch.randint(1, max(frames, 2), (), generator=generator))  # at least a frame stays known
    start = int(torch.randint(frames - min(length, frames) + 1, (), generator=generator))
    time = torch.arange(frames)[:, None]
    return (time < start) | (time >= start + length)


def _between(frames: int, size: int, generator: torch.Generator) -> Tensor:
    inside = _gap(max(frames - 2 * _EDGE, 1), size, generator)
    edge = torch.ones((frames - len(inside)) // 2, 1, dtype=torch.bool)
    return torch.cat((edge, inside, torch.ones(frames - len(edge) - len(inside), 1, dtype=torch.bool)))


def _onward(frames: int, size: int, generator: torch.Generator) -> Tensor:
    return torch.arange(frames)[:, None] < int(torch.randint(1, max(frames, 2), (), generator=generator))


def _keys(frames: int, size: int, generator: torch.Generator) -> Tensor:
    apart = int(torch.randint(_APART[0], _APART[1] + 1, (), generator=generator))
    first = int(torch.randint(min(apart, frames), (), generator=generator))
    return (torch.arange(frames)[:, None] - first) % apart == 0


def _joints(frames: int, size: int, generator: torch.Generator) -> Tensor:
    known = torch.rand(1, size, generator=generator) < torch.rand(1, generator=generator)
    known[:, -1] = False
    return known


def _entries(frames: int, size: int, generator: torch.Generator) -> Tensor:
    known = torch.rand(frames, size, generator=generator) < torch.rand(1, generator=generator)
    known[:, -1] = False
    return known


def _legs(frames: int, size: int, generator: torch.Generator) -> Tensor:
    known = torch.ones(1, size, dtype=torch.bool)
    known[:, [j for j, name in enumerate(STANDARD.names) if name.endswith(LEGS)]] = False
    known[:, -2] = torch.rand((), generator=generator) < 0.5
    known[:, -1] = False
    return known


_MAKE: dict[str, Callable[[int, int, torch.Generator], Tensor]] = {
    "nothing": _nothing, "frames": _frames, "gap": _gap, "between": _between, "onward": _onward, "keys": _keys,
    "joints": _joints, "entries": _entries, "legs": _legs,
}  # fmt: skip
