"""Rigs of others: which joint is which, how it is turned, what is lost, and that all of it is said."""

import json
import math
import re
from dataclasses import replace

import pytest
import torch
from rigs_made import FAMILIES, made
from test_retarget import SIDES, assert_same, reframed, wild, without

from motionlab import io, rotation
from motionlab.__main__ import main
from motionlab.errors import DataError
from motionlab.io import bvh
from motionlab.motion import Motion
from motionlab.rest import FIRST, MOVED, SQUARE, ZERO
from motionlab.retarget import certify, match_joints, put_on, retarget, with_rest
from motionlab.rigs import find_joints
from motionlab.skeleton import STANDARD, UPRIGHT, Skeleton

ARMS = STANDARD.indices([f"{s}_{p}" for s in ("left", "right") for p in ("collar", "shoulder", "elbow", "wrist")])
LETTERS = {"L": (1, 0, 0), "R": (-1, 0, 0), "U": (0, 1, 0), "D": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
#: Where x, y and z of each joint point in a T, as Left, Right, Up, Down, Forward, Back of the body; who is not named is
#: turned as the parent. Found from recordings of each (the third: published axes of LAFAN1).
AXES = {
    "Bandai-Namco": {"pelvis": "URF", "spine1": "UFL", "left_hip": "DLF", "left_ankle": "FLU", "right_hip": "ULB"}
    | {"right_ankle": "BLD", "left_collar": "LUF", "right_collar": "LDB"},
    "Rokoko": {"pelvis": "LUF", "spine1": "URF", "left_hip": "DLF", "left_ankle": "FUR", "right_hip": "DLF"}
    | {"right_ankle": "FUR", "left_collar": "LUF", "right_collar": "RUB", "head": "LUF"},
    "LAFAN1": {"pelvis": "UFL", "left_hip": "DBL", "left_ankle": "FDL", "right_hip": "DBL", "right_ankle": "FDL"}
    | {"left_collar": "LBU", "right_collar": "RBD"},
}


def person(generator: torch.Generator, frames: int = 40) -> Motion:
    """Knees bend about the body's left, elbows about the vertical of a T, the rest a little about any axis."""
    noise = torch.randn(frames, 22, 3, generator=generator, dtype=torch.float64)
    turns = torch.tensor([0.1, 0.1, 0.1]) * noise
    for side, sign in (("left", 1.0), ("right", -1.0)):
        bend = 1 + 0.5 * torch.rand(frames, 2, generator=generator, dtype=torch.float64)
        knee, elbow, shoulder = STANDARD.indices([f"{side}_knee", f"{side}_elbow", f"{side}_shoulder"])
        turns[:, [knee, elbow]] = 0.0
        turns[:, knee, 0], turns[:, elbow, 1] = bend[:, 0], -sign * bend[:, 1]
        turns[:, shoulder, 2] -= sign
    rot = rotation.axis_angle_to_matrix(turns)
    rot[:, 0] = UPRIGHT.double() @ rotation.rotation_about("y", torch.tensor(0.7).double()) @ rot[:, 0]
    return Motion(STANDARD.to(torch.float64), torch.zeros(frames, 3).double(), rot, 30.0, name="person")


def worn(motion: Motion, family: str) -> tuple[Motion, dict[str, str]]:
    """A motion of the standard joints on the made rig of a family: what it lacks is rigid, what it has more rests."""
    skeleton, truth = made(family)
    fewer = without(motion, list(truth))
    rot = torch.eye(3, dtype=torch.float64).repeat(motion.frames, len(skeleton), 1, 1)
    for name, own in truth.items():
        rot[:, skeleton.index(own)] = fewer.rot[:, fewer.skeleton.index(name)]
    return Motion(skeleton.to(torch.float64), motion.root, rot, motion.fps, name=family), truth


# ----------------------------------------------------------------------------------------------------------- names
@pytest.mark.parametrize("family", FAMILIES)
def test_every_family(generator, family):
    motion = wild(generator)
    rig, truth = worn(motion, family)
    found = retarget(rig)
    assert found.names == truth and found.residual < 1e-6
    at, own = STANDARD.indices(list(truth)), rig.skeleton.indices(list(truth.values()))
    lift = torch.tensor([0.0, 0.0, found.floor], dtype=torch.float64)
    torch.testing.assert_close(found.motion.positions[:, at], rig.positions[:, own] + lift, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.motion.world[1][:, at], rig.world[1][:, own], atol=1e-6, rtol=0)
    row = certify(rig)
    assert row.holds and row.joints == len(truth) and row.place < 1e-5 and row.angle < 1e-3


@pytest.mark.parametrize(
    "change",
    ["{}_055", "Armature|{}", "Ctrl_{}_jnt", "Armature:mixamorig1:{}", "mixamorig_{}", "{}:1", str.lower, str.upper],
)
@pytest.mark.parametrize("family", ["HumanIK", "Xsens MVN", "Biovision", "SOMA-77", "Unreal"])
def test_what_stands_around_a_name_says_nothing(family, change):
    if (change in (str.lower, str.upper)) and family == "HumanIK":
        pytest.skip("character1leftupleg: where the prefix ends is not to be seen")
    skeleton, truth = made(family)
    change = change.format if isinstance(change, str) else change
    names = {own: change(own) for own in skeleton.names}
    found = find_joints(replace(skeleton, names=tuple(names.values())))
    assert {name: skeleton.names[j] for name, j in found.items()} == truth


@pytest.mark.parametrize(("left", "right"), [("lf", "rt"), ("Lft", "Rgt"), ("LEFT", "RIGHT"), ("左", "右")])
def test_words_for_the_sides(left, right):
    skeleton, truth = made("Unreal")
    names = {own: re.sub("_([lr])$", lambda s: f"_{left if s[1] == 'l' else right}", own) for own in skeleton.names}
    found = find_joints(replace(skeleton, names=tuple(names.values())))
    assert {name: skeleton.names[j] for name, j in found.items()} == truth


@pytest.mark.parametrize("family", ["MakeHuman", "Second Life"])
def test_the_order_in_the_file_says_nothing(family):
    skeleton, truth = made(family)
    depth = [0]
    for parent in skeleton.parents[1:]:
        depth.append(depth[parent] + 1)
    order = sorted(range(len(skeleton)), key=lambda j: (depth[j], -j))
    tree = tuple(order.index(skeleton.parents[j]) if j else -1 for j in order)
    other = Skeleton(tuple(skeleton.names[j] for j in order), tree, skeleton.offsets[order])
    assert {name: other.names[j] for name, j in find_joints(other).items()} == truth


def test_arms_in_no_known_words_are_lost_aloud(generator):
    motion = wild(generator)
    names = [f"q{j}" if j in ARMS else n for j, n in enumerate(STANDARD.names)]
    found = retarget(replace(motion, skeleton=replace(motion.skeleton, names=tuple(names), contact_names=())))
    elbow = STANDARD.index("left_elbow")
    assert found.residual > 0.01 and any(f"LOST: what q{elbow} does" in note for note in found.notes)


def test_a_map_says_what_names_do_not(generator, tmp_path, capsys):
    motion = wild(generator)
    strange = replace(motion.skeleton, names=tuple(f"b{j}" for j in range(22)), contact_names=())
    strange = replace(motion, skeleton=strange, name="beast")
    names = {name: f"b{j}" for j, name in enumerate(STANDARD.names)}
    assert_same(retarget(strange, names=names), motion)
    with pytest.raises(DataError, match=r"beast, joint names: its joints are called b0, b1.* missing pelvis") as error:
        retarget(strange)
    blank = json.loads(str(error.value)[str(error.value).index("{") : str(error.value).rindex("}") + 1])
    assert set(blank) == set(STANDARD.names) and set(blank.values()) == {""}
    with pytest.raises(DataError, match="'b99'"):
        retarget(strange, names=names | {"head": "b99"})
    with pytest.raises(DataError, match="'skull'"):
        retarget(strange, names=names | {"skull": "b3"})
    path, said = tmp_path / "beast.bvh", tmp_path / "map.json"
    bvh.save(path, strange)
    said.write_text(json.dumps(blank | names))
    assert main(["convert", str(path), str(tmp_path / "out.npz"), "--up", "z"]) == 2
    assert main(["convert", str(path), str(tmp_path / "out.npz"), "--up", "z", "--names", str(said)]) == 0
    assert io.load(tmp_path / "out.npz").skeleton.names == STANDARD.names
    said.write_text("[1]")
    assert main(["convert", str(path), str(tmp_path / "out.npz"), "--names", str(said)]) == 2
    assert "expected one object of names" in capsys.readouterr().err


def test_names_correct_what_is_found():
    skeleton, truth = made("Mixamo")
    other = replace(skeleton, roles={"left_foot": "mixamorig:LeftToe_End"})
    assert find_joints(other)["left_foot"] == skeleton.index("mixamorig:LeftToe_End")
    assert find_joints(other)["left_ankle"] == skeleton.index(truth["left_ankle"])


# ------------------------------------------------------------------------------------------------------- what is lost
def renamed(motion: Motion, **names: str) -> Motion:
    own = tuple(names.get(name, name) for name in motion.skeleton.names)
    return replace(motion, skeleton=replace(motion.skeleton, names=own, contact_names=()))


def test_a_joint_without_a_name_is_taken_by_its_place(generator):
    motion = wild(generator)
    found = retarget(renamed(motion, left_elbow="zork", right_wrist="wip", neck="blib", left_foot="blob"))
    assert_same(found, motion)
    assert any("by their place: left_foot = blob, neck = blib, left_elbow = zork" in note for note in found.notes)


def test_a_joint_that_is_lost_is_said_aloud_and_counted(generator, tmp_path, capsys):
    motion, _ = worn(person(generator), "MakeHuman")  # two joints between shoulder and wrist: which is the elbow?
    names = {f"{bone}.L": f"{bone}.x" for bone in ("lowerarm01", "lowerarm02")}
    found = retarget(renamed(motion, **names))
    assert "left_elbow" in found.unmapped
    lost = next(note for note in found.notes if "LOST: what lowerarm01.x does" in note)
    bone = motion.skeleton.offsets[motion.skeleton.index("lowerarm02.L")].norm()
    bend = motion.rot[:, motion.skeleton.index("lowerarm01.L")]
    off = float(2 * bone * (rotation.geodesic(bend, torch.eye(3).double()) / 2).sin().mean())
    assert abs(found.per_joint["lowerarm01.x"] - off) < 1e-6 and f"{off:.2f} m off" in lost
    assert found.residual > 0.01 > retarget(motion).residual  # negative control: with its elbow nothing is lost
    assert not any("LOST" in note for note in retarget(motion).notes)
    row = certify(renamed(motion, **names))
    assert not row.holds and "lowerarm01.x" in row.lost and row.angle > 20
    bvh.save(tmp_path / "lost.bvh", renamed(motion, **names))
    assert main(["data", str(tmp_path), "--certify"]) == 1
    assert "lowerarm01.x" in capsys.readouterr().out
    bvh.save(tmp_path / "lost.bvh", motion)
    (tmp_path / "LICENSE.txt").write_text("no recording")
    assert main(["data", str(tmp_path), "--certify"]) == 0
    assert main(["data", str(tmp_path / "lost.bvh"), "--certify"]) == 0
    assert "22 of 22  zero pose" in capsys.readouterr().out


def test_a_heel_is_no_ball_of_the_foot(generator):
    motion = renamed(wild(generator), left_foot="blob", right_foot="blub")
    offsets = motion.skeleton.offsets.clone()
    offsets[STANDARD.indices(["left_foot", "right_foot"])] = torch.tensor([0.0, -0.08, 0.01]).double()
    found = retarget(replace(motion, skeleton=replace(motion.skeleton, offsets=offsets)))
    assert found.unmapped == ("left_foot", "right_foot")


def test_of_a_limb_that_is_all_of_one_word_the_middle_bends_and_no_other_limb():
    """What has a thigh by name has its shin right below, however many roll bones are called so, too."""
    skeleton, _ = made("mGear, numbered")
    find = {name: skeleton.names[j] for name, j in find_joints(skeleton).items()}
    assert find["left_knee"] == "leg_L0_4_jnt" and find["right_elbow"] == "arm_R0_4_jnt"
    names = tuple(re.sub(r"leg_([LR])0_0", r"thigh_\g<1>0_0", name) for name in skeleton.names)
    find = {name: names[j] for name, j in find_joints(replace(skeleton, names=names)).items()}
    assert find["left_hip"] == "thigh_L0_0_jnt" and find["left_knee"] == "leg_L0_1_jnt"


def test_the_way_back_onto_a_rig(generator):
    motion = person(generator)
    rig, _ = worn(motion, "iClone")
    body = match_joints(rig)
    back = put_on(retarget(rig, floor=False).motion, rig.skeleton, body)
    torch.testing.assert_close(back.positions, rig.positions, atol=1e-6, rtol=0)
    mapped = list(body.joints.values())
    torch.testing.assert_close(back.world[1][:, mapped], rig.world[1][:, mapped], atol=1e-6, rtol=0)


# --------------------------------------------------------------------------------------------------------- rest poses
@pytest.mark.parametrize("rig", AXES)
def test_axes_at_right_angles_are_found_from_the_movement(generator, rig):
    motion, frames = person(generator), []
    for name, parent in zip(STANDARD.names, STANDARD.parents, strict=True):
        letters = AXES[rig].get(name)
        own = letters and torch.tensor([LETTERS[x] for x in letters], dtype=torch.float64).T
        frames.append(own if letters else frames[parent])
    turned = reframed(motion, torch.stack(frames))
    assert match_joints(turned).source == SQUARE
    assert_same(retarget(turned), motion)


def test_any_axes_are_found_from_the_movement(generator):
    motion = person(generator)
    turned = reframed(motion, rotation.random((22,), generator, dtype=torch.float64))
    assert match_joints(turned).source == MOVED
    found = retarget(turned, floor=False)
    assert found.residual < 1e-9
    torch.testing.assert_close(found.motion.positions, motion.positions, atol=1e-9, rtol=0)
    off = torch.rad2deg(rotation.geodesic(found.motion.world[1], motion.world[1])).amax(0)
    limbs = STANDARD.indices([f"{s}_{part}" for s in SIDES for part in ("hip", "knee", "shoulder", "elbow")])
    assert off[limbs].max() < 1 and off.max() < 12, off


def test_a_t_pose_in_the_first_frame_is_used(generator):
    motion = person(generator)
    rot = motion.rot.clone()
    rot[0] = torch.eye(3)
    rot[0, 0] = UPRIGHT.double() @ rotation.rotation_about("y", torch.tensor(0.3).double())
    motion = replace(motion, rot=rot)
    turned = reframed(motion, rotation.random((22,), generator, dtype=torch.float64))
    assert match_joints(turned).source == FIRST
    assert_same(retarget(turned), motion)
    assert match_joints(turned.cut(1)).source == MOVED  # negative control


@pytest.mark.parametrize("family", ["Mixamo", "Unreal", "DeepMimic", "MakeHuman"])
@pytest.mark.parametrize(("pose", "fall"), [("t", 0.0), ("a", math.pi / 4)])
def test_a_rest_pose_on_the_way_out(generator, family, pose, fall):
    rig, truth = worn(person(generator), family)
    rig = reframed(rig, rotation.random((len(rig.skeleton),), generator, dtype=torch.float64))
    made_so = with_rest(rig, pose)
    torch.testing.assert_close(made_so.positions, rig.positions, atol=1e-6, rtol=0)
    place = dict(zip(rig.skeleton.names, made_so.skeleton.rest_positions(), strict=True))
    for side, sign in (("left", 1), ("right", -1)):
        arm = torch.nn.functional.normalize(place[truth[f"{side}_elbow"]] - place[truth[f"{side}_shoulder"]], dim=0)
        flat = STANDARD.offsets[STANDARD.index(f"{side}_elbow")].double()
        flat = rotation.rotation_about("z", torch.tensor(-sign * fall).double()) @ flat
        torch.testing.assert_close(arm, torch.nn.functional.normalize(flat, dim=0), atol=1e-3, rtol=0)
    assert match_joints(made_so).source == ZERO


def test_convert_takes_a_rest_pose(generator, tmp_path, capsys):
    bvh.save(tmp_path / "in.bvh", worn(person(generator), "Unreal")[0])
    for name in ("out.bvh", "out.glb"):
        words = ["convert", str(tmp_path / "in.bvh"), str(tmp_path / name), "--rest", "a"]
        assert main([*words, *["--bones"] * name.endswith("glb")]) == 0
    assert main([*words[:2], str(tmp_path / "out.npz"), "--rest", "a"]) == 2
    assert "--rest is for" in capsys.readouterr().err
    one, other = (io.load(tmp_path / f"out.{kind}") for kind in ("bvh", "glb"))
    heights = one.positions[..., one.skeleton.indices(other.skeleton.names), 2]
    torch.testing.assert_close(heights, other.positions[..., 2], atol=1e-4, rtol=0)
