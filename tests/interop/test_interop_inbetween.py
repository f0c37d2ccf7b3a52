"""What ``inbetween`` writes is opened by Blender: keys where they were, one armature, one action, as many frames.

$MOTIONLAB_INTEROP names the Python that has ``bpy``; it is asked in a process of its own.
"""

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from motionlab import __main__, io
from motionlab.body import BodyModel
from motionlab.io import bvh, gltf
from motionlab.motion import Motion

PYTHON = os.environ.get("MOTIONLAB_INTEROP")
pytestmark = [pytest.mark.interop, pytest.mark.skipif(PYTHON is None, reason="no Python with Blender: make interop")]
FRAMES, KEYS, BETWEEN = 80, (0, 20, 21, 60, 79), (10, 30, 40, 50)


def blender(path: Path, fps: float) -> dict:
    """What ``blender_reads.py`` says, at the keys and then between them."""
    script = Path(__file__).with_name("blender_reads.py")
    command = [PYTHON, script, path, fps, *KEYS, *BETWEEN]
    run = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr[-2000:]
    return json.loads(run.stdout.splitlines()[-1])


@pytest.fixture(scope="module", params=["bvh", "glb"])
def filled(request, tmp_path_factory, motions):
    """The motion as it was written, what Blender makes of the in-betweened file, and this as we read it."""
    motion = replace(motions[0].cut(0, FRAMES), contacts=None, name="walk")
    folder = tmp_path_factory.mktemp(request.param)
    source, out = folder / f"walk.{request.param}", folder / f"made.{request.param}"
    if request.param == "bvh":
        bvh.save(source, motion)
    else:
        gltf.save(source, motion, BodyModel.from_anny(), names=["walk"])
    command = ["inbetween", source, "--keys", ",".join(map(str, KEYS)), "--method", "network", "--out", out]
    assert __main__.main([str(word) for word in command]) == 0
    return motion, blender(out, motion.fps), io.load(out), request.param


def apart(heads: list[dict], motion: Motion, frames: tuple[int, ...]) -> np.ndarray:
    """Metres (F,) that the farthest joint of each frame is from where it is in a motion."""
    theirs = np.array([[frame[name] for name in motion.skeleton.names] for frame in heads])
    return np.linalg.norm(theirs - motion.positions[list(frames)].numpy(), axis=-1).max(-1)


def joints_of(found: dict) -> list[dict]:
    assert len(found["armatures"]) == 1
    return next(iter(found["joints"].values()))


def test_it_is_one_armature_one_action_and_as_many_frames(filled):
    _, found, made, kind = filled
    assert len(found["armatures"]) == 1 and found["actions"] == 1 and all(found["armatures"].values())
    first = 1 if kind == "bvh" else 0
    assert found["spans"] == [[first, first + FRAMES - 1]] and made.frames == FRAMES
    assert len(found["meshes"]) == (1 if kind == "glb" else 0)  # the skin is still there


def test_keys_are_where_they_were_and_the_rest_is_what_was_made(filled):
    motion, found, made, _ = filled
    heads = joints_of(found)
    index = made.skeleton.indices(motion.skeleton.names)  # a BVH lists its joints in another order
    assert (made.positions[:, index] - motion.positions)[list(KEYS)].norm(dim=-1).max() < 1e-4
    assert apart(heads[: len(KEYS)], motion, KEYS).max() < 1e-3
    assert apart(heads[len(KEYS) :], made, BETWEEN).max() < 1e-3


def test_negative_control_between_the_keys_it_is_not_the_motion_that_was_given(filled):
    motion, found, _, _ = filled
    assert apart(joints_of(found)[len(KEYS) :], motion, BETWEEN).min() > 5e-3
