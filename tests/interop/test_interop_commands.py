"""Blender sees what we see in what the commands write that change a motion, and gives back what it was given."""

from dataclasses import replace

import pytest
import torch
from rigs_made import made as made_rig

import results
from motionlab import __main__, humanml, io
from motionlab.body import BodyModel
from motionlab.io import bvh, gltf
from motionlab.motion import Motion
from motionlab.retarget import retarget
from tests.interop.asking import apart, blender, joints_of, needs_python
from tests.test_rewriting import stretching

pytestmark = [pytest.mark.interop, needs_python]
FRAMES = (0, 10, 20, 29)
COMMANDS = {
    "t pose": ["convert", "IN", "OUT", "--rest", "t"],
    "a pose": ["convert", "IN", "OUT", "--rest", "a"],
    "planted": ["plant", "IN", "--out", "OUT"],
    "loop": ["cycle", "IN", "--cut", "0.2", "1.4", "--loop", "--out", "OUT"],
    "in place": ["cycle", "IN", "--in-place", "--out", "OUT"],
    "repaired": ["repair", "IN", "--out", "OUT"],
    "completed": ["complete", "IN", "--hidden", "left_arm", "--out", "OUT"],
    "another's rig": ["retarget", "IN", "--onto", "RIG", "--out", "OUT"],
    "another family's rig": ["retarget", "IN", "--onto", "MIXAMO", "--out", "OUT"],
    "GVHMR's, cleaned": ["repair", "GVHMR", "--noise", "2,10", "--drift", "--out", "OUT"],
    "HumanML3D's joints": ["convert", "JOINTS", "OUT"],
    "a bone that stretches": ["plant", "STRETCHING", "--translations", "mean", "--out", "OUT"],
}
#: Of a GLB: what plays is new, beside the animation that was there.
_BESIDE = ("loop", "another's rig", "another family's rig")


@pytest.fixture(scope="module")
def walk(motions):
    return replace(motions[0].cut(0, 60), contacts=None, name="walk")


@pytest.fixture(scope="module")
def files(tmp_path_factory, walk):
    """Everything that is read, by its word, of a BVH and of a GLB."""
    folder = tmp_path_factory.mktemp("read")
    small = replace(walk.skeleton, offsets=walk.skeleton.offsets * 0.8)
    mixamo = made_rig("Mixamo")[0]
    rest = Motion(mixamo, walk.root[:2], torch.eye(3).repeat(2, len(mixamo), 1, 1), 30.0, name="rig")
    rest.rot[:, 0] = walk.rot[0, 0]
    found = {"GVHMR": folder / "gvhmr.pt", "JOINTS": folder / "joints.npy"}
    found["GVHMR"].write_bytes(results.gvhmr(retarget(walk, proportions="standard").motion))
    humanml.save(found["JOINTS"], walk)
    for ending, save in (("bvh", bvh.save), ("glb", gltf.save)):
        rig = replace(walk.cut(0, 2), skeleton=small, root=walk.root[:2] * 0.8)
        for word, motion in (("IN", walk), ("RIG", rig), ("MIXAMO", rest)):
            found[word, ending] = folder / f"{word}.{ending}"
            save(found[word, ending], motion)
        found["STRETCHING", ending] = folder / f"stretching.{ending}"
        longer = 0.08 * torch.sin(torch.arange(walk.frames) / 4)[:, None] * torch.tensor([0.0, 1.0, 0.0])
        stretching(found["STRETCHING", ending], walk, walk.skeleton.index("left_knee"), longer)
    return found


@pytest.mark.parametrize("ending", ["bvh", "glb"])
@pytest.mark.parametrize("name", COMMANDS)
def test_blender_sees_what_we_see(tmp_path, files, name, ending):
    out = tmp_path / f"made.{ending}"
    words = [out if word == "OUT" else files.get(word, files.get((word, ending), word)) for word in COMMANDS[name]]
    words += ["--bones"] if name.endswith("pose") and ending == "glb" else []
    assert __main__.main([str(word) for word in words]) == 0
    made = io.load(out)
    heads = joints_of(blender(out, made.fps, FRAMES), actions=1 + (ending == "glb" and name in _BESIDE))
    assert apart(heads, made, FRAMES).max() < 1e-3
    assert apart(heads, made, FRAMES, later=3).max() > 5e-3  # another frame is elsewhere


@pytest.mark.parametrize("with_body", [True, False])
@pytest.mark.parametrize("ending", ["glb", "gltf", "bvh"])
def test_a_file_that_went_through_blender_reads_the_same(tmp_path, walk, ending, with_body):
    ours, theirs = tmp_path / "ours.glb", tmp_path / f"theirs.{ending}"
    gltf.save(ours, walk, BodyModel.from_anny() if with_body else None)
    blender(ours, walk.fps, FRAMES, back=theirs)
    assert ending != "gltf" or (tmp_path / "theirs.bin").stat().st_size > 1000
    back = io.load(theirs)
    assert back.fps == pytest.approx(walk.fps, 1e-4) and back.frames == walk.frames
    index = back.skeleton.indices(walk.skeleton.names)
    assert (back.positions[:, index] - walk.positions).norm(dim=-1).max() < 1e-3
    assert (back.positions[3:, index] - walk.positions[:-3]).norm(dim=-1).max() > 5e-3
