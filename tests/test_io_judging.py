"""Units and axes: people of every unit, up axis and posture; and that every command says what was guessed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from motionlab import __main__, io, rotation
from motionlab.errors import DataError
from motionlab.io import bvh, judging, smpl
from motionlab.io.points import Positions
from motionlab.io.reading import Location
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT, Skeleton


def person(lean: float = 0.0, turn: float = 0.0, place=(0.0, 0.0, 0.95), frames: int = 12) -> Motion:
    """Swings its legs a little; leans by an angle (a quarter turn lies on the back), then turns about the vertical."""
    time = torch.linspace(0, 6, frames)
    rot = torch.eye(3).repeat(frames, 22, 1, 1)
    for sign, side in ((1, "left"), (-1, "right")):
        rot[:, STANDARD.index(f"{side}_hip")] = rotation.rotation_about("x", 0.2 * sign * time.sin())
    world = rotation.rotation_about("z", torch.tensor(turn)) @ rotation.rotation_about("x", torch.tensor(lean))
    rot[:, 0] = world @ UPRIGHT
    return Motion(STANDARD, torch.tensor(place).repeat(frames, 1), rot, 30.0)


def judged(motion: Motion, **how) -> Motion:
    return judging.to_world(Location("clip"), motion, **how)


@pytest.mark.parametrize("unit", ["m", "dm", "cm", "mm", "inch", "ft"])
@pytest.mark.parametrize("tall", [0.72, 1.0, 1.23])
def test_a_person_s_size_tells_the_unit(tmp_path, unit, tall):
    """Of about 1.25, 1.74 and 2.14 m; an inch of them is no centimetre."""
    motion = person()
    motion = replace(motion, skeleton=motion.skeleton.scaled(tall), root=motion.root * tall)
    bvh.save(tmp_path / "a.bvh", motion, unit=unit)
    loaded = io.load(tmp_path / "a.bvh")
    assert any(f"unit {unit} detected" in note for note in loaded.notes)
    order = loaded.skeleton.indices(STANDARD.names)
    torch.testing.assert_close(loaded.positions[:, order], motion.positions, atol=2e-4, rtol=0)


def test_a_prop_does_not_make_a_giant():
    """A pole of 6 m in the hand: the legs tell that these are metres; without their names it would be 3 m tall."""
    offsets = torch.cat((STANDARD.offsets, torch.tensor([[0.0, 6.0, 0.0]])))
    names = (*STANDARD.names, "pole")
    held = Skeleton(names, (*STANDARD.parents, 20), offsets)
    rot = torch.cat((person().rot, torch.eye(3).expand(12, 1, 3, 3)), 1)
    motion = Motion(held, person().root, rot, 30.0)
    assert any("unit m detected" in note for note in judged(motion).notes)
    unknown = replace(motion, skeleton=replace(held, names=tuple(f"j{k}" for k in range(23))))
    assert not any("unit m detected" in note for note in judged(unknown).notes)


@pytest.mark.parametrize("up", ["y", "z", "-y"])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.95), (3.0, -2.0, 0.95)])
def test_who_stands_tells_what_is_up(tmp_path, up, place):
    bvh.save(tmp_path / "a.bvh", person(place=place), up=up)
    loaded = io.load(tmp_path / "a.bvh")
    assert any(f"up axis {up} detected" in note for note in loaded.notes)
    order = loaded.skeleton.indices(STANDARD.names)
    torch.testing.assert_close(loaded.positions[:, order], person(place=place).positions, atol=1e-5, rtol=0)


@pytest.mark.parametrize("lean", [-1.5708, 1.5708])  # on the back, on the belly
@pytest.mark.parametrize("turn", [0.0, 1.5708, 3.1416, -1.5708])
def test_who_lies_in_a_y_up_file_is_not_stood_up(tmp_path, lean, turn):
    lying = person(lean, turn, (0.1, 0.2, 0.15))
    bvh.save(tmp_path / "a.bvh", lying)
    loaded = io.load(tmp_path / "a.bvh")
    order = loaded.skeleton.indices(STANDARD.names)
    torch.testing.assert_close(loaded.positions[:, order], lying.positions, atol=1e-5, rtol=0)
    assert any("too close to be sure" in note for note in loaded.notes)


@pytest.mark.parametrize("up", ["-y", "x", "-z"])
def test_who_lies_in_a_file_whose_zero_pose_stands_elsewhere(up):
    """Few files are upside down, but this one says so; that the head is before the feet is no reason against it."""
    lying, world = person(-1.5, 0.0, (0.1, 0.2, 0.1)), judging.axes_to_matrix(judging.AXES[up]).float()
    file = world.T @ UPRIGHT  # from the axes of the rest pose to those of the file
    skeleton = replace(STANDARD, offsets=STANDARD.offsets @ file.T)
    rot = file @ lying.rot @ file.T
    rot[:, 0] = world.T @ lying.rot[:, 0] @ file.T
    loaded = judged(Motion(skeleton, lying.root @ world, rot, 30.0))
    torch.testing.assert_close(loaded.positions, lying.positions, atol=1e-5, rtol=0)


def test_smpl_is_z_up_unless_the_heads_say_otherwise(tmp_path):
    standing = person()
    smpl.save_motion(tmp_path / "z.npz", standing)
    np.testing.assert_allclose(smpl.load_motion(tmp_path / "z.npz").root, standing.root, atol=1e-6)
    rot = standing.rot.clone()
    rot[:, 0] = UPRIGHT.T @ rot[:, 0]
    smpl.save_motion(tmp_path / "y.npz", replace(standing, rot=rot, root=standing.root @ UPRIGHT))
    loaded = smpl.load_motion(tmp_path / "y.npz")
    torch.testing.assert_close(loaded.positions, standing.positions, atol=1e-5, rtol=0)
    assert any("up axis y detected" in note for note in loaded.notes)
    given = smpl.load_motion(tmp_path / "y.npz", up="z")
    assert not any("detected" in note for note in given.notes) and given.root[0, 1] == pytest.approx(0.95)


def test_what_is_given_is_taken():
    motion = person()
    turned = judged(motion, unit="cm", axes="x-zy")
    torch.testing.assert_close(turned.root, motion.root[:, [0, 2, 1]] * torch.tensor([0.01, -0.01, 0.01]))
    assert turned.notes == ()
    for wrong in ({"unit": "parsec"}, {"up": "w"}, {"axes": "xxy"}):
        with pytest.raises(ValueError):
            judged(motion, **({"unit": "cm"} | wrong))


def markers(points: torch.Tensor, names: tuple[str, ...]) -> Positions:
    return Positions(names, points, torch.ones(points.shape[:2], dtype=torch.bool), 100.0)


def test_markers_without_a_word_tell_nothing():
    cloud = torch.from_numpy(np.random.default_rng(0).normal(size=(9, 6, 3)))
    with pytest.raises(DataError, match=r"what is up.*--up"):
        judged(markers(cloud, tuple("abcdef")), unit=1.0)
    with pytest.raises(DataError, match=r"the unit.*--unit"):
        judged(markers(cloud, tuple("abcdef")), up="z")


@pytest.mark.parametrize("how", [{}, {"says_up": "y", "trust": 0.5}], ids=["C3D without a screen", "TRC"])
@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("lean", [0.0, -1.5708, 1.5708])
def test_markers_of_who_lies_are_never_turned_without_a_word(how, up, lean):
    """Nothing tells a person who lies from one who stands: those who stand are right, of the others it is said."""
    for turn in torch.arange(0, 6.2, 0.7854).tolist():
        for place in ((0.0, 0.0), (1.5, 0.8), (-2.0, 3.0)):
            truth = person(lean, turn, (*place, 0.95 if lean == 0 else 0.15)).positions
            seen = markers(truth.double() @ judging.axes_to_matrix(judging.AXES[up]), STANDARD.names)
            try:
                found = judging.to_world(Location("clip"), seen, unit=1.0, **how)
            except DataError as error:
                assert lean and "--up" in str(error) and not how
                continue
            assert sum("up axis" in note and "--up" in note for note in found.notes) == 1
            assert lean or torch.allclose(found.positions, truth, atol=1e-5)
            told = judging.to_world(Location("clip"), seen, unit=1.0, says_up=up, trust=9.0)  # where the file says it
            assert torch.allclose(told.positions, truth, atol=1e-5)


@pytest.mark.parametrize("word", ["m", "Meters", "metre", " mm ", "millimeters", "CM", "in", "inches", "Feet"])
def test_words_for_units(word):
    assert judging.unit_named(word) in (1.0, 0.001, 0.01, 0.0254, 0.3048)
    assert judging.unit_named(word + "x") is None


COMMANDS = {
    "convert": ["IN", "OUT.glb", "--bones"],
    "show": ["IN", "--out", "OUT.png", "--bones"],
    "inbetween": ["IN", "--keys", "0,4,last", "--method", "curves", "--out", "OUT.bvh"],
    "repair": ["IN", "--noise", "0", "--method", "curves", "--out", "OUT.bvh"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_says_first_what_was_guessed_and_takes_what_is_given(tmp_path, capsys, name):
    bvh.save(tmp_path / "in.bvh", person(), unit="inch")
    words = [
        word.replace("IN", str(tmp_path / "in.bvh")).replace("OUT", str(tmp_path / "out")) for word in COMMANDS[name]
    ]
    assert __main__.main([name, *words]) == 0
    said = capsys.readouterr().out.splitlines()
    assert "up axis y detected" in said[0] and "unit inch detected" in said[1]
    given = ["--unit", "inch", "--up=y", "--fps-in", "25", "--translations", "mean"]
    assert __main__.main([name, *words, *given]) == 0
    assert "detected" not in capsys.readouterr().out
    assert __main__.main([name, *words, "--asf", "a.asf"]) == 2
    assert "leave out --asf" in capsys.readouterr().err
