"""HumanML3D's two forms: a figure whose every number is known, round trips, and signs that must be seen to be wrong."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
import walked

from motionlab import __main__, humanml, io, rotation
from motionlab.errors import DataError, ShapeError
from motionlab.io import bvh
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT
from tests.figures import standing


def carousel(speed: float = 0.0, left: float = 0.0, frames: int = 121) -> torch.Tensor:
    """Joints of a stiff figure that goes forward (m/s) and turns to its left (rad/s), y up, 20 frames a second.

    Facing +z, the left is +x: a turn to the left is one about +y.
    """
    time = torch.arange(frames, dtype=torch.float64) / 20
    turn = rotation.rotation_about("y", left * time)
    ahead = turn[:, :, 2] * speed / 20
    root = torch.cat((torch.zeros(1, 3).double(), ahead[:-1].cumsum(0)))
    rest = STANDARD.rest_positions().double()
    rest = rest - torch.tensor([0, float(rest[:, 1].min()), 0])
    return (turn[:, None] @ rest[..., None])[..., 0] + root[:, None]


MIDDLE = slice(90, -90)  # away from the ends, where the smoothed facing lags


def test_who_walks_straight():
    made = humanml.features(humanml.begun(carousel(speed=1.2)))
    rest = carousel(frames=1)[0]
    assert made.shape == (120, 263)
    np.testing.assert_allclose(made[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(made[:, 1:3], [[0, 1.2 / 20]] * 120, atol=1e-12)
    np.testing.assert_allclose(made[:, 3], rest[0, 1], atol=1e-12)
    np.testing.assert_allclose(
        made[:, 4:67].reshape(-1, 21, 3), (rest[1:] - rest[0] * torch.tensor([1, 0, 1])).expand(120, 21, 3), atol=1e-12
    )
    np.testing.assert_allclose(
        made[:, 193:259].reshape(-1, 22, 3), torch.tensor([0, 0, 0.06]).expand(120, 22, 3), atol=1e-12
    )
    assert not made[:, 259:].any()  # (6 cm)^2 a frame is more than 0.002 m^2: no foot rests
    assert humanml.features(humanml.begun(carousel(speed=0.8)))[:, 259:].all()  # (4 cm)^2 is less


@pytest.mark.parametrize("left", [0.7, -0.7])
def test_who_turns_left_turns_by_a_negative_half(left):
    """The number turns the world back to +z, and is half the angle: the quaternion's."""
    made = humanml.features(humanml.begun(carousel(speed=0.9, left=left, frames=301)))
    np.testing.assert_allclose(made[MIDDLE, 0], -left / 20 / 2, atol=1e-9)
    np.testing.assert_allclose(made[MIDDLE, 1], -0.045 * math.sin(left / 20), atol=1e-9)  # as the next frame faces
    np.testing.assert_allclose(made[MIDDLE, 2], 0.045 * math.cos(left / 20), atol=1e-9)
    hand = made[MIDDLE, 4:67].reshape(-1, 21, 3)[:, STANDARD.index("left_wrist") - 1]
    assert (hand[:, 0] > 0.4).all()  # the left is +x all the time


@pytest.mark.parametrize("left", [0.0, 1.5, -2.6])
def test_the_way_back_through_more_than_a_whole_turn(left):
    joints = humanml.begun(carousel(speed=1.1, left=left, frames=161))
    back = humanml.joints_of(humanml.features(joints))
    np.testing.assert_allclose(back, joints[:-1], atol=1e-9)
    wrong = humanml.features(joints)
    wrong[:, 0] *= -1
    assert left == 0 or (humanml.joints_of(wrong) - joints[:-1]).abs().max() > 0.5


def test_the_rotations_put_every_bone_where_it_is():
    """From the 126 numbers, as the public code goes along its chains, with arms that begin anew at the root's."""
    motion = swinging()
    joints = humanml.begun(motion.positions.double() @ UPRIGHT.double())
    made = humanml.features(joints)
    turned = rotation.sixd_to_matrix(made[:, 67:193].reshape(-1, 21, 6))
    face = rotation.rotation_about("y", torch.cat((torch.zeros(1).double(), 2 * made[:-1, 0].cumsum(0))))
    for chain in humanml._CHAINS:
        above = face
        for a, b in pairwise(chain):
            above = above @ turned[:, b - 1]
            bone = joints[:-1, b] - joints[:-1, a]
            direction = above @ torch.tensor(humanml._AXES[b]).double()
            np.testing.assert_allclose(direction, bone / bone.norm(dim=-1, keepdim=True), atol=1e-9)


def swinging(frames: int = 41, fps: float = 20.0) -> Motion:
    draw = torch.Generator().manual_seed(2)
    phase = torch.linspace(0, 6, frames)[:, None, None] + 6 * torch.rand(22, 3, generator=draw)
    rot = rotation.exp(0.4 * phase.sin())
    rot[:, 0] = rotation.rotation_about("z", torch.linspace(0, 2.5, frames)) @ UPRIGHT @ rot[:, 0]
    return Motion(
        STANDARD, torch.stack((phase[:, 0, 0] / 9, phase[:, 1, 0] / 7, 0.9 + 0 * phase[:, 0, 0]), -1), rot, fps
    )


def test_a_motion_stands_at_its_joints():
    joints = swinging().positions.double()
    made = humanml.motion_of(joints)
    assert (made.positions - joints).norm(dim=-1).max() < 1e-4
    assert (made.skeleton.offsets[1:].norm(dim=-1) - STANDARD.offsets[1:].norm(dim=-1)).abs().max() < 1e-4


@pytest.mark.parametrize("words", [[], ["--features"]])
def test_files_out_and_in(tmp_path, capsys, words):
    motion = swinging(61, 30.0)
    bvh.save(tmp_path / "a.bvh", motion)
    assert __main__.main(["convert", str(tmp_path / "a.bvh"), str(tmp_path / "a.npy"), *words]) == 0
    array = np.load(tmp_path / "a.npy")
    assert array.shape == ((40, 263) if words else (41, 22, 3)) and array.dtype == np.float32
    loaded = io.load(tmp_path / "a.npy")
    assert loaded.fps == 20 and any("twisted" in note for note in loaded.notes)
    expected = humanml.begun(motion.positions.double() @ UPRIGHT.double())
    apart = torch.cdist(loaded.positions[0].double(), loaded.positions[0].double()) - torch.cdist(
        expected[0], expected[0]
    )
    assert apart.abs().max() < 1e-3 and -1e-3 < loaded.positions[..., 2].min() < (0.02 if words else 1e-3)
    assert __main__.main(["convert", str(tmp_path / "a.npy"), str(tmp_path / "b.bvh")]) == 0
    assert __main__.main(["convert", str(tmp_path / "a.npy"), str(tmp_path / "b.bvh"), "--features"]) == 2
    assert "leave out --features" in capsys.readouterr().err


def test_what_it_is_not(tmp_path):
    for array in (np.zeros((5, 21, 3)), np.zeros((5, 262)), np.full((5, 263), np.nan), np.array("text"), np.zeros(0)):
        np.save(tmp_path / "a.npy", array)
        with pytest.raises(DataError):
            io.load(tmp_path / "a.npy")
    for wrong in (humanml.features, humanml.begun, humanml.joints_of, humanml.motion_of):
        with pytest.raises(ShapeError):
            wrong(torch.zeros(5, 21, 3))
    holed = standing()
    holed.root[1, 2] = torch.nan
    with pytest.raises(DataError, match="finite"):
        humanml.save(tmp_path / "b.npy", holed)


def test_features_that_are_normalised_and_joints_that_are_mirrored_are_told(tmp_path):
    joints = humanml.begun(walked.walk(40).positions.double() @ UPRIGHT.double())
    for mirrored in (False, True):
        np.save(tmp_path / "a.npy", (joints * torch.tensor([-1.0 if mirrored else 1.0, 1.0, 1.0])).numpy())
        assert any("left-handed" in note for note in io.load(tmp_path / "a.npy").notes) == mirrored
    found = humanml.features(joints).numpy()
    np.save(tmp_path / "b.npy", (found - found.mean(0)) / (found.std(0) + 0.1) * 2)
    with pytest.raises(DataError, match="normalised"):
        io.load(tmp_path / "b.npy")
