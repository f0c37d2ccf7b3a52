"""Which parts of a window are known, at random: the questions that a model is trained on that is told what is known.

Source: CondMDI (Cohan et al. 2024), random frames x random joints; the test cases of thesis 4.2.1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from motionlab.diffusion.features import Layout

#: How often each kind is drawn.
KINDS = {"nothing": 0.15, "frames": 0.05, "gap": 0.25, "joints": 0.2, "entries": 0.05, "legs": 0.3}
LEGS = ("hip", "knee", "ankle", "foot")


def units(layout: Layout) -> Tensor:
    """(D,): what each number of a frame belongs to: a joint, then J: the root's place, J + 1: contacts."""
    joints = len(layout.skeleton)
    each, root = torch.arange(joints).repeat_interleave(6), torch.full((3,), joints)
    owners = {"root": root, "orient": each[:6], "pose": each[6:], "root_vel": root, "rot_vel": each}
    owners["contacts"] = torch.full((len(layout.skeleton.contact_names),), joints + 1)
    return torch.cat([owners[name] for name in layout.slices])


def draw(
    layout: Layout, frames: int, count: int, generator: torch.Generator, kinds: Mapping[str, float] = KINDS
) -> Tensor:
    """Masks (count, frames, D), bool, True where known; each window's kind is drawn by its odds.

    nothing: all is asked. frames: whole frames, each by the window's own chance. gap: all but one run of frames, which
    may reach either end. joints: some joints, in all frames. entries: other joints in every frame. legs: all but both
    legs, with or without the root's place. Contacts are known with whole frames only.

    Raises:
        ValueError: an unknown kind, or odds that are not positive.
    """
    if not kinds or set(kinds) - set(_MAKE) or not all(odds > 0 for odds in kinds.values()):
        raise ValueError(f"kinds: expected odds above 0 for some of {', '.join(_MAKE)}, got {dict(kinds)}")
    chosen = torch.multinomial(torch.tensor(list(kinds.values())), count, replacement=True, generator=generator)
    size, names = len(layout.skeleton) + 2, list(kinds)
    found = [_MAKE[names[kind]](layout, frames, size, generator) for kind in chosen.tolist()]
    return torch.stack([mask.expand(frames, size).bool() for mask in found])[..., units(layout)]


def _nothing(layout: Layout, frames: int, size: int, generator: torch.Generator) -> Tensor:
    return torch.zeros(1, 1)


def _frames(layout: Layout, frames: int, size: int, generator: torch.Generator) -> Tensor:
    return torch.rand(frames, 1, generator=generator) < torch.rand(1, generator=generator)


def _gap(layout: Layout, frames: int, size: int, generator: torch.Generator) -> Tensor:
    length = int(torch.randint(1, max(frames, 2), (), generator=generator))  # at least a frame stays known
    start = int(torch.randint(frames - min(length, frames) + 1, (), generator=generator))
    time = torch.arange(frames)[:, None]
    return (time < start) | (time >= start + length)


def _joints(layout: Layout, frames: int, size: int, generator: torch.Generator) -> Tensor:
    known = torch.rand(1, size, generator=generator) < torch.rand(1, generator=generator)
    known[:, -1] = False
    return known


def _entries(layout: Layout, frames: int, size: int, generator: torch.Generator) -> Tensor:
    known = torch.rand(frames, size, generator=generator) < torch.rand(1, generator=generator)
    known[:, -1] = False
    return known


def _legs(layout: Layout, frames: int, size: int, generator: torch.Generator) -> Tensor:
    known = torch.ones(1, size, dtype=torch.bool)
    known[:, [j for j, name in enumerate(layout.skeleton.names) if name.endswith(LEGS)]] = False
    known[:, -2] = torch.rand((), generator=generator) < 0.5
    known[:, -1] = False
    return known


_MAKE: dict[str, Callable[[Layout, int, int, torch.Generator], Tensor]] = {
    "nothing": _nothing, "frames": _frames, "gap": _gap, "joints": _joints, "entries": _entries, "legs": _legs,
}  # fmt: skip
