"""Somebody who walks before a camera: what the tests of ``fit`` are given, in files of several kinds."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab.footage import fit, scene_fit
from motionlab.humor import testops
from motionlab.humor.feedback_solver import Plan
from motionlab.motion import Motion
from motionlab.observation import BODY_25, Camera, look_at, project

SIZE = (1280, 720)
CAMERA = look_at(torch.tensor([0.5, -4.0, 1.4]), torch.tensor([0.0, 0.0, 0.9]), focal=900.0, width=1280, height=720)


def walk(frames: int, *, seed: int = 4) -> Motion:
    """Frames from a second on of a walk that never ends, begun at the origin."""
    motion = ACTIONS["walk"](SUBJECTS[0], torch.Generator().manual_seed(seed)).motion.cut(20, 20 + frames)
    return replace(motion, root=motion.root - motion.root[:1] * torch.tensor([1.0, 1.0, 0.0]))


def aside(motion: Motion, x: float, y: float) -> Motion:
    return replace(motion, root=motion.root + torch.tensor([x, y, 0.0]))


def table(*people: Motion, camera: Camera = CAMERA) -> torch.Tensor:
    """Perfect detections (T, P, 25, 3)."""
    points = torch.stack([project(camera, fit.landmarks_of(each))[0] for each in people], 1)
    return torch.cat((points, torch.ones_like(points[..., :1])), -1)


def write_json(folder: Path, frames: torch.Tensor, name: str = "view") -> Path:
    """A file of OpenPose's per frame; of whom nothing was seen is not in it."""
    folder.mkdir(parents=True, exist_ok=True)
    for n, people in enumerate(frames):
        seen = [{"pose_keypoints_2d": one.flatten().tolist()} for one in people if one[:, 2].any()]
        (folder / f"{name}_{n:012d}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": seen}))
    return folder


def write_npz(file: Path, frames: torch.Tensor) -> Path:
    np.savez(file, keypoints=frames.numpy(), names=np.array(BODY_25), fps=30.0, size=np.array(SIZE))
    return file


def write_camera(path: Path, camera: Camera = CAMERA, *, placed: bool = True) -> Path:
    words = ("intrinsics", "rotation", "translation") if placed else ("intrinsics",)
    content = {word: getattr(camera, word).tolist() for word in words}
    path.write_text(json.dumps(content | {"width": camera.width, "height": camera.height}))
    return path


def few_steps(monkeypatch, steps=(1, 1, 1), inner: int = 3, closures: int = 2) -> None:
    """Quick fits of even fewer steps."""
    plan = Plan(rounds=1, closures=closures, mode_jumps=0, trial_rounds=0)
    monkeypatch.setattr(scene_fit, "QUICK_WORK", testops.Schedule(steps=steps, inner=inner, shooting=plan))


def short_windows(monkeypatch) -> None:
    """Windows of 8 frames: a clip of 20 has three."""
    for name, value in {"MAX_FRAMES": 10, "WINDOW": 8, "OVERLAP": 2, "_SHOWN": 1}.items():
        monkeypatch.setattr(scene_fit, name, value)
