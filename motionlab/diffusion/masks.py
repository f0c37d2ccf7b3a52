"""What a model is conditioned on: masks of known parts of a window, and handles, joints of a pose with a target place.

A model that takes known numbers is trained on masks drawn here. Targets of handles (..., 22, 3) are metres in the
pose's own stuck frame: above the origin, facing +y. So where a character stands and which way it faces is given, as a
rig's root is to an animator; how high its pelvis is and how it leans is not.

Source: CondMDI (Cohan et al. 2024), random frames x random joints; the test cases of thesis 4.2.1; thesis 4.2.4, a
subset of joints that an animator fixes.
Differs: asked of a handle is its place, where the thesis keeps what the state holds of it, a rotation
(``pose_completion.keep`` does that).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from motionlab.diffusion.features import Layout
from motionlab.errors import ShapeError, check_shape
from motionlab.heading import stuck_root
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

_EDGE = 5  # known frames on either side of what lies between
_APART = (4, 45)  # frames from one lone key to the next
_MOST = 8  # handles of a pose in training, at most
_NONE, _USUAL = 0.1, 0.45  # how often training draws no handle, and some of ``_EFFECTORS``; else of all joints
#: What people hold a figure by.
_EFFECTORS = ("pelvis", "head", "left_wrist", "right_wrist", "left_ankle", "right_ankle", "left_foot", "right_foot")
#: How often training draws each kind of mask, of a model that is told of anything, and of one that learns legs first.
_ALL = {"nothing": 0.15, "frames": 0.05, "gap": 0.25, "joints": 0.2, "entries": 0.05, "legs": 0.3}
KINDS = {"all": _ALL, "legs": {"legs": 1.0}}
LEGS = ("hip", "knee", "ankle", "foot")


def told(targets: Tensor, which: Tensor) -> Tensor:
    """Computes the denoiser's handle input (..., 22, 4) from targets (..., 22, 3) and a mask (..., 22) of handles."""
    check_shape(targets, f"... {len(STANDARD)} 3", "targets")
    if which.shape != targets.shape[:-1]:
        raise ShapeError(f"which: expected {tuple(targets.shape[:-1])}, got {tuple(which.shape)}")
    which = which.bool()[..., None]
    return torch.cat((torch.where(which, targets, 0.0), which.to(targets)), -1)


def draw_handles(motion: Motion, generator: torch.Generator) -> Tensor:
    """Draws random handles (B, T, 22, 4) of windows (B, T), the same joints in all frames of a window.

    No joint, some of ``_EFFECTORS`` or some of all, up to ``_MOST``, evenly in number. Targets: where these joints are.
    """
    count, joints = len(motion.root), len(motion.skeleton)
    kind = torch.rand(count, 1, generator=generator)
    last = torch.ones(joints)
    last[motion.skeleton.indices(list(_EFFECTORS))] = 0.0
    order = torch.rand(count, joints, generator=generator) + last * (kind < _USUAL)
    number = torch.randint(1, _MOST + 1, (count, 1), generator=generator)
    which = (order.argsort(-1).argsort(-1) < number) & (kind < 1 - _NONE)
    targets = stuck_root(motion)[0].positions
    return told(targets, which[:, None].expand(targets.shape[:-1]))


def units(layout: Layout) -> Tensor:
    """Computes the joint that each number of a frame (D,) belongs to; J: the root's place, J + 1: contacts."""
    joints = len(layout.skeleton)
    each, root = torch.arange(joints).repeat_interleave(6), torch.full((3,), joints)
    owners = {"root": root, "orient": each[:6], "pose": each[6:], "root_vel": root, "rot_vel": each}
    owners["contacts"] = torch.full((len(layout.skeleton.contact_names),), joints + 1)
    return torch.cat([owners[name] for name in layout.slices])


def draw(
    layout: Layout, frames: int, count: int, generator: torch.Generator, kinds: Mapping[str, float] = _ALL
) -> Tensor:
    """Draws masks (count, frames, D), bool, True where known: :func:`draw_units`, by the numbers of a layout."""
    return draw_units(frames, count, generator, kinds)[..., units(layout)]


def draw_units(frames: int, count: int, generator: torch.Generator, kinds: Mapping[str, float] = _ALL) -> Tensor:
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
