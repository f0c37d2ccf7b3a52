"""What is measured of a fit beside its mean error: does somebody sit, walk on, tremble, come apart?

Fit and truth are motions (B, T) of the 22 joints at the same frame rate, world, z up; masks are (B, T). Every measure
returns one number per clip (B,), NaN where a mask leaves nothing to measure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import findings
from motionlab.humor import state
from motionlab.humor.cvae import Cvae
from motionlab.humor.report_fit import distances
from motionlab.humor.rollout import infer, rollout
from motionlab.humor.shape import landmarks
from motionlab.metrics import pose
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D, project

SIDES = ("left", "right")
SEATED = 60.0  # degrees of the thighs' tilt and of the knees' flexion from which somebody sits
STRIDE = 0.03  # metres: a foot that is not this far ahead of the other has not passed it
BAND = (2.0, 5.0)  # Hz: where the accents of a dance are


def legs(motion: Motion) -> list[int]:
    """Knees, ankles and feet."""
    return motion.skeleton.indices([f"{side}_{part}" for side in SIDES for part in ("knee", "ankle", "foot")])


# ------------------------------------------------------------------------------------------------------- sitting
def tilt_and_bend(motion: Motion) -> tuple[Tensor, Tensor]:
    """Tilt of the thighs from hanging straight down and flexion of the knees, degrees (B, T, 2), left and right."""
    joints = {part: motion.positions[..., motion.skeleton.indices([f"{s}_{part}" for s in SIDES]), :] for part in
              ("hip", "knee", "ankle")}  # fmt: skip
    thigh, shin = (
        torch.nn.functional.normalize(joints[b] - joints[a], dim=-1) for a, b in (("hip", "knee"), ("knee", "ankle"))
    )
    cosine = (thigh * shin).sum(-1).clamp(-1, 1)
    return torch.rad2deg((-thigh[..., 2]).clamp(-1, 1).arccos()), torch.rad2deg(cosine.arccos())


def sits(motion: Motion, frames: int = 10) -> Tensor:
    """1 where both angles, as means over the legs and the last ``frames``, are SEATED degrees or more, else 0."""
    tilt, bend = (angle[..., -frames:, :].mean((-1, -2)) for angle in tilt_and_bend(motion))
    return ((tilt >= SEATED) & (bend >= SEATED)).to(tilt)


def flexion_error(fit: Motion, truth: Motion) -> Tensor:
    """Mean absolute error of both angles over frames and legs, degrees."""
    pairs = zip(tilt_and_bend(fit), tilt_and_bend(truth), strict=True)
    return torch.stack([(a - b).abs().mean((-1, -2)) for a, b in pairs]).mean(0)


# ------------------------------------------------------------------------------------------------------- walking
def ahead(motion: Motion) -> Tensor:
    """How far the left ankle is ahead of the right one, metres (B, T), along the heading of the pelvis."""
    forward = motion.rot[..., 0, :2, 2]
    forward = torch.nn.functional.normalize(forward, dim=-1)
    left, right = (motion.positions[..., motion.skeleton.index(f"{side}_ankle"), :2] for side in SIDES)
    return ((left - right) * forward).sum(-1)


def swing(motion: Motion, where: Tensor) -> Tensor:
    """Standard deviation of :func:`ahead` over the frames of a mask, metres."""
    way = ahead(motion)
    mean = pose.masked_mean(way, where, 1)
    return pose.masked_mean((way - mean[..., None]).square(), where, 1).sqrt()


def cadence(motion: Motion, where: Tensor) -> Tensor:
    """Steps a minute: how often one foot passes the other by more than STRIDE, in the frames of a mask."""
    way = ahead(motion)
    way = way - pose.masked_mean(way, where, 1)[..., None]
    side = torch.where(way.abs() > STRIDE, way.sign(), 0.0)
    last = torch.where(side != 0, torch.arange(side.shape[-1]).expand(side.shape), -1).cummax(-1).values
    held = torch.where(last >= 0, side.gather(-1, last.clamp(min=0)), 0.0)
    passed = (held[..., 1:] * held[..., :-1] < 0) & where[..., 1:] & where[..., :-1]
    return 60 * motion.fps * passed.sum(-1) / where.sum(-1)


def foot_travel(motion: Motion, where: Tensor) -> Tensor:
    """Horizontal way of an ankle over the frames of a mask, metres, mean of both."""
    ankles = motion.positions[..., motion.skeleton.indices([f"{side}_ankle" for side in SIDES]), :2]
    step = ankles.diff(dim=-3).norm(dim=-1).mean(-1)
    return torch.where(where[..., 1:] & where[..., :-1], step, 0.0).sum(-1)


# ------------------------------------------------------------------------------------------------ errors over time
def error_over_time(fit: Motion, truth: Motion, align: str = "root") -> Tensor:
    """Joint error (B, T) in metres; ``align`` as in ``metrics.pose.joint_errors``."""
    return pose.joint_errors(fit.positions, truth.positions, align=align).mean(-1)


def quarters(error: Tensor) -> tuple[Tensor, Tensor]:
    """Means (B,) of an error (B, T) over the first and over the last quarter of the clip."""
    part = max(1, error.shape[-1] // 4)
    return error[..., :part].mean(-1), error[..., -part:].mean(-1)


def accumulation(model: Cvae, truth: Motion) -> Tensor:
    """Joint error (B, T) in metres, pelvis on the true one, of the truth's own latents (posterior means) rolled out."""
    states = state.from_motion(truth)
    with torch.no_grad():
        posterior, _ = infer(model, states)
        rolled = rollout(model, states[:, 0], posterior.mean, with_prior=False).states
    found = state.unpack(torch.cat((states[:, :1], rolled), 1))["joints"]
    return pose.joint_errors(found, truth.positions, align="root").mean(-1)


# ----------------------------------------------------------------------------------------------------- smoothness
def _about_pelvis(motion: Motion) -> Tensor:
    return motion.positions - motion.positions[..., :1, :]


def band_power(fit: Motion, truth: Motion, bands: Sequence[float] = BAND) -> Tensor:
    """Power of the joints' velocities about the pelvis over the true one, per band of frequency: (B, bands)."""
    return pose.power_spectrum_ratio(_about_pelvis(fit), _about_pelvis(truth), truth.fps, bands)


def acceleration_ratio(fit: Motion, truth: Motion) -> Tensor:
    """Mean size of the acceleration about the pelvis over the true one."""
    return pose.mean_acceleration(_about_pelvis(fit), fit.fps) / pose.mean_acceleration(_about_pelvis(truth), truth.fps)


# ----------------------------------------------------------------------------------------------------- in the image
def pixel_distance(pixels: Tensor, observation: Observation2D) -> Tensor:
    """Mean distance in pixels of points (B, T, 25, 2) from the detections, weighted by confidence; neck and hips, which
    a fit ignores, left out."""
    away, weight = distances(pixels, observation)
    return (weight * away).sum((-1, -2)) / weight.sum((-1, -2))


def image_of(fit: Motion, betas: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Pixels (B, T, 25, 2) of the 25 landmarks of a fit."""
    points = landmarks(*fit.world, betas)
    return torch.stack([project(camera, clip)[0] for camera, clip in zip(cameras, points, strict=True)])


# ------------------------------------------------------------------------------------------------------ two stages
class Paired(NamedTuple):
    """The mean difference of paired samples with its 95 % bootstrap interval, and how many there were."""

    mean: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        return f"{self.mean:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


def paired(after: Tensor, before: Tensor, generator: torch.Generator) -> Paired:
    """``after`` less ``before``, clip by clip; pairs with a NaN are left out."""
    difference = (after - before).flatten()
    difference = difference[difference.isfinite()]
    return Paired(*findings.interval(difference, "mean", generator), len(difference))
