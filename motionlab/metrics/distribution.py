"""How far two sets of motions are from each other: a few numbers per window, and a distance with its floor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.contact import with_contacts
from motionlab.errors import ShapeError, check_shape
from motionlab.metrics.pose import jitter
from motionlab.motion import Motion, velocity, windows
from motionlab.skeleton import FEET

#: What :func:`describe` measures, with its unit.
UNITS = {
    "root speed": "m/s",
    "turning rate": "deg/s",
    "joint speed": "m/s",
    "joint acceleration": "m/s^2",
    "jitter": "m/s^3",
    "quick motion": "% above 4 Hz",
    "feet on the floor": "%",
    "foot height": "m",
    "knee flexion": "deg",
    "elbow flexion": "deg",
    "trunk lean": "deg",
    "hand height": "m",
}


def describe(motion: Motion) -> dict[str, Tensor]:
    """Physical summary of each window of motions on the standard joints: name -> (...), units in ``UNITS``.

    Means over the T frames of a window (and over the joints or sides concerned); the root moves on the floor
    plane only; heights are above z = 0; flexion is the angle between the two bones of a limb; quick motion is the
    share of the joints' velocity power above 4 Hz; floor contacts are measured, never taken from labels.
    """
    p, fps, index = motion.positions, motion.fps, motion.skeleton.index
    pelvis, world = p[..., 0, :], motion.world[1]
    moving = velocity(p, fps, dim=-3)
    second = p.diff(n=2, dim=-3) * fps**2
    turn = rotation.geodesic(world[..., :-1, 0, :, :], world[..., 1:, 0, :, :]) * fps
    trunk = torch.nn.functional.normalize(p[..., index("neck"), :] - pelvis, dim=-1)
    feet = [motion.skeleton.contact_names.index(name) for name in FEET]
    hands = p[..., [index("left_wrist"), index("right_wrist")], 2]
    return {
        "root speed": moving[..., 0, :2].norm(dim=-1).mean(-1),
        "turning rate": torch.rad2deg(turn).mean(-1),
        "joint speed": moving.norm(dim=-1).mean((-1, -2)),
        "joint acceleration": second.norm(dim=-1).mean((-1, -2)),
        "jitter": jitter(p, fps),
        "quick motion": 100 * _power_above(moving - moving.mean(-3, keepdim=True), fps, 4.0),
        "feet on the floor": 100 * with_contacts(motion).contacts[..., feet].mean((-1, -2)),
        "foot height": p[..., motion.skeleton.indices(FEET), 2].mean((-1, -2)),
        "knee flexion": _flexion(motion, "hip", "knee", "ankle"),
        "elbow flexion": _flexion(motion, "shoulder", "elbow", "wrist"),
        "trunk lean": torch.rad2deg(torch.acos(trunk[..., 2].clamp(-1, 1))).mean(-1),
        "hand height": hands.mean((-1, -2)),
    }


@dataclass(frozen=True, eq=False)
class Described:
    """Descriptions of windows: values name -> (N,), and groups (N,), the recording that each comes from."""

    values: dict[str, Tensor]
    groups: Tensor

    @property
    def table(self) -> Tensor:
        """The values as columns, (N, D)."""
        return torch.stack(list(self.values.values()), dim=-1)


def describe_windows(
    motions: Sequence[Motion], generator: torch.Generator, *, most: int, seconds: float = 2.0
) -> Described:
    """Describe at most ``most`` windows of ``seconds``, half overlapping, drawn at random over all recordings.

    Recordings that are shorter than one window are left out.
    """
    parts, groups = [], []
    for group, motion in enumerate(motions):
        length = round(seconds * motion.fps)
        if motion.frames >= length:
            parts.append(describe(windows(motion, length, length // 2)))
            groups += [group] * len(parts[-1]["root speed"])
    pick = torch.randperm(len(groups), generator=generator)[:most]
    return Described({k: torch.cat([p[k] for p in parts])[pick] for k in UNITS}, torch.tensor(groups)[pick])


def pool(parts: Sequence[Described]) -> Described:
    """Several sets as one; recordings stay apart."""
    first = torch.tensor([0] + [int(p.groups.max()) + 1 for p in parts[:-1]]).cumsum(0)
    groups = torch.cat([p.groups + start for p, start in zip(parts, first, strict=True)])
    return Described({k: torch.cat([p.values[k] for p in parts]) for k in UNITS}, groups)


def apart(part: Described) -> Described:
    """The same windows, each counted as a recording of its own."""
    return Described(part.values, torch.arange(len(part.groups)))


def compare(ours: Described, theirs: Described, generator: torch.Generator, draws: int = 50) -> tuple[float, Tensor]:
    """Energy distance between two sets, standardised by the second's mean and deviation, and the second's floor."""
    middle, spread = theirs.table.mean(0), theirs.table.std(0)
    x, y = ((d.table - middle) / spread for d in (ours, theirs))
    return energy_distance(x, y), floor(y, theirs.groups, generator, draws)


def _power_above(moving: Tensor, fps: float, hertz: float) -> Tensor:
    """Share (...) of the power of signals (..., T, J, 3) above a frequency."""
    window = torch.hann_window(moving.shape[-3], periodic=False).to(moving)[:, None, None]
    power = torch.fft.rfft(window * moving, dim=-3).abs().square().sum((-1, -2))
    quick = torch.fft.rfftfreq(moving.shape[-3], 1 / fps) > hertz
    return power[..., quick].sum(-1) / power.sum(-1).clamp_min(torch.finfo(power.dtype).tiny)


def _flexion(motion: Motion, *chain: str) -> Tensor:
    angles = []
    for side in ("left", "right"):
        a, b, c = (motion.positions[..., motion.skeleton.index(f"{side}_{part}"), :] for part in chain)
        upper, lower = torch.nn.functional.normalize(b - a, dim=-1), torch.nn.functional.normalize(c - b, dim=-1)
        angles.append(torch.acos((upper * lower).sum(-1).clamp(-1, 1)))
    return torch.rad2deg(torch.stack(angles)).mean((0, -1))


def energy_distance(x: Tensor, y: Tensor) -> float:
    """Energy distance between samples (N, D) and (M, D): 0 where the distributions agree, never below.

    2 E|X - Y| - E|X - X'| - E|Y - Y'|, square root; every pair but a sample with itself. The estimate is
    unbiased before the root and clamped at zero. It has the unit of the features: standardise them first.

    Source: Szekely and Rizzo 2013, Eq. 5.3 (U-statistic form).
    Raises:
        ShapeError: fewer than two samples on a side, or different D.
    """
    check_shape(y, f"M {check_shape(x, 'N D', 'x')['D']}", "y")
    if min(len(x), len(y)) < 2:
        raise ShapeError(f"energy_distance: needs two samples a side, got {len(x)} and {len(y)}")
    x, y = x.double(), y.double()
    within = [torch.cdist(s, s).sum() / (len(s) * (len(s) - 1)) for s in (x, y)]
    squared = 2 * torch.cdist(x, y).mean() - within[0] - within[1]
    return math.sqrt(max(squared.item(), 0.0))


def floor(x: Tensor, groups: Tensor, generator: torch.Generator, draws: int = 50) -> Tensor:
    """Distances (draws,) between random halves of one set (N, D), split by group: what sampling alone explains.

    groups (N,): windows of one recording stay on one side, as recordings are the independent units.

    Raises:
        ShapeError: fewer than two groups.
    """
    names = groups.unique()
    if len(names) < 2:
        raise ShapeError("floor: needs at least two groups")
    found = []
    for _ in range(draws):
        mine = torch.isin(groups, names[torch.randperm(len(names), generator=generator)[: len(names) // 2]])
        if 2 <= int(mine.sum()) <= len(x) - 2:
            found.append(energy_distance(x[mine], x[~mine]))
    return torch.tensor(found)


def told_apart(ours: Described, theirs: Described, neighbours: int = 5) -> float:
    """How often a nearest-neighbour judge tells two sets apart: balanced accuracy, 0.5 is a coin.

    Each window is judged by the majority of its nearest windows from *other* recordings, on standardised
    descriptions; the larger set is thinned evenly, so that both weigh the same and every part of a pool counts.

    Source: the classifier two-sample test (Lopez-Paz & Oquab 2017) with nearest neighbours.
    """
    count = min(len(ours.groups), len(theirs.groups))
    mine, other = (torch.linspace(0, len(d.groups) - 1, count).round().long() for d in (ours, theirs))
    x = torch.cat((ours.table[mine], theirs.table[other])).double()
    label = torch.arange(2 * count) >= count
    group = torch.cat((ours.groups[mine], theirs.groups[other] + ours.groups.max() + 1))
    x = (x - x.mean(0)) / x.std(0).clamp_min(1e-12)
    distance = torch.cdist(x, x).masked_fill(group[:, None] == group, torch.inf)
    votes = label[distance.topk(min(neighbours, 2 * count - 1), largest=False).indices].double().mean(1) > 0.5
    right = (votes == label).double()
    return ((right[label].mean() + right[~label].mean()) / 2).item()


def halves(part: Described, generator: torch.Generator) -> tuple[Described, Described]:
    """One set in two random halves, whole recordings on either side."""
    names = part.groups.unique()
    mine = torch.isin(part.groups, names[torch.randperm(len(names), generator=generator)[: len(names) // 2]])
    return tuple(Described({k: v[m] for k, v in part.values.items()}, part.groups[m]) for m in (mine, ~mine))
