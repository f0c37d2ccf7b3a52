"""BVH: against a scalar reading of the format, round trips, and files that are wrong in every line."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from loaders import refused

from motionlab import io, rotation
from motionlab.animate import rewriting
from motionlab.errors import DataError
from motionlab.io import bvh
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from tests.figures import standing
from tests.recorded import DATA, needs_data
from tests.twins import fk as twin_fk

ROTATIONS = "Zrotation Xrotation Yrotation"
TEXT = f"""HIERARCHY
ROOT Hips
{{
  OFFSET 0 90 0
  CHANNELS 6 Xposition Yposition Zposition {ROTATIONS}
  JOINT Spine
  {{
    OFFSET 0 50 2
    CHANNELS 3 Yrotation Zrotation Xrotation
    End Site
    {{
      OFFSET 0 25 0
    }}
  }}
  JOINT Leg
  {{
    OFFSET 9 0 0
    CHANNELS 6 Zposition Xposition Yposition {ROTATIONS}
    JOINT Foot
    {{
      OFFSET 0 -85 0
      CHANNELS 2 Xrotation Zrotation
      End Site
      {{
        OFFSET 0 0 0
      }}
    }}
  }}
}}
MOTION
Frames: 2
Frame Time: 0.033333
1 91 -2 10 20 30 5 -10 15 0 9 0 40 0 -20 33 12
3 92 -1 -5 25 60 1 2 3 0 9 0 10 20 30 -7 8
"""


def write(folder: Path, text: str | bytes, name: str = "clip.bvh") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def axis_turn(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[[i, j], [i, j]], turn[i, j], turn[j, i] = c, -s, s
    return turn


def turn(order: str, *degrees: float) -> np.ndarray:
    return np.linalg.multi_dot([np.eye(3), np.eye(3), *(axis_turn(a, d) for a, d in zip(order, degrees, strict=True))])


def test_agrees_with_a_scalar_reading(tmp_path):
    motion = bvh.load(write(tmp_path, TEXT), unit="cm", up="y")
    assert motion.skeleton.names == ("Hips", "Spine", "Spine_end", "Leg", "Foot")
    assert motion.fps == 30.0 and motion.name == "clip"
    first = turn("ZXY", 10, 20, 30), turn("YZX", 5, -10, 15), np.eye(3), turn("ZXY", 40, 0, -20), turn("XZ", 33, 12)
    offsets = np.array([[0, 0, 0], [0, 50, 2], [0, 25, 0], [9, 0, 0], [0, -85, 0]]) / 100
    expected, _ = twin_fk((-1, 0, 1, 0, 3), offsets, np.array([1, 91, -2]) / 100, first)
    facing_y = np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    np.testing.assert_allclose(motion.positions[0].numpy(), expected @ facing_y.T, atol=1e-6)


def test_axes_and_units_given_or_detected_and_noted(tmp_path):
    path = write(tmp_path, TEXT)
    given_both = bvh.load(path, unit="cm", up="y")
    assert given_both.notes == ()
    detected = bvh.load(path)
    torch.testing.assert_close(detected.positions, given_both.positions)
    assert any("up axis y detected" in note for note in detected.notes)
    assert any("unit cm detected" in note for note in detected.notes)
    z_up = bvh.load(path, unit=0.01, up="z")
    torch.testing.assert_close(z_up.positions @ UPRIGHT.T, given_both.positions)
    metres = bvh.load(path, unit="m", up="y")
    torch.testing.assert_close(metres.positions, 100 * given_both.positions)


def test_a_size_that_no_unit_explains_is_scaled_and_said(tmp_path):
    bvh.save(tmp_path / "odd.bvh", standing(), unit=1 / 25)
    loaded = bvh.load(tmp_path / "odd.bvh")
    assert any("no unit fits" in note for note in loaded.notes)
    height = loaded.positions[..., 2].max() - loaded.positions[..., 2].min()
    assert 1.3 < float(height) < 1.8  # 42 units, ankles to head joint


def test_z_up_is_detected(tmp_path):
    motion = standing(at=(0.1, 0.2))
    bvh.save(tmp_path / "z.bvh", motion, up="z")
    loaded = bvh.load(tmp_path / "z.bvh")
    assert any("up axis z detected" in note for note in loaded.notes)
    order = loaded.skeleton.indices(STANDARD.names)
    torch.testing.assert_close(loaded.positions[:, order], motion.positions, atol=1e-6, rtol=0)


@pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"])
@pytest.mark.parametrize(("unit", "up"), [("cm", "y"), ("m", "z")])
def test_round_trip(tmp_path, generator, order, unit, up):
    rot = rotation.random((7, 22), generator)
    motion = Motion(STANDARD, torch.randn(7, 3, generator=generator), rot, 59.94)
    bvh.save(tmp_path / "a.bvh", motion, order=order, unit=unit, up=up)
    back = bvh.load(tmp_path / "a.bvh", unit=unit, up=up)
    which = back.skeleton.indices(STANDARD.names)
    assert len(back.skeleton) == 22 and abs(back.fps - 59.94) < 1e-5
    # six decimals: half a unit in the last place of a metre or of a degree, then float32
    torch.testing.assert_close(back.root, motion.root, atol=1e-6, rtol=0)
    torch.testing.assert_close(back.rot[:, which], rot, atol=1e-6, rtol=0)
    torch.testing.assert_close(back.positions[:, which], motion.positions, atol=5e-6, rtol=0)


def test_negative_control_wrong_order_is_another_motion(tmp_path, generator):
    motion = Motion(STANDARD, torch.zeros(4, 3), rotation.random((4, 22), generator), 30.0)
    bvh.save(tmp_path / "a.bvh", motion, order="ZXY")
    text = (tmp_path / "a.bvh").read_text().replace("Zrotation Xrotation Yrotation", "Xrotation Zrotation Yrotation")
    wrong = bvh.load(write(tmp_path, text), unit="cm", up="y")
    assert rotation.geodesic(wrong.rot, motion.rot[:, motion.skeleton.indices(wrong.skeleton.names)]).mean() > 0.3


def test_end_sites_survive(tmp_path):
    path = write(tmp_path, TEXT)
    once = bvh.load(path, unit="cm", up="y")
    bvh.save(tmp_path / "again.bvh", once)
    again = bvh.load(tmp_path / "again.bvh", unit="cm", up="y")
    assert again.skeleton.names == once.skeleton.names
    torch.testing.assert_close(again.positions, once.positions, atol=1e-6, rtol=0)


def test_every_end_site_has_a_length_and_is_ours_again(tmp_path):
    """Blender: "zero length node found"; what save makes up must not come back as joints, what is measured must."""
    path = tmp_path / "a.bvh"
    bvh.save(path, Motion(STANDARD, torch.zeros(2, 3), torch.eye(3).expand(2, 22, 3, 3), 30.0))
    ends = re.findall(r"OFFSET (.+)\n[^\n]*CHANNELS[^\n]*\n\s*End Site\n\s*{\n\s*OFFSET (.+)", path.read_text())
    bones, ends = (np.array([[float(x) for x in text.split()] for text in side]) for side in zip(*ends, strict=True))
    length = np.linalg.norm(ends, axis=1)  # cm: feet, head, hands
    assert len(ends) == 5 and (length > 5).all() and (length < 20).all() and ((ends != 0).sum(1) == 1).all()
    assert ((ends * bones).sum(1) > 0).all()  # onwards: toes forward, the head up, hands outward
    assert len(bvh.load(path).skeleton) == 22
    hand = f"{ends[-1][0]:.6f} 0.000000 0.000000"
    measured = bvh.load(write(tmp_path, path.read_text().replace(hand, f"{ends[-1][0] + 1e-4:.6f} 0 0"), "b.bvh"))
    assert measured.skeleton.names[-1] == "right_wrist_end" and len(measured.skeleton) == 23


def moved_hips(root: str, hips: str, leg_shift: float = 0.0) -> str:
    six = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    return f"""HIERARCHY
ROOT joint_Root
{{
 OFFSET 0 0 0
 {six}
 JOINT Hips
 {{
  OFFSET 0 94 -3
  {six}
  JOINT Leg
  {{
   OFFSET 10 -40 0
   {six}
   End Site
   {{
    OFFSET 0 -40 0
   }}
  }}
  JOINT Head
  {{
   OFFSET 0 70 0
   {six}
   End Site
   {{
    OFFSET 0 0 0
   }}
  }}
 }}
}}
MOTION
Frames: 2
Frame Time: 0.0333333
{root} {hips} 10 -40 0 0 0 0 0 70 0 0 0 0
{root} 50 90 7 0 0 30 {10 + leg_shift} -40 0 0 0 0 0 70 0 0 0 0
"""


def test_translation_in_a_joint_below_the_root_is_composed(tmp_path):
    text = moved_hips("0 0 -3 0 0 90", "0 93 5 0 0 0")
    motion = bvh.load(write(tmp_path, text), unit="cm", up="z")
    assert motion.skeleton.names[0] == "Hips" and "motion of joint_Root" in motion.notes[0]
    expected = np.array([0, 0, -3]) + turn("Y", 90) @ np.array([0, 93, 5])
    np.testing.assert_allclose(motion.root[0].numpy(), expected / 100, atol=1e-6)
    np.testing.assert_allclose(motion.rot[1, 0].numpy(), turn("Y", 90) @ turn("Y", 30), atol=1e-6)


def test_bones_that_change_their_length_are_refused_or_averaged(tmp_path):
    path = write(tmp_path, moved_hips("0 0 0 0 0 0", "0 93 5 0 0 0", leg_shift=9.0))
    with pytest.raises(DataError, match=r"line 10.*Leg moves.*translations"):
        bvh.load(path)
    motion = bvh.load(path, translations="mean", unit="cm", up="y")
    assert any("Leg moves" in note for note in motion.notes)
    assert abs(float(motion.skeleton.offsets[1, 0]) - 0.145) < 1e-6


def cut(marker: str, text: str = TEXT) -> str:
    return text[: text.index(marker)]


ONE = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n}\nMOTION\nFrames: 1\nFrame Time: 0.1\n5\n"
WRONG = {  # name: (file, words of the message)
    "another format": ('{"Frames": []}', "line 1.*expected HIERARCHY"),
    "no HIERARCHY": (TEXT.replace("HIERARCHY\n", ""), "line 1.*expected HIERARCHY"),
    "no ROOT": (TEXT.replace("ROOT Hips", "JOINT Hips"), "line 2.*expected ROOT"),
    "two ROOTs": (TEXT.replace("JOINT Leg", "ROOT Leg"), "line 15.*ROOT Leg.*one figure a file"),
    "no MOTION": (TEXT.replace("MOTION\n", ""), "line 30.*expected MOTION"),
    "ends in the hierarchy": (cut("JOINT Leg"), "ends before MOTION"),
    "ends after MOTION": (cut("Frames:"), "expected 'Frames:', got ''"),
    "ends after Frames": (cut("Frame Time"), "expected 'Frame Time:', got ''"),
    "ends in a frame": (cut(" 30 -7 8"), "line 34.*expected 17 values, got 14"),
    "frames too few": (TEXT.replace("Frames: 2", "Frames: 4"), "line 31.*promises 4 frames, the file has 2"),
    "frames too many": (TEXT + "1 2 3\n" * 2, "promises 2 frames, the file has 4"),
    "a frame too many, and cut off": (TEXT + "1 2 3\n", "line 35.*expected 17 values, got 3"),
    "NaN": (TEXT.replace("33 12", "nan 12"), "line 33.*value 16 is 'nan'"),
    "a word for a value": (TEXT.replace("33 12", "33 twelve"), "line 33.*value 17 is 'twelve'"),
    "a huge value": (TEXT.replace("33 12", "33 1e20"), "not a usable number"),
    "zero frames": (cut("1 91").replace("Frames: 2", "Frames: 0"), "line 31.*no frames"),
    "frame time zero": (TEXT.replace("0.033333", "0"), "line 32.*frame time"),
    "frame time missing": (TEXT.replace("0.033333", ""), "line 32"),
    "channel count": (TEXT.replace("CHANNELS 3", "CHANNELS 4"), "line 9.*as many as it promises, got 3"),
    "unknown channel": (TEXT.replace("CHANNELS 3 Yrotation", "CHANNELS 3 Yscale"), "line 9.*channels must be"),
    "channel twice": (TEXT.replace("CHANNELS 3 Yrotation", "CHANNELS 3 Zrotation"), "line 9.*different"),
    "offset of two": (TEXT.replace("OFFSET 9 0 0", "OFFSET 9 0"), "line 17.*expected 3 values"),
    "no offset": (TEXT.replace("OFFSET 9 0 0\n", "\n"), "Leg ends without an OFFSET"),
    "duplicate name": (TEXT.replace("JOINT Leg", "JOINT Spine"), "line 15.*second joint named 'Spine'"),
    "no name": (TEXT.replace("JOINT Leg", "JOINT"), "line 15.*without a name"),
    "brace missing": (TEXT.replace("}\nMOTION", "MOTION"), "line 29.*expected .*} of Hips"),
    "brace too many": (TEXT.replace("}\nMOTION", "}\n}\nMOTION"), "line 30.*expected MOTION"),
    "no channels at all": (ONE.replace("CHANNELS 1 Xrotation\n", ""), "no channels"),
    "a point": (ONE, "one point"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_name_file_place_and_remedy(tmp_path, name):
    content, words = WRONG[name]
    with refused(match=words):
        bvh.load(write(tmp_path, content))


def test_names_that_no_loader_reads(tmp_path):
    for name, words in (("a.xyz", r"no loader.*\.bvh"), ("a.asf", r"no loader.*name the \.amc"), ("a", "OpenPose")):
        with pytest.raises(DataError, match=words):
            io.load(tmp_path / name)


def test_deep_nesting_is_only_slow(tmp_path):
    depth = 1500
    head = "".join(f"{'JOINT' if i else 'ROOT'} j{i}\n{{\nOFFSET 0 1 0\nCHANNELS 1 Xrotation\n" for i in range(depth))
    values = " ".join(["1"] * depth)
    text = f"HIERARCHY\n{head}{'}' + chr(10)}".replace("}\n", "}\n" * depth)
    path = write(tmp_path, f"{text}MOTION\nFrames: 1\nFrame Time: 0.1\n{values}\n")
    assert len(bvh.load(path, unit="cm", up="y").skeleton) == depth


@needs_data
def test_agrees_with_bvhio_on_a_recording():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PendingDeprecationWarning)  # bvhio still imports glm by its old name
        import bvhio

    path = DATA / "reactidle" / "003_genuine.bvh"
    ours = bvh.load(path, unit="m", up="z")  # no change of axes
    root = bvhio.readAsHierarchy(str(path))
    for frame in (0, 400, 917):
        root.loadPose(frame, recursive=True)
        for joint, _, _ in root.layout():
            theirs = np.array(joint.PositionWorld)
            # ours keeps the mean of a joint that moves by millimetres against its parent
            assert np.abs(ours.positions[frame, ours.skeleton.index(joint.Name)].numpy() - theirs).max() < 5e-3


@needs_data
def test_bandai_translation_is_in_the_hips_and_sometimes_in_the_root_too():
    folder = DATA / "bandai_namco"
    walk = bvh.load(folder / "dataset-1_walk_normal_001.bvh")
    assert walk.skeleton.names[0] == "Hips" and walk.fps == 30.0
    travelled = (walk.root[-1] - walk.root[0])[:2].norm()
    assert 4 < travelled < 12 and 0.8 < float(walk.root[:, 2].mean()) < 1.0
    moving = [path for path in sorted(folder.glob("*_normal_*.bvh")) if _rows(path)[:, :6].any()]
    assert len(moving) == 4  # joint_Root travels in these, and Hips against it
    for path in moving:
        rows, loaded = _rows(path), bvh.load(path)
        hips = rows[:, 6:9] + rows[:, :3]
        np.testing.assert_allclose(loaded.root.numpy(), hips @ UPRIGHT.numpy().T / 100, atol=1e-5)
        assert "motion of joint_Root" in loaded.notes[0]


def _rows(path: Path) -> np.ndarray:
    return np.loadtxt(path.read_text().split("Frame Time:")[1].splitlines()[1:])


def walker(relative: bool = False, shift: float = 0.0) -> str:
    """Position channels on every joint: at their OFFSETs, or relative to them, as MakeHuman's."""
    six = f"CHANNELS 6 Xposition Yposition Zposition {ROTATIONS}"
    text = TEXT.replace("CHANNELS 3 Yrotation Zrotation Xrotation", six)
    text = text.replace("CHANNELS 2 Xrotation Zrotation", six)
    spine, leg, foot = ("0 0 0", "0 0 0", "0 0 0") if relative else ("0 50 2", "0 9 0", "0 -85 0")
    foot = f"0 {float(foot.split()[1]) + shift} 0"
    row = f"1 91 -2 10 20 30 {spine} 5 -10 15 {leg} 40 0 -20 {foot} 33 12 0\n"
    return text[: text.index("1 91 -2")] + 2 * row


def test_positions_that_count_from_the_offsets_are_not_taken_for_them(tmp_path):
    usual = bvh.load(write(tmp_path, walker()), unit="cm", up="y")
    relative = bvh.load(write(tmp_path, walker(relative=True)), unit="cm", up="y")
    torch.testing.assert_close(relative.positions, usual.positions)
    assert any("count from the OFFSETs" in note for note in relative.notes) and not usual.notes
    moved = bvh.load(write(tmp_path, walker(relative=True, shift=-5.0)), unit="cm", up="y")
    assert moved.skeleton.offsets[moved.skeleton.index("Foot")].norm() == pytest.approx(0.90, abs=1e-6)


TIMES = {  # frame time -> frames per second, words of the note
    "33.333": (30.0, "is taken"), "8.3333": (120.0, "is taken"), "30": (30.0, "is taken"), "1": (1.0, "no usual"),
    "0.0333333": (30.0, ""), "16.67": (60.0, "is taken"), "33": (30.0, "is taken"),
}  # fmt: skip


@pytest.mark.parametrize("line", TIMES)
def test_frame_times_that_cannot_be_are_doubted(tmp_path, line):
    (fps, word), path = TIMES[line], write(tmp_path, TEXT.replace("0.033333", line))
    loaded = bvh.load(path, unit="cm", up="y")
    assert loaded.fps == fps and any(word in note for note in loaded.notes) == bool(word)
    assert bvh.load(path, unit="cm", up="y", fps=25).fps == 25


@pytest.mark.parametrize("line", ["0", "-0.0333", "1e-9"])
def test_a_frame_time_that_says_nothing_can_be_given(tmp_path, line):
    path = write(tmp_path, TEXT.replace("0.033333", line))
    with pytest.raises(DataError, match="--fps-in"):
        bvh.load(path)
    assert bvh.load(path, fps=25).fps == 25


@pytest.mark.parametrize("count", [1, 3])
def test_a_count_of_frames_that_is_off_by_one_is_noted_and_mended_in_writing(tmp_path, count):
    path = write(tmp_path, TEXT.replace("Frames: 2", f"frames:\t{count}").replace("HIERARCHY", "Hierarchy"))
    path.write_text(path.read_text().replace("MOTION", "Motion").replace("ROOT", "Root"))
    loaded = bvh.load(path, unit="cm", up="y")
    assert loaded.frames == 2 and any(f"promises {count}" in note for note in loaded.notes)
    rot = loaded.rot.clone()
    rot[1, 1] = torch.eye(3)
    rewriting.write_back(path, tmp_path / "out.bvh", loaded, replace(loaded, rot=rot))
    again = bvh.load(tmp_path / "out.bvh", unit="cm", up="y")
    assert not again.notes and torch.equal(again.rot[0], loaded.rot[0])
    torch.testing.assert_close(again.rot[1], rot[1], atol=1e-6, rtol=0)


NAMES = [("Hüfte_é", "latin-1", "Latin-1"), ("左足首", "cp932", "Shift-JIS"), ("Hüfte", "utf-8", "")]


@pytest.mark.parametrize(("name", "encoding", "said"), NAMES)
def test_names_that_are_not_utf_8_survive_reading_and_writing(tmp_path, name, encoding, said):
    path = write(tmp_path, TEXT.replace("Hips", name).encode(encoding))
    loaded = bvh.load(path, unit="cm", up="y")
    assert loaded.skeleton.names[0] == name and any(said in note for note in loaded.notes) == bool(said)
    rewriting.write_back(path, tmp_path / "out.bvh", loaded, loaded)
    assert (tmp_path / "out.bvh").read_bytes() == path.read_bytes()
