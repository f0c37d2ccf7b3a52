"""Small inputs of the test-time optimisation, and what its tests ask of a fit."""

from __future__ import annotations

import torch
from torch import Tensor

from data_synth import actions
from data_synth.subjects import SUBJECTS
from motionlab.humor.body_shape import landmarks
from motionlab.humor.evidence import Observation3D
from motionlab.humor.testops import Fitted, Schedule
from motionlab.motion import Motion
from motionlab.motion import windows as windows_of
from motionlab.observation import BODY_25, Camera, Observation2D, look_at, project

QUICK = Schedule(steps=(1, 2, 3), inner=5, refine=(1, 2))


def two_walks() -> Motion:
    """Two clips of 24 frames, (2, 24): a walk of the second subject and what follows."""
    motion = actions.walk(SUBJECTS[1], torch.Generator().manual_seed(3), seconds=4.0).motion
    return windows_of(motion, 24, 40).clip(slice(0, 2))


def side_camera() -> Camera:
    return look_at(torch.tensor([3.5, 2.0, 1.4]), torch.tensor([0.0, 1.5, 0.9]), focal=1000.0, width=1280, height=720)


def joints(motion: Motion, hidden: Tensor | None = None) -> Observation3D:
    """hidden (B, T, 22): these become NaN."""
    visible = torch.ones(motion.positions.shape[:-1], dtype=torch.bool)
    points = motion.positions.clone()
    if hidden is not None:
        visible = visible & ~hidden
        points[hidden] = torch.nan
    return Observation3D(points, visible, motion.fps)


def keypoints(motion: Motion, camera: Camera) -> Observation2D:
    turns = motion.world[1]
    points = landmarks(motion.positions, turns, torch.zeros(*motion.root.shape[:-2], 8))
    pixels, depth = project(camera, points)
    assert (depth > 0).all()
    return Observation2D(pixels, torch.full(pixels.shape[:-1], 0.9), BODY_25, motion.fps, camera)


def finite(fitted: Fitted) -> bool:
    tensors = [fitted.motion.root, fitted.motion.rot, fitted.contacts, fitted.z, fitted.first, fitted.betas]
    tensors += [x for m in fitted.stages.values() for x in (m.root, m.rot, m.positions)]
    tensors += [x for terms in fitted.energies.values() for x in terms.values()]
    return all(x.isfinite().all() for x in tensors)


def errors(motion: Motion, truth: Motion) -> Tensor:
    """Mean distance of joints (B, T), metres."""
    return (motion.positions - truth.positions).norm(dim=-1).mean(-1)


def error(motion: Motion, truth: Motion) -> Tensor:
    return errors(motion, truth).mean(-1)
