"""Feet are held where they stand, loops close, what goes nowhere stays; and what other systems give is cleaned."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from motionlab import examples, io, rotation
from motionlab.__main__ import main
from motionlab.animate import looping, restore
from motionlab.baselines import Noise
from motionlab.errors import DataError
from motionlab.metrics import jitter, slide_where_truth_stands_mm
from motionlab.motion import Motion
from motionlab.retarget import retarget
from motionlab.skeleton import FEET, STANDARD, UPRIGHT
from tests import figures

LEGS = STANDARD.indices([f"{side}_{part}" for side in ("left", "right") for part in ("hip", "knee", "ankle")])
STRIDE = slice(44, 78)  # one of the walk that ships: both ends in nearly one pose


@pytest.fixture(scope="module")
def walk() -> Motion:
    return standard(io.load(examples.WALK))


def standard(motion: Motion) -> Motion:
    """The 22 joints in the standard's order, which BVH does not keep."""
    return retarget(motion, floor=False).motion


def slide(motion: Motion, truth: Motion) -> float:
    """Millimetres a frame of ankles and balls where the true ones stand."""
    feet = STANDARD.indices(FEET)
    return float(slide_where_truth_stands_mm(motion.positions[:, feet], truth.positions[:, feet]))


def standing(frames: int = 40, shake: float = 0.0) -> Motion:
    """Somebody who stands; ``shake``: radians by which the left thigh swings forth and back."""
    motion, swing = figures.standing(frames), shake * torch.sin(torch.arange(frames) * 2 * torch.pi / 20)
    motion.rot[:, STANDARD.index("left_hip")] = rotation.rotation_about("x", swing)
    return motion


def rounds(motion: Motion, count: int = 3) -> Tensor:
    """Places (T, 22, 3) of a loop that is played so many times; its last frame is the first of the next round."""
    way = motion.root[-1] - motion.root[0]
    return torch.cat([motion.positions[:-1] + k * way for k in range(count)])


# ------------------------------------------------------------------------------------------------------------- feet
def test_feet_that_slide_are_held_and_only_legs_turn_otherwise(walk):
    walk = walk.cut(0, 90)  # later it stands for seconds: where the root goes on, no leg is long enough
    drift = torch.tensor([0.006, -0.003, 0.0]) * torch.arange(walk.frames)[:, None]  # 6.7 mm a frame
    given = replace(walk, root=walk.root + drift)
    made = looping.planted(given)
    assert slide(given, walk) > 6 and slide(made.motion, walk) < 2
    others = [j for j in range(22) if j not in LEGS]
    assert torch.equal(made.motion.rot[:, others], given.rot[:, others]) and torch.equal(made.motion.root, given.root)
    said = next(note for note in made.notes if "slide" in note).split()
    assert float(said[4]) > 5 and float(said[-2]) < 1


def test_control_who_stands_still_stays_to_the_bit_and_swinging_legs_go_on_swinging():
    still = standing()
    assert torch.equal(looping.planted(still).motion.rot, still.rot)
    swinging = standing(shake=0.8)
    made = looping.planted(swinging).motion
    left = STANDARD.index("left_foot")
    assert (made.positions - swinging.positions)[:, left].norm(dim=-1).max() < 0.1
    assert made.positions[:, left].std(0)[1] > 0.8 * swinging.positions[:, left].std(0)[1]
    with pytest.raises(DataError, match="no speed"):
        looping.planted(still.cut(0, 1))


# ------------------------------------------------------------------------------------------------------------ loops
def test_a_loop_has_no_jump_larger_than_the_motion_inside(walk):
    given = walk.cut(STRIDE.start, STRIDE.stop)
    hasty = float(given.positions.diff(n=2, dim=0).norm(dim=-1).max())
    made = looping.cycled(given).motion
    assert torch.equal(made.rot[-1], made.rot[0]) and made.root[-1, 2] == made.root[0, 2]
    torch.testing.assert_close((made.root[-1] - made.root[0])[:2], (given.root[-1] - given.root[0])[:2])
    assert rounds(made).diff(n=2, dim=0).norm(dim=-1).max() < 1.4 * hasty
    at = given.frames - 1
    seam = rounds(made)[at - 2 : at + 3].diff(dim=0)  # velocity before and behind
    assert (seam[2] - seam[1]).norm(dim=-1).max() < hasty
    assert rounds(given).diff(n=2, dim=0).norm(dim=-1)[at - 2 : at + 1].max() > 3 * hasty  # control: as it was cut


def test_a_loop_holds_feet_over_its_seam_and_without_planting_they_slide(walk):
    given = walk.cut(STRIDE.start, STRIDE.stop)
    slides = []
    for plant in (True, False):
        made = looping.cycled(given, plant=plant).motion
        way, index = made.root[-1] - made.root[0], torch.arange(3 * (made.frames - 1)) % (made.frames - 1)
        root = torch.cat([made.root[:-1] + k * way for k in range(3)])
        every = replace(made, root=root, rot=made.rot[index])
        truth = replace(every, rot=looping.planted(every).motion.rot)
        slides.append(slide(every, truth))
    assert slides[0] < 1.5 < 3 < slides[1]


def test_control_what_is_a_loop_already_stays_as_it_is():
    given = standing(41, shake=0.8)  # two rounds, the last frame is the first
    made = looping.cycled(given, plant=False).motion
    torch.testing.assert_close(made.rot, given.rot, atol=1e-5, rtol=0)
    torch.testing.assert_close(made.root, given.root, atol=1e-6, rtol=0)


def test_ends_of_any_difference_meet_in_the_middle():
    """A turn at steady speed about one axis: at each end half of the whole turn is taken out, and velocity stays."""
    given = standing(31)
    turns = torch.linspace(0, 0.6, 31)
    rot = given.rot.clone()
    rot[:, STANDARD.index("neck")] = rotation.rotation_about("y", turns)
    made = looping.cycled(replace(given, rot=rot), plant=False, blend=0.2).motion
    angle = rotation.matrix_to_axis_angle(made.rot[:, STANDARD.index("neck")])[:, 1]
    assert angle[0] == pytest.approx(0.3, abs=1e-5) and angle[-1] == pytest.approx(0.3, abs=1e-5)
    torch.testing.assert_close(angle[6:25], turns[6:25], atol=1e-5, rtol=0)
    note = looping.cycled(replace(given, rot=rotation.rotation_about("z", turns)[:, None] @ rot), plant=False).notes
    assert any("it turns by 34 degrees" in line for line in note)


def test_what_stays_in_place_keeps_height_and_turns(walk):
    made = looping.cycled(walk, loop=False, in_place=True).motion
    assert not made.root[:, :2].any() and torch.equal(made.root[:, 2], walk.root[:, 2])
    assert torch.equal(made.rot, walk.rot)
    both = looping.cycled(walk.cut(STRIDE.start, STRIDE.stop), in_place=True).motion
    assert not both.root[:, :2].any() and torch.equal(both.rot[-1], both.rot[0])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--loop", "--cut", "0", "0.05"], "make no loop"),
        (["--loop", "--blend", "nan"], "--blend"),
        ([], "--loop, --in-place"),
        (["--in-place", "--cut", "7", "99"], "--cut"),
    ],
)
def test_what_cannot_be_cycled_is_refused_with_a_remedy(words, said, tmp_path, capsys):
    assert main(["cycle", str(examples.WALK), "--out", str(tmp_path / "out.bvh"), *words]) == 2
    error = capsys.readouterr().err
    assert said in error and "remedy" in error and not (tmp_path / "out.bvh").exists()


# --------------------------------------------------------------------------------------------- what other systems give
def as_given(walk: Motion, seed: int, drift: float = 0.12) -> Motion:
    """The walk as a system sees it that reads poses from video: every joint off by 4 degrees about each axis for a
    third of a second, the root drifting by so many m/s along each axis, and a little trembling."""
    draws = torch.Generator().manual_seed(seed)

    def lasting(*shape: int) -> Tensor:
        kernel = torch.exp(-((torch.arange(-32, 33) / 8.0) ** 2) / 2)
        fresh = torch.randn(walk.frames + 64, math.prod(shape), generator=draws)
        smooth = torch.nn.functional.conv1d(fresh.mT[:, None], kernel[None, None])[:, 0].mT
        return (smooth / smooth.std()).unflatten(1, shape)

    turn = math.radians(4) * lasting(22, 3) + math.radians(0.1) * torch.randn(walk.frames, 22, 3, generator=draws)
    shift = (drift / walk.fps * lasting(3)).cumsum(0) * torch.tensor([1.0, 1.0, 0.3])
    return replace(walk, rot=walk.rot @ rotation.exp(turn), root=walk.root + shift, contacts=None)


def root_relative(motion: Motion, truth: Motion) -> float:
    """Millimetres."""
    off = (motion.positions - motion.root[:, None]) - (truth.positions - truth.root[:, None])
    return 1000 * float(off.norm(dim=-1).mean())


def test_repair_cleans_what_gvhmr_gives_from_its_file(walk, tmp_path, capsys):
    """Jitter <= 7 in the unit of their tables (10 m/s^3), feet <= 5 mm a frame, and poses no worse."""
    given = as_given(walk, 1)
    turns = rotation.matrix_to_axis_angle(torch.cat((UPRIGHT.mT @ given.rot[:, :1], given.rot[:, 1:]), 1))
    body = {"global_orient": turns[:, 0], "body_pose": turns[:, 1:].flatten(1), "transl": given.root @ UPRIGHT}
    torch.save({"smpl_params_global": body}, tmp_path / "hmr4d_results.pt")
    out = tmp_path / "out.npz"
    words = ["repair", str(tmp_path / "hmr4d_results.pt"), "--noise", "2,10", "--out", str(out)]
    assert main(words) == 0 and "GVHMR keeps no frame rate: taken as 30" in capsys.readouterr().out
    found = io.load(out)
    before, after = (float(jitter(m.positions, 30.0)) / 10 for m in (given, found))
    assert before > 20 and after < 7
    assert slide(given, walk) > 8 and slide(found, walk) < 5
    assert root_relative(found, walk) < root_relative(given, walk)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_path_that_drifts_goes_by_the_feet(seed, walk):
    """By 0.6 m/s, as TRAM's may: the same limits, and the path is nearer to the true one."""
    given = as_given(walk, seed, drift=0.6)
    noise = Noise.of(2, 1)
    held = restore.repaired(given, noise).motion
    made = restore.repaired(given, noise, drift=True)
    assert float(jitter(made.motion.positions, 30.0)) / 10 < 7 and slide(made.motion, walk) < 5 < 15 < slide(held, walk)
    off, was = ((m.root - walk.root).norm(dim=-1).mean() for m in (made.motion, given))
    assert off < 0.6 * was and root_relative(made.motion, walk) < root_relative(given, walk)
    assert any("the path goes by the feet" in note for note in made.notes)


def test_control_a_path_that_does_not_drift_stays(walk):
    made = restore.repaired(walk, drift=True).motion
    assert (made.root - walk.root).norm(dim=-1).max() < 0.02 and slide(made, walk) <= slide(walk, walk) + 0.1
