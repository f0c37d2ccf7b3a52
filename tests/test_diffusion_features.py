"""Rows of numbers and back, and which joint they belong to."""

from dataclasses import replace

import pytest
import torch

from data_synth import scenes
from motionlab import rotation
from motionlab.diffusion.features import Layout, Normaliser, units
from motionlab.errors import DataError, ShapeError
from motionlab.heading import local_to_world, stuck_root

LAYOUTS = [Layout(), Layout(velocities=True), Layout(frame="world"), Layout(contacts=False)]


@pytest.fixture(scope="module")
def motion():
    return scenes.held_out(3)


@pytest.mark.parametrize("layout", LAYOUTS, ids=["stuck", "velocities", "world", "no contacts"])
def test_there_and_back(motion, layout):
    rows = layout.encode(motion)
    assert rows.shape == (3, 60, layout.size)
    found = layout.decode(rows, motion.fps, motion.skeleton)
    if layout.frame == "stuck":
        _, frame = stuck_root(motion)
        found = local_to_world(frame, found)
    assert (found.positions - motion.positions).norm(dim=-1).max() < 1e-5
    if layout.contacts:
        assert torch.equal(found.contacts, motion.contacts)


def test_stuck_rows_do_not_know_where_one_stands(motion):
    turn = rotation.rotation_about("z", torch.tensor(1.1))
    shift = torch.tensor([3.0, -2.0, 0.0])
    rot = motion.rot.clone()
    rot[..., 0, :, :] = turn @ rot[..., 0, :, :]
    moved = replace(motion, root=motion.root @ turn.mT + shift, rot=rot)
    assert (Layout().encode(moved) - Layout().encode(motion)).abs().max() < 1e-5
    assert (Layout(frame="world").encode(moved) - Layout(frame="world").encode(motion)).abs().max() > 1


def test_velocities_are_differences(motion):
    layout = Layout(velocities=True)
    rows = layout.encode(motion)
    root, change = rows[..., layout.slices["root"]], rows[..., layout.slices["root_vel"]]
    torch.testing.assert_close(root[:, 1:] - root[:, :-1], change[:, :-1] / 30, atol=1e-6, rtol=0)


def test_a_joint_s_numbers_are_those_that_it_turns(motion):
    """Changing its numbers moves the joint's children and nothing else; its velocity belongs to it."""
    layout = Layout(frame="world", velocities=True)
    rows = layout.encode(motion)
    owners = units(layout)
    mask, of = owners == motion.skeleton.index("left_elbow"), {n: owners[part] for n, part in layout.slices.items()}
    found = layout.decode(torch.where(mask, rows + 0.3, rows), 30.0, motion.skeleton)
    moved = (found.positions - motion.positions).norm(dim=-1).amax((0, 1))
    names = motion.skeleton.names
    assert {names[j] for j in (moved > 1e-3).nonzero().flatten().tolist()} == {"left_wrist"}
    assert torch.equal(of["rot_vel"], torch.cat((of["orient"], of["pose"]))) and (of["root_vel"] == 22).all()


def test_the_normaliser_undoes_itself(motion):
    layout = Layout()
    rows = layout.encode(motion)
    norm = Normaliser.measure(rows, layout)
    x = norm.apply(rows)
    torch.testing.assert_close(norm.undo(x), rows, atol=1e-5, rtol=1e-5)
    for part in layout.slices.values():
        assert x[..., part].square().mean().sqrt() == pytest.approx(1.0, abs=0.01)
        assert norm.scale[part].unique().numel() == 1  # one scale per group
    still = Normaliser.measure(torch.zeros(5, layout.size), layout)
    assert (still.scale == 1).all()


def test_what_does_not_fit(motion):
    with pytest.raises(DataError, match="contacts"):
        Layout().encode(replace(motion, contacts=None))
    with pytest.raises(ShapeError):
        Layout().decode(torch.zeros(2, 3), 30.0)
    with pytest.raises(ValueError, match="frame"):
        Layout(frame="moon")


def test_a_unit_of_the_root_can_be_given_in_metres(generator):
    layout = Layout()
    rows = torch.randn(50, layout.size, generator=generator)
    plain, ours = Normaliser.measure(rows, layout), Normaliser.measure(rows, layout, root_unit=0.08)
    root = layout.slices["root"]
    assert (ours.scale[root] == torch.tensor(0.08)).all() and (plain.scale[root] > 0.5).all()
    assert torch.equal(ours.scale[root.stop :], plain.scale[root.stop :])
    assert torch.allclose(ours.undo(ours.apply(rows)), rows, atol=1e-5)
