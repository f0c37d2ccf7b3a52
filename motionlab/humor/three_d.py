"""Fits of 3-D joints against filters: HuMoR's two tests, joints with noise and joints of which the low ones are hidden.

Source: HuMoR (Rempe et al. 2021), section 5.2.
Differs: the hidden keypoints are joints of the 22 here, not vertices of a mesh.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionlab import baselines
from motionlab.contact import contacts_from_positions, resting_heights
from motionlab.humor.case_trials import CM
from motionlab.humor.cases import legs
from motionlab.humor.observed import Observation3D
from motionlab.metrics import contact, pose
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

NOISE, HEIGHT = 0.04, 0.9  # metres


def noisy(truth: Motion, generator: torch.Generator) -> Observation3D:
    """All 22 joints with N(0, 4 cm) on every coordinate."""
    points = truth.positions
    points = points + NOISE * torch.randn(points.shape, generator=generator, dtype=points.dtype)
    return Observation3D(points, torch.ones(points.shape[:-1], dtype=torch.bool), truth.fps, "noisy joints")


def low_hidden(truth: Motion) -> Observation3D:
    """Exact joints, those below 0.9 m hidden."""
    points = truth.positions
    return Observation3D(points, points[..., 2] >= HEIGHT, truth.fps, "low joints hidden")


def filtered(observation: Observation3D) -> dict[str, Tensor]:
    """The observed points (B, T, 22, 3) through filters of several strengths; for the best of them to be chosen.

    Kalman: the noise is known to it; its acceleration (m/s^1.5) spans gentle to quick motion.
    """
    points, fps = observation.points, observation.fps
    flat = points.flatten(-2)
    found = {"as observed": flat}
    found |= {f"Savitzky-Golay {w}": baselines.savitzky_golay(flat, w, 2) for w in (7, 11, 15)}
    found |= {f"Kalman {a:g}": baselines.kalman(flat, fps, NOISE, a) for a in (1.0, 3.0, 9.0)}
    found["one-euro"] = baselines.one_euro(flat, fps, min_cutoff=2.0, beta=0.5)
    return {name: x.unflatten(-1, (22, 3)) for name, x in found.items()}


def scores(found: Motion | Tensor, truth: Motion, visible: Tensor) -> dict[str, Tensor]:
    """Errors in the world, one number (B,) per clip, of a fit or of points (B, T, 22, 3).

    "all", "visible", "hidden", "legs": cm. "acceleration": error in m/s^2. "contact F1": of the fit's contacts, else of
    those that follow from height and speed. "under floor": % of foot joints deeper than 3 cm.
    """
    points = found.positions if isinstance(found, Motion) else found
    error = pose.joint_errors(points, truth.positions, align="none")
    on_seen, on_hidden = pose.mpjpe_visible_occluded(points, truth.positions, visible, align="none")
    touching = found.contacts if isinstance(found, Motion) else None
    if touching is None:
        joints = points[..., STANDARD.contact_indices, :]
        touching = contacts_from_positions(joints, truth.fps, resting_heights(STANDARD))
    feet = points[..., STANDARD.indices(["left_foot", "right_foot"]), :]
    return {
        "all": CM * error.mean((-1, -2)),
        "visible": CM * on_seen,
        "hidden": CM * on_hidden,
        "legs": CM * error[..., legs(truth)].mean((-1, -2)),
        "acceleration": pose.acceleration_error(points, truth.positions, truth.fps),
        "contact F1": contact.contact_scores(touching, truth.contacts).f1,
        "under floor": 100 * contact.floor_penetration(feet, depths=(0.03,)).frequency[..., 0],
    }
