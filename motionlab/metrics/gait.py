"""Gait: the posture of the legs, steps, and feet on the floor (sliding, contact labels).

Positions are (..., T, F, 3) of the F foot joints, metres, world, z up. Where there is nothing to average the
result is NaN, never 0.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from motionlab.errors import check_shape
from motionlab.metrics.pose import masked_mean
from motionlab.motion import Motion

SIDES = ("left", "right")
SEATED = 60.0  # degrees of the thighs' tilt and of the knees' flexion from which somebody sits


def legs(motion: Motion) -> list[int]:
    """Returns the indices of knees, ankles and feet."""
    return motion.skeleton.indices([f"{side}_{part}" for side in SIDES for part in ("knee", "ankle", "foot")])


def tilt_and_bend(motion: Motion) -> tuple[Tensor, Tensor]:
    """Computes the thighs' tilt from hanging straight down and the knees' flexion, degrees (B, T, 2): left, right."""
    hip, knee, ankle = (
        motion.positions[..., motion.skeleton.indices([f"{side}_{part}" for side in SIDES]), :]
        for part in ("hip", "knee", "ankle")
    )
    thigh, shin = (torch.nn.functional.normalize(x, dim=-1) for x in (knee - hip, ankle - knee))
    cosine = (thigh * shin).sum(-1).clamp(-1, 1)
    return torch.rad2deg((-thigh[..., 2]).clamp(-1, 1).arccos()), torch.rad2deg(cosine.arccos())


def sits(motion: Motion, when: Tensor | None = None) -> Tensor:
    """Computes who sits: 1 where both angles, means over legs and frames, reach SEATED, else 0.

    Frames: those of a mask ``when`` (B, T), else the last ten.
    """
    angles = (angle.mean(-1) for angle in tilt_and_bend(motion))
    tilt, bend = (x[..., -10:].mean(-1) if when is None else masked_mean(x, when, 1) for x in angles)
    return ((tilt >= SEATED) & (bend >= SEATED)).to(tilt)


def ahead(motion: Motion) -> Tensor:
    """Computes how far the left ankle is ahead of the right one, metres (B, T), along the heading of the pelvis."""
    forward = torch.nn.functional.normalize(motion.rot[..., 0, :2, 2], dim=-1)
    left, right = (motion.positions[..., motion.skeleton.index(f"{side}_ankle"), :2] for side in SIDES)
    return ((left - right) * forward).sum(-1)


def skating_ratio(positions: Tensor, fps: float) -> Tensor:
    """Computes the share (...) of frames in which some foot slides over the floor.

    It is below 5 cm now and in the next frame, and faster than 0.5 m/s, at once and in the mean of five frames around.

    Source: GMD, OmniControl, CondMDI (their joints: the balls of the feet, at 20 fps; fewer frames than five
        around an end count as standing still).
    Differs: NaN for fewer than two frames.
    """
    check_shape(positions, "... T F 3", "positions")
    moving = torch.linalg.vector_norm(positions[..., :2].diff(dim=-3), dim=-1) * fps  # (..., T - 1, F)
    padded = torch.nn.functional.pad(moving.mT, (2, 2)).mT
    mean = sum(padded[..., k : k + moving.shape[-2], :] for k in range(5)) / 5
    low = positions[..., 2] < 0.05
    slides = low[..., 1:, :] & low[..., :-1, :] & (moving > 0.5) & (mean > 0.5)
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
