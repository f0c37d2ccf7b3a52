"""Gait: the posture of the legs, steps, and feet on the floor (sliding, contact labels, penetration).

Positions are (..., T, F, 3) of the F foot joints, metres, world, z up. Where there is nothing to average the
result is NaN, never 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.errors import check_shape
from motionlab.metrics.pose import masked_mean
from motionlab.motion import Motion

SIDES = ("left", "right")
SEATED = 60.0  # degrees of the thighs' tilt and of the knees' flexion from which somebody sits
#: HuMoR's depths in metres.
PENETRATION_DEPTHS = (0.0, 0.03, 0.06, 0.09, 0.12, 0.15)


def legs(motion: Motion) -> list[int]:
    """Returns the indices of knees, ankles and feet."""
    return motion.skeleton.indices([f"{side}_{part}" for side in SIDES for part in ("knee", "ankle", "foot")])


def tilt_and_bend(motion: Motion) -> tuple[Tensor, Tensor]:
    """Computes the thighs' tilt from hanging straight down and the knees' flexion, degrees (B, T, 2): left, right."""
    joints = {part: motion.positions[..., motion.skeleton.indices([f"{s}_{part}" for s in SIDES]), :] for part in
              ("hip", "knee", "ankle")}  # fmt: skip
    thigh, shin = (
        torch.nn.functional.normalize(joints[b] - joints[a], dim=-1) for a, b in (("hip", "knee"), ("knee", "ankle"))
    )
    cosine = (thigh * shin).sum(-1).clamp(-1, 1)
    return torch.rad2deg((-thigh[..., 2]).clamp(-1, 1).arccos()), torch.rad2deg(cosine.arccos())


def sits(motion: Motion, frames: int = 10, when: Tensor | None = None) -> Tensor:
    """Computes who sits: 1 where both angles, means over legs and frames, reach SEATED, else 0.

    Frames: those of a mask ``when`` (B, T), else the last ``frames``.
    """
    angles = [angle.mean(-1) for angle in tilt_and_bend(motion)]
    if when is None:
        tilt, bend = (angle[..., -frames:].mean(-1) for angle in angles)
    else:
        tilt, bend = (masked_mean(angle, when, 1) for angle in angles)
    return ((tilt >= SEATED) & (bend >= SEATED)).to(tilt)


def ahead(motion: Motion) -> Tensor:
    """Computes how far the left ankle is ahead of the right one, metres (B, T), along the heading of the pelvis."""
    forward = motion.rot[..., 0, :2, 2]
    forward = torch.nn.functional.normalize(forward, dim=-1)
    left, right = (motion.positions[..., motion.skeleton.index(f"{side}_ankle"), :2] for side in SIDES)
    return ((left - right) * forward).sum(-1)


def skating_ratio(positions: Tensor, fps: float, *, height: float = 0.05, speed: float = 0.5) -> Tensor:
    """Computes the share (...) of frames in which some foot slides over the floor.

    It is below ``height`` metres now and in the next frame, and faster than ``speed`` m/s, at once and in the mean of
    five frames around.

    Source: GMD, OmniControl, CondMDI (their joints: the balls of the feet, at 20 fps; fewer frames than five
        around an end count as standing still).
    Differs: NaN for fewer than two frames.
    """
    check_shape(positions, "... T F 3", "positions")
    moving = torch.linalg.vector_norm(positions[..., :2].diff(dim=-3), dim=-1) * fps  # (..., T - 1, F)
    padded = torch.nn.functional.pad(moving.mT, (2, 2)).mT
    steps = moving.shape[-2]
    mean = sum(padded[..., k : k + steps, :] for k in range(5)) / 5
    low = positions[..., 2] < height
    slides = low[..., 1:, :] & low[..., :-1, :] & (moving > speed) & (mean > speed)
    return slides.any(-1).to(positions).mean(-1)


def slide_in_contact_mm(positions: Tensor, contacts: Tensor) -> Tensor:
    """Computes the mean displacement (...), mm per frame, of joints that touch in both frames; contacts (..., T, F)."""
    check_shape(positions, "... T F 3", "positions")
    step = torch.linalg.vector_norm(positions.diff(dim=-3), dim=-1) * 1000
    on = contacts > 0.5
    return masked_mean(step, on[..., 1:, :] & on[..., :-1, :], 2)


def slide_where_truth_stands_mm(positions: Tensor, truth: Tensor, *, still: float = 0.01) -> Tensor:
    """Computes the mean displacement (...) in mm per frame where the true joint moves less than ``still`` m per frame.

    Source: foot sliding of WHAM and GVHMR (there of four sole vertices, at 30 fps).
    """
    check_shape(positions, "... T F 3", "positions")
    step, true = (torch.linalg.vector_norm(x.diff(dim=-3), dim=-1) for x in (positions, truth))
    return masked_mean(step * 1000, true < still, 2)


class ContactScores(NamedTuple):
    """Shares (...) in 0..1 of contact labels, over all frames and joints."""

    precision: Tensor  #: of the predicted contacts, how many are true; NaN where none is predicted
    recall: Tensor  #: of the true contacts, how many are predicted; NaN where there is none
    f1: Tensor  #: their harmonic mean, 2 hits / (predicted + true); NaN where there is neither
    accuracy: Tensor  #: of all labels, how many are right


def contact_scores(predicted: Tensor, truth: Tensor) -> ContactScores:
    """Compares contact labels (..., T, C), or probabilities with threshold 1/2, with the true ones."""
    p, t = (predicted > 0.5).double(), (truth > 0.5).double()
    hits, ps, ts = (x.sum((-1, -2)) for x in (p * t, p, t))
    return ContactScores(hits / ps, hits / ts, 2 * hits / (ps + ts), (p == t).double().mean((-1, -2)))


class Penetration(NamedTuple):
    """How often and how deep joints are below the floor."""

    frequency: Tensor  #: (..., D) share of frames and joints deeper than each depth asked for
    mean_depth_m: Tensor  #: (...) metres, over those below the floor; NaN where none is


def floor_penetration(
    positions: Tensor, *, depths: Sequence[float] = PENETRATION_DEPTHS, floor: float = 0.0
) -> Penetration:
    """Computes the penetration of joints (..., T, F, 3) below ``floor`` metres, deeper than each of ``depths`` metres.

    Source: HuMoR's evaluation (there of the toe joints).
    """
    check_shape(positions, "... T F 3", "positions")
    depth = floor - positions[..., 2]
    frequency = torch.stack([(depth > d).to(positions).mean((-1, -2)) for d in depths], dim=-1)
    return Penetration(frequency, masked_mean(depth, depth > 0, 2))
