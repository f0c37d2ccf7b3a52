"""HumanML3D's two forms: a figure whose every number is known, and round trips."""

import math

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


def carousel_numbers(speed: float, left: float, frames: int) -> torch.Tensor:
    """The 263 numbers of that figure, as far as they are read: the turn to the left is half a negative one."""
    rest, step = carousel(frames=1)[0], speed / 20
    turned = torch.tensor([-left / 40, -step * math.sin(left / 20), step * math.cos(left / 20), rest[0, 1]])
    level = rest[1:] - rest[0] * torch.tensor([1, 0, 1])
    return torch.cat((turned, level.flatten(), torch.zeros(196))).double().expand(frames, -1)


@pytest.mark.parametrize("left", [0.0, 0.7, -2.6])
def test_the_263_numbers_through_more_than_a_whole_turn(left):
    found = humanml.joints_of(carousel_numbers(1.1, left, 161))
    np.testing.assert_allclose(found, humanml.begun(carousel(1.1, left, 161)), atol=1e-5)


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


def test_files_out_and_in(tmp_path):
    motion = swinging(61, 30.0)
    bvh.save(tmp_path / "a.bvh", motion)
    assert __main__.main(["convert", str(tmp_path / "a.bvh"), str(tmp_path / "a.npy")]) == 0
    array = np.load(tmp_path / "a.npy")
    assert array.shape == (41, 22, 3) and array.dtype == np.float32
    loaded = io.load(tmp_path / "a.npy")
    assert loaded.fps == 20 and any("twisted" in note for note in loaded.notes)
    expected = humanml.begun(motion.positions.double() @ UPRIGHT.double())
    apart = torch.cdist(loaded.positions[0].double(), loaded.positions[0].double()) - torch.cdist(
        expected[0], expected[0]
    )
    assert apart.abs().max() < 1e-3 and -1e-3 < loaded.positions[..., 2].min() < 1e-3
    assert __main__.main(["convert", str(tmp_path / "a.npy"), str(tmp_path / "b.bvh")]) == 0


def test_what_it_is_not(tmp_path):
    for array in (np.zeros((5, 21, 3)), np.zeros((5, 262)), np.full((5, 263), np.nan), np.array("text"), np.zeros(0)):
        np.save(tmp_path / "a.npy", array)
        with pytest.raises(DataError):
            io.load(tmp_path / "a.npy")
    for wrong in (humanml.begun, humanml.joints_of, humanml.motion_of):
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
    found = carousel_numbers(1.1, 0.7, 40).numpy().copy()
    found[::2, 259:] = 1  # feet that stand
    np.save(tmp_path / "b.npy", (found - found.mean(0)) / (found.std(0) + 0.1) * 2)
    with pytest.raises(DataError, match="normalised"):
        io.load(tmp_path / "b.npy")
