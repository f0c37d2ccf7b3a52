"""Another Python, with Blender and aitviewer, is asked in a process of its own; $MOTIONLAB_INTEROP names it."""

import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from motionlab.motion import Motion

PYTHON = os.environ.get("MOTIONLAB_INTEROP")
needs_python = pytest.mark.skipif(PYTHON is None, reason="no Python with Blender and aitviewer: make interop")


def ask(script: str, *words: object) -> subprocess.CompletedProcess:
    """A script beside this file, run to its end there."""
    command = [PYTHON, Path(__file__).with_name(script), *words]
    run = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr[-2000:]
    return run


def blender(path: Path, fps: float, frames: Sequence[int], back: Path | None = None) -> dict:
    """What Blender makes of a file, at these frames, without a complaint; back: written again by its exporter."""
    run = ask("blender_reads.py", path, fps, *frames, *([back] if back else []))
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
