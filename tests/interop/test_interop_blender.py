"""Blender opens what we write: how many armatures, meshes and actions; joints and skin are where ours are."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from motionlab.body import BodyModel, lbs
from motionlab.io import bvh, gltf
from motionlab.motion import Motion
from tests.interop import asking
from tests.interop.asking import blender, needs_python

pytestmark = [pytest.mark.interop, needs_python]
FRAMES = (0, 17, 40, 63, 89)


def apart(theirs: list[dict], motion: Motion, later: int = 0) -> float:
    """The largest distance in metres of any joint at any of the frames, ours so many frames later."""
    return float(asking.apart(theirs, motion, FRAMES, later).max())


@pytest.fixture(scope="module")
def body():
    return BodyModel.from_anny()


@pytest.fixture(scope="module")
def people(motions):
    """A walk, and somebody beside it."""
    walk, other = (replace(motion.cut(0, 91), contacts=None) for motion in motions)
    return [walk, replace(other, root=other.root + torch.tensor([1.5, 0.0, 0.0]))]


def test_a_person_is_an_armature_and_a_skin_where_ours_are_with_feet_on_the_floor(tmp_path, people, body):
    gltf.save(tmp_path / "one.glb", people[0], body, names=["Anna"])
    one, walk = blender(tmp_path / "one.glb", 30, FRAMES), people[0]
    assert list(one["armatures"]) == ["Anna"] and one["meshes"] == {"Anna body": ["Anna"]}
    assert one["objects"] == 2 and one["actions"] == 1 and one["armatures"]["Anna"]
    assert apart(one["joints"]["Anna"], walk) < 1e-3
    assert apart(one["joints"]["Anna"], walk, later=1) > 5e-3  # negative control
    theirs = np.array(one["vertices"]["Anna body"])
    ours = lbs(body, walk.skeleton, walk.root, walk.rot)[list(FRAMES)].numpy()
    assert theirs.shape[1] == ours.shape[1]  # not split
    away = np.linalg.norm(theirs - ours, axis=-1)
    assert away.mean() < 2e-4 and np.quantile(away, 0.999) < 2e-3  # four influences of up to six
    assert np.abs(theirs[..., 2].min(1)).max() < 0.015  # the lowest point of the body, at each frame


@pytest.mark.parametrize("with_body", [True, False])
def test_two_people_are_two_armatures_each_with_its_action(tmp_path, people, body, with_body):
    """Without a body, too: not 44 empties. Blender 4.2 makes an action each, 4.4 and later a slot each of one."""
    gltf.save(tmp_path / "two.glb", people, body if with_body else None, names=["Anna", "Bert"])
    found = blender(tmp_path / "two.glb", 30, FRAMES)
    assert sorted(found["armatures"]) == ["Anna", "Bert"] and len(set(found["armatures"].values())) == 2
    assert found["meshes"] == ({"Anna body": ["Anna"], "Bert body": ["Bert"]} if with_body else {})
    assert found["objects"] == (4 if with_body else 2)
    for name, motion in zip(("Anna", "Bert"), people, strict=True):
        assert apart(found["joints"][name], motion) < 1e-3


def test_bvh_is_one_armature_with_bones_of_some_length(tmp_path, people):
    """``blender`` fails on "zero length node"; head, hands and toes are as long as save says."""
    walk = people[0]
    bvh.save(tmp_path / "walk.bvh", walk)
    found = blender(tmp_path / "walk.bvh", 30, FRAMES)
    assert found["fps"] == 30 and list(found["armatures"]) == ["walk"] and found["actions"] == 1
    assert apart(found["joints"]["walk"], walk) < 1e-3
    lengths = found["lengths"]["walk"]
    assert len(lengths) == 22 and all(0.05 < lengths[name] < 0.2 for name in ("head", "left_wrist", "right_foot"))
    feet = [frame[f"{side}_foot"][2] for frame in found["joints"]["walk"] for side in ("left", "right")]
    assert abs(min(feet) - walk.skeleton.sole) < 0.015  # a ball of the foot stands as high as its sole is thick
