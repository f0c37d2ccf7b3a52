"""From one motion to another: the second is put where the first would arrive, and a gap between them is left to fill.

Source: thesis 4.4.2: "Motion switching, which is a specific form of inbetweening where we attempt to join two distinct
motion sequences".
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from motionlab.errors import ShapeError
from motionlab.heading import heading_frame, local_to_world, stuck_root
from motionlab.metrics.gait import skating_ratio
from motionlab.metrics.pose import mean_acceleration
from motionlab.motion import Motion
from motionlab.skeleton import FEET, STANDARD
from studies.shared.inbetween_measures import seam

_PACE = 5  # frames over which a velocity is measured


def placed_after(suffix: Motion, prefix: Motion, gap: int) -> Motion:
    """The suffix (B, S), begun ``gap`` + 1 frames after the prefix (B, P) ends, heading as that does at its end.

    Between them the root covers, on the floor, the mean of the velocity it leaves with and the one it arrives with.
    Heights stay.

    Raises:
        ShapeError: other skeletons, rates or counts, or fewer than two frames of either.
    """
    same = prefix.fps == suffix.fps and len(prefix.root) == len(suffix.root) and prefix.root.ndim == 3
    if not same or min(prefix.frames, suffix.frames) < 2 or prefix.skeleton.names != suffix.skeleton.names:
        raise ShapeError(
            "placed_after: expected (B, P) and (B, S) of two frames or more, on one skeleton and at one rate"
        )
    local, _ = stuck_root(suffix)
    seconds = (gap + 1) / prefix.fps
    start, facing = prefix.root[:, -1:], prefix.rot[:, -1:, 0]
    frame = heading_frame(start, facing)
    there = local_to_world(frame, local)  # where it would be without a gap
    travel = seconds * (_pace(prefix.cut(-_PACE - 1)) + _pace(there.cut(0, _PACE + 1))) / 2
    return replace(there, root=there.root + travel[:, None])


def joined_with_gap(prefix: Motion, suffix: Motion, gap: int) -> tuple[Motion, Tensor]:
    """Both with a gap between them, (B, P + gap + S), and which frames are known, bool (B, P + gap + S).

    Frames in the gap hold the prefix's last one; nothing may read them.
    """
    after = placed_after(suffix, prefix, gap)
    fill = prefix.cut(-1).root.repeat(1, gap, 1), prefix.cut(-1).rot.repeat(1, gap, 1, 1, 1)
    contacts = None
    if prefix.contacts is not None and suffix.contacts is not None:
        empty = torch.zeros_like(prefix.contacts[:, -1:]).repeat(1, gap, 1)
        contacts = torch.cat((prefix.contacts, empty, suffix.contacts), 1)
    whole = replace(
        prefix,
        root=torch.cat((prefix.root, fill[0], after.root), 1),
        rot=torch.cat((prefix.rot, fill[1], after.rot), 1),
        contacts=contacts,
        name="switched",
    )
    known = torch.ones(len(whole.root), whole.frames, dtype=torch.bool)
    known[:, prefix.frames : prefix.frames + gap] = False
    return whole, known


def switched_pairs(windows: Motion, gap: int, generator: torch.Generator) -> tuple[Motion, Tensor]:
    """Windows (N, T) of one skeleton cut and joined: the first frames of each, and the last ones of another.

    Raises:
        ShapeError: fewer than two windows, or too few frames for the gap.
    """
    start = (windows.frames - gap) // 2
    if len(windows.root) < 2 or start < 2:
        raise ShapeError(f"{tuple(windows.root.shape[:2])} windows and a gap of {gap}: nothing to join")
    order = torch.randperm(len(windows.root), generator=generator)
    other = torch.empty_like(order)
    other[order] = order.roll(1)  # one ring: nobody follows himself
    return joined_with_gap(windows.cut(0, start), windows.clip(other).cut(start + gap), gap)


def switching_measures(made: Motion, known: Tensor, natural: Tensor) -> dict[str, Tensor]:
    """Of every transition (B, T): what the eye would stop at. natural: m/s, of real motion (``natural_changes``).

    The gap and two frames either side: share of frames in which a foot skates, and the mean acceleration.
    """
    start, stop = (int(i) for i in (~known[0]).nonzero()[[0, -1], 0])
    part = made.cut(max(start - 2, 0), stop + 3)
    found = seam(made.positions, known, made.fps, natural)
    return {
        "seam, m/s": found.jump_mps,
        "seam, percentile of natural": found.percentile,
        "skating, %": 100 * skating_ratio(part.positions[..., STANDARD.indices(FEET), :], made.fps),
        "acceleration, m/s^2": mean_acceleration(part.positions, made.fps),
    }


def _pace(motion: Motion) -> Tensor:
    """Mean velocity (B, 3) over the floor in m/s."""
    moved = (motion.root[:, -1] - motion.root[:, 0]) * motion.fps / (motion.frames - 1)
    return moved * moved.new_tensor([1.0, 1.0, 0.0])
