"""What is said of a fit: how far from the detections, how smooth, what touches the floor, what was assumed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import torch
from torch import Tensor

from motionlab.humor import shape
from motionlab.humor.energies import UNUSED_BODY_25
from motionlab.humor.testops import Fitted
from motionlab.metrics import pose
from motionlab.motion import Motion
from motionlab.observation import Camera, Observation2D, project


@dataclass(frozen=True)
class Report:
    """Of one recording.

    pixels: mean distance of the landmarks from the detections, weighted by confidence, neck and hips (which a fit
    ignores) left out; median_pixels: the median, each detection counted once. acceleration: mean over joints and
    frames, m/s^2. contacts: share of the frames in which each of the contact joints touches the floor. seen: share of
    the 22 used keypoints that were detected. energy: after each stage, by term. reasons: why each search ended.
    """

    frames: int
    fps: float
    pixels: float
    median_pixels: float
    acceleration: float
    contacts: dict[str, float]
    seen: float
    energy: dict[int, dict[str, float]]
    reasons: tuple[str, ...]
    notes: tuple[str, ...]

    def lines(self) -> list[str]:
        """For a terminal."""
        touch = ", ".join(f"{name.replace('_', ' ')} {100 * share:.0f} %" for name, share in self.contacts.items())
        return [
            *(f"note: {note}" for note in self.notes),
            *(f"energy after stage {n}: {sum(e.values()):.1f} ({_terms(e)})" for n, e in self.energy.items()),
            f"search ended: {_runs(self.reasons)}",
            f"detections: {100 * self.seen:.0f} % of the keypoints",
            f"reprojection: {self.pixels:.1f} px mean, {self.median_pixels:.1f} px median",
            f"acceleration: {self.acceleration:.2f} m/s^2 mean",
            f"contacts: {touch}",
        ]


def _runs(words: tuple[str, ...]) -> str:
    """Words in a row, each run of the same once with its length: "steps, closures (9)"."""
    counts = [(word, len(list(same))) for word, same in groupby(words)]
    return ", ".join(f"{word} ({n})" if n > 1 else word for word, n in counts)


def _terms(energy: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.1f}" for name, value in sorted(energy.items(), key=lambda item: -item[1])[:4])


def landmarks_of(motion: Motion) -> Tensor:
    """The 25 keypoints (..., T, 25, 3) of a fitted motion, world; its skeleton says its shape."""
    betas = shape.from_skeleton(motion.skeleton)
    if betas.ndim > 1:  # offsets (G, 1, 22, 3): one body per recording
        betas = betas[..., 0, :]
    return shape.landmarks(*motion.world, betas)


def pixels_of(motion: Motion, cameras: list[Camera]) -> Tensor:
    """Pixels (G, T, 25, 2) of the landmarks of fitted motions (G, T)."""
    points = landmarks_of(motion)
    return torch.stack([project(camera, clip)[0] for camera, clip in zip(cameras, points, strict=True)])


def distances(pixels: Tensor, observation: Observation2D) -> tuple[Tensor, Tensor]:
    """Distance in pixels (G, T, 25) of landmarks from the detections, and the weight of each: its confidence.

    The observation is of BODY_25; what was not detected, neck and hips weigh nothing.
    """
    keypoints, weight = observation.keypoints, observation.confidence.clone()
    if keypoints.ndim == 3:
        keypoints, weight = keypoints[None], weight[None]
    weight[..., list(UNUSED_BODY_25)] = 0.0
    seen = (weight > 0) & keypoints.isfinite().all(-1)
    away = (pixels - torch.where(seen[..., None], keypoints, 0.0)).norm(dim=-1)
    return torch.where(seen, away, 0.0), torch.where(seen, weight, 0.0)


def report(fitted: Fitted, observation: Observation2D, clip: int = 0) -> Report:
    """The report of one recording of a fit to keypoints of BODY_25."""
    motion = fitted.motion.clip(clip)
    away, weight = distances(pixels_of(fitted.motion, fitted.cameras), observation)
    away, weight = away[clip], weight[clip]
    seen = weight > 0
    contacts = (fitted.contacts[clip] > 0.5).float().mean(0).tolist()
    fits = [each for results in fitted.results.values() for each in results]
    return Report(
        frames=motion.frames,
        fps=motion.fps,
        pixels=float((weight * away).sum() / weight.sum()),
        median_pixels=float(away[seen].median()) if seen.any() else float("nan"),
        acceleration=float(pose.mean_acceleration(motion.positions, motion.fps)),
        contacts=dict(zip(motion.skeleton.contact_names, contacts, strict=True)),
        seen=float(seen.sum() / (seen.numel() * (1 - len(UNUSED_BODY_25) / seen.shape[-1]))),
        energy={n: {name: float(e[clip]) for name, e in terms.items()} for n, terms in fitted.energies.items()},
        reasons=tuple(each.reasons[min(clip, len(each.reasons) - 1)] for each in fits),
        notes=fitted.notes,
    )
