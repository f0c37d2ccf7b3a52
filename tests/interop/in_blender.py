"""Asks Blender, in a process of its own: $MOTIONLAB_INTEROP names the Python that has ``bpy`` (`make interop`)."""

import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from motionlab.motion import Motion

PYTHON = os.environ.get("MOTIONLAB_INTEROP")
MARKS = [pytest.mark.interop, pytest.mark.skipif(PYTHON is None, reason="no Python with Blender: make interop")]


def blender(path: Path, fps: float, frames: Sequence[int], back: Path | None = None) -> dict:
    """What Blender makes of a file, at some frames; back: written again by its exporter, with its own settings."""
    script = Path(__file__).with_name("blender_reads.py")
    command = [PYTHON, script, path, fps, *frames, *([back] if back else [])]
    run = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr[-2000:]
    said = run.stdout + run.stderr
    assert "zero length" not in said and "Error" not in said, said[-2000:]
    return json.loads(next(line for line in reversed(run.stdout.splitlines()) if line.startswith("{")))


def apart(heads: list[dict], motion: Motion, frames: Sequence[int], later: int = 0) -> np.ndarray:
    """Metres (F,) that the farthest joint of each frame is from where it is in a motion, so many frames later."""
    theirs = np.array([[frame[name] for name in motion.skeleton.names] for frame in heads])
    ours = motion.positions[[frame + later for frame in frames]].numpy()
    return np.linalg.norm(theirs - ours, axis=-1).max(-1)


def joints_of(found: dict, actions: int = 1) -> list[dict]:
    """Places of the joints of the only person, a frame each, as the action moves them that plays."""
    assert len(found["armatures"]) == 1 and found["actions"] == actions and all(found["armatures"].values())
    return next(iter(found["joints"].values()))
