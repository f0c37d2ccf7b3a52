"""Blender sees what we see in what the commands write that change a motion, and gives back what it was given."""

from dataclasses import replace

import pytest

from motionlab import __main__, io
from motionlab.body import BodyModel
from motionlab.io import bvh, gltf
from tests.interop.asking import apart, blender, joints_of, needs_python

pytestmark = [pytest.mark.interop, needs_python]
FRAMES = (0, 10, 20, 29)
COMMANDS = {
    "t pose": ["convert", "IN", "OUT", "--rest", "t"],
    "a pose": ["convert", "IN", "OUT", "--rest", "a"],
    "planted": ["plant", "IN", "--out", "OUT"],
    "loop": ["cycle", "IN", "--cut", "0.2", "1.4", "--loop", "--in-place", "--out", "OUT"],
    "repaired": ["repair", "IN", "--out", "OUT"],
    "another's rig": ["retarget", "IN", "--onto", "RIG", "--out", "OUT"],
}


@pytest.fixture(scope="module")
def walk(motions):
    return replace(motions[0].cut(0, 60), contacts=None, name="walk")


@pytest.mark.parametrize("ending", ["bvh", "glb"])
@pytest.mark.parametrize("name", COMMANDS)
def test_blender_sees_what_we_see(tmp_path, walk, name, ending):
    places = {"IN": tmp_path / f"walk.{ending}", "OUT": tmp_path / f"made.{ending}", "RIG": tmp_path / f"rig.{ending}"}
    save = bvh.save if ending == "bvh" else gltf.save
    save(places["IN"], walk)
    small = replace(walk.skeleton, offsets=walk.skeleton.offsets * 0.8)
    save(places["RIG"], replace(walk.cut(0, 2), skeleton=small, root=walk.root[:2] * 0.8))
    bones = ["--bones"] if name.endswith("pose") and ending == "glb" else []
    command = [places.get(word, word) for word in COMMANDS[name]] + bones
    assert __main__.main([str(word) for word in command]) == 0
    made = io.load(places["OUT"])
    kept = ending == "glb" and name in (
        "loop",
        "another's rig",
    )  # what plays is new, beside it
    heads = joints_of(blender(places["OUT"], made.fps, FRAMES), actions=1 + kept)
    assert apart(heads, made, FRAMES).max() < 1e-3
    assert apart(heads, made, FRAMES, later=3).max() > 5e-3  # another frame is elsewhere


@pytest.mark.parametrize("with_body", [True, False])
def test_a_file_that_went_through_blender_reads_the_same(tmp_path, walk, with_body):
    ours, theirs = tmp_path / "ours.glb", tmp_path / "theirs.glb"
    gltf.save(ours, walk, BodyModel.from_anny() if with_body else None)
    blender(ours, walk.fps, FRAMES, back=theirs)
    back = io.load(theirs)
    assert back.fps == walk.fps and back.frames == walk.frames
    index = back.skeleton.indices(walk.skeleton.names)
    assert (back.positions[:, index] - walk.positions).norm(dim=-1).max() < 1e-3
    assert (back.positions[3:, index] - walk.positions[:-3]).norm(dim=-1).max() > 5e-3
