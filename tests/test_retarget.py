"""Retargeting: exact where it can be, measured where it cannot, and refused where a skeleton is not understood."""

from dataclasses import replace

import pytest
import torch

from motionlab import io, metrics, rotation
from motionlab.contact import contacts_from_positions
from motionlab.errors import DataError, ShapeError
from motionlab.ik import two_bone_ik
from motionlab.motion import Motion
from motionlab.retarget import Retargeted, retarget
from motionlab.skeleton import FEET, STANDARD, UPRIGHT, Skeleton
from tests.recorded import DATA, needs_data

SIDES = ("left", "right")


def wild(generator: torch.Generator, frames: int = 6, skeleton: Skeleton = STANDARD) -> Motion:
    """Every joint turned by up to about a radian."""
    turns = 0.5 * torch.randn(frames, len(skeleton), 3, generator=generator, dtype=torch.float64)
    rot = rotation.axis_angle_to_matrix(turns)
    rot[:, 0] = UPRIGHT.double() @ rot[:, 0]
    root = torch.randn(frames, 3, generator=generator, dtype=torch.float64)
    return Motion(skeleton.to(torch.float64), root, rot, 30.0, name="wild")


def reframed(motion: Motion, frames: torch.Tensor, names: tuple[str, ...] | None = None) -> Motion:
    """The same movement with joint j's axes turned by frames[j]: R' = R G_j, offset' = G_parent^T offset."""
    skeleton = motion.skeleton
    parents = list(skeleton.parents)
    offsets = skeleton.offsets.clone()
    offsets[1:] = (frames[parents[1:]].mT @ offsets[1:, :, None])[..., 0]
    world = motion.world[1] @ frames
    rot = torch.cat((world[:, :1], world[:, parents[1:]].mT @ world[:, 1:]), dim=1)
    return replace(
        motion, skeleton=replace(skeleton, offsets=offsets, names=names or skeleton.names, contact_names=()), rot=rot
    )


def without(motion: Motion, keep: list[str]) -> Motion:
    """Only some of the joints; what is left out is rigid."""
    old, stand = motion.skeleton, motion.skeleton.rest_positions()
    rot, names, parents, offsets, local = motion.world[1], [], [], [], []
    for j, name in enumerate(old.names):
        if name in keep:
            up = old.parents[j]
            while up >= 0 and old.names[up] not in keep:
                up = old.parents[up]
            names.append(name)
            parents.append(names.index(old.names[up]) if up >= 0 else -1)
            offsets.append(stand[j] - stand[up] if up >= 0 else stand[j])
            local.append(rot[:, up].mT @ rot[:, j] if up >= 0 else rot[:, j])
    skeleton = Skeleton(tuple(names), tuple(parents), torch.stack(offsets))
    return replace(motion, skeleton=skeleton, rot=torch.stack(local, dim=1))


def assert_same(result, motion: Motion, tolerance: float = 1e-9) -> None:
    assert result.residual < tolerance
    torch.testing.assert_close(result.motion.rot, motion.rot, atol=tolerance, rtol=0)
    lift = torch.tensor([0.0, 0.0, result.floor], dtype=torch.float64)
    torch.testing.assert_close(result.motion.positions, motion.positions + lift, atol=tolerance, rtol=0)


@pytest.mark.parametrize("proportions", ["source", "standard"])
def test_the_standard_skeleton_comes_back_as_it_is(generator, proportions):
    motion = wild(generator)
    assert_same(retarget(motion, proportions=proportions, plant=False), motion)


def test_more_spine_joints_than_three_keep_first_middle_and_last(generator):
    names, parents = ["pelvis"], [-1]
    for i in range(5):
        names.append(f"vertebra{i}")
        parents.append(i)
    table = {n: o for n, o in zip(STANDARD.names, STANDARD.offsets.tolist(), strict=True)}
    offsets = [[0.0, 0.0, 0.0]] + [[0.0, 0.1, 0.0]] * 5
    for name, up in zip(STANDARD.names, STANDARD.parents, strict=True):
        if name != "pelvis" and not name.startswith("spine"):
            up = STANDARD.names[up]
            parents.append(0 if up == "pelvis" else 5 if up == "spine3" else names.index(up))
            names.append(name)
            offsets.append(table[name])
    skeleton = Skeleton(tuple(names), tuple(parents), torch.tensor(offsets))
    result = retarget(wild(generator, skeleton=skeleton))
    assert [result.names[f"spine{i}"] for i in (1, 2, 3)] == ["vertebra0", "vertebra2", "vertebra4"]
    assert 0 < result.residual < 0.05  # two vertebrae less than the source


def test_an_a_pose_at_rest_is_seen_from_the_t_pose(generator):
    motion = wild(generator)
    frames = torch.eye(3, dtype=torch.float64).repeat(22, 1, 1)
    for side, angle in (("left", 0.8), ("right", -0.8)):
        for part in ("shoulder", "elbow", "wrist"):
            frames[STANDARD.index(f"{side}_{part}")] = rotation.rotation_about("z", torch.tensor(angle).double())
    a_pose = reframed(motion, frames)
    hand = a_pose.skeleton.rest_positions()[STANDARD.index("left_wrist")]
    assert hand[1] < STANDARD.rest_positions()[STANDARD.index("left_wrist"), 1] - 0.3
    assert_same(retarget(a_pose), motion)


@pytest.mark.parametrize("to_file", ["z up, facing -y", "z up, facing x", "y up, facing x"])
def test_any_axes_at_rest(generator, to_file):
    columns = {  # where the body's left, up and forward point in the file
        "z up, facing -y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        "z up, facing x": [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        "y up, facing x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    }
    file_from_body = torch.tensor(columns[to_file], dtype=torch.float64).T
    motion = wild(generator)
    assert_same(retarget(reframed(motion, file_from_body.T.expand(22, 3, 3))), motion)


def test_scale_and_floor(generator):
    motion = wild(generator)
    big = replace(
        motion, skeleton=motion.skeleton.scaled(2), root=2 * motion.root + torch.tensor([0.0, 0.0, 5.0]).double()
    )
    leg = float(STANDARD.offsets[[4, 7]].norm(dim=-1).sum())
    small, plain = retarget(big, leg=leg), retarget(motion)
    assert abs(small.scale - 0.5) < 1e-6 and abs(small.floor - plain.floor + 2.5) < 1e-6
    torch.testing.assert_close(small.motion.positions, plain.motion.positions, atol=1e-6, rtol=0)
    balls = plain.motion.positions[:, STANDARD.indices(FEET[2:]), 2].amin(-1)
    assert abs(float(balls.quantile(0.02)) - STANDARD.sole) < 1e-6
    assert retarget(motion, floor=False).floor == 0


def swaying(generator: torch.Generator) -> Motion:
    """Feet that stand still under a pelvis that sways, on a body with long shins and wide hips."""
    offsets = STANDARD.offsets.double().clone()
    offsets[[4, 5]] *= 0.9
    offsets[[7, 8]] *= 1.1
    offsets[[1, 2], 0] *= 1.3
    t = torch.linspace(0, 6.28, 60, dtype=torch.float64)
    rot = torch.eye(3, dtype=torch.float64).repeat(60, 22, 1, 1)
    rot[:, 0] = (
        UPRIGHT.double() @ rotation.rotation_about("y", 0.2 * t.sin()) @ rotation.rotation_about("z", 0.1 * t.cos())
    )
    root = torch.stack((0.08 * t.sin(), 0.05 * t.cos(), 0.85 + 0.03 * (2 * t).sin()), dim=-1)
    body = Motion(replace(STANDARD, offsets=offsets), root, rot, 30.0)
    ankles = torch.tensor([[-0.16, 0.0, 0.09], [0.16, 0.05, 0.09]], dtype=torch.float64)
    body = two_bone_ik(body, ankles.expand(60, 2, 3))
    rot, knees = body.rot.clone(), body.world[1][:, [4, 5]]
    rot[:, [7, 8]] = knees.mT @ UPRIGHT.double()  # soles flat
    return replace(body, rot=rot)


def skates(source: Motion, found: Retargeted) -> tuple[float, float]:
    """Level slide of the feet (balls, else ankles) before and after, mm per frame, where the source's rest."""
    feet = [foot for foot in FEET[2:] if foot in found.names] or FEET[:2]
    before = source.positions[:, source.skeleton.indices([found.names[foot] for foot in feet])]
    after = found.motion.positions[:, STANDARD.indices(feet)]
    rests = contacts_from_positions(before, source.fps, torch.quantile(before[..., 2], 0.02, dim=0))
    level = torch.tensor([1.0, 1.0, 0.0]).to(before)
    return tuple(float(metrics.slide_in_contact_mm(level * points, rests)) for points in (before, after))


def test_feet_that_stood_still_stand_still(generator):
    source = swaying(generator)
    planted = retarget(source, proportions="standard")
    before, after = skates(source, planted)
    assert before < 1e-6 and after < 1e-3
    where, source_at = planted.motion.positions, source.positions
    ball, ankle = (STANDARD.index(f"left_{part}") for part in ("foot", "ankle"))
    torch.testing.assert_close(where[:, ball, :2], source_at[:, ball, :2], atol=1e-6, rtol=0)
    torch.testing.assert_close(where[:, ankle, 2], source_at[:, ankle, 2] + planted.floor, atol=1e-6, rtol=0)
    loose = retarget(source, proportions="standard", plant=False)  # negative control: without IK they slide
    assert skates(source, loose)[1] > 0.3


def test_reach(generator):
    motion = replace(wild(generator), rot=swaying(generator).rot[:6])
    hips = motion.positions[:, motion.skeleton.indices(["left_hip", "right_hip"])]
    away = torch.nn.functional.normalize(torch.randn(6, 2, 3, generator=generator).double(), dim=-1)
    goal = hips + 0.7 * away
    bent = two_bone_ik(motion, goal)
    at = lambda name: bent.positions[:, bent.skeleton.index(name)]  # noqa: E731
    torch.testing.assert_close(torch.stack((at("left_ankle"), at("right_ankle")), 1), goal, atol=1e-9, rtol=0)
    torch.testing.assert_close(bent.world[1][:, [7, 8]], motion.world[1][:, [7, 8]], atol=1e-9, rtol=0)
    far = two_bone_ik(motion, hips + 5 * away)  # out of reach: a straight leg towards the goal
    leg = far.positions[:, [7, 8]] - hips
    assert (torch.nn.functional.cosine_similarity(leg, away, dim=-1) > 0.999).all()
    assert (leg.norm(dim=-1) > 0.99 * 0.9021).all()


def renamed(change) -> Motion:
    names = tuple(change(name) for name in STANDARD.names)
    rot = torch.eye(3).repeat(2, 22, 1, 1)
    return Motion(replace(STANDARD, names=names, contact_names=()), torch.zeros(2, 3), rot, 30.0)


def test_what_is_not_understood_is_refused(generator):
    with pytest.raises(DataError, match=r"joint names: .*called qpelvisz.*found nothing.*--names"):
        retarget(renamed(lambda name: f"q{name.replace('_', '')}z"))
    with pytest.raises(DataError, match=r"right_hip = right_hip.*missing pelvis, left_hip \("):
        retarget(renamed(lambda name: "what" if name == "left_hip" else name))
    swap = {"left": "right", "right": "left"}
    with pytest.raises(DataError, match="rest pose"):  # toes would point backwards
        retarget(renamed(lambda name: "_".join(swap.get(word, word) for word in name.split("_"))))
    along_x = renamed(str)
    offsets = torch.zeros(22, 3)
    offsets[:, 0] = 0.3
    with pytest.raises(DataError, match=r"legs of no length|no pose is found"):
        retarget(replace(along_x, skeleton=replace(along_x.skeleton, offsets=offsets)))
    with pytest.raises(ShapeError):
        retarget(replace(along_x, root=torch.zeros(1, 2, 3), rot=along_x.rot[None]))
    with pytest.raises(ValueError, match="proportions"):
        retarget(along_x, proportions="mine")
    with pytest.raises(ValueError, match="leg"):
        retarget(along_x, leg=-1.0)


WALKS = (  # a walk or run of every source that has one
    "bandai_namco/dataset-1_walk_normal_001.bvh",
    "bandai_namco/dataset-2_run_normal_001.bvh",
    "cmu_amc/02_01.amc",
    "deepmimic/humanoid3d_walk.txt",
    "isaacgym_amp_cmu/amp_humanoid_run.npz",
    "animated_drawings/fair1__zombie.bvh",
)


@needs_data
@pytest.mark.parametrize("proportions", ["source", "standard"])
@pytest.mark.parametrize("name", WALKS)
def test_walkers_look_where_they_go(name, proportions):
    result = retarget(io.load(DATA / name), proportions=proportions)
    motion = result.motion
    facing, going = motion.rot[:, 0, :2, 2], torch.gradient(motion.root[:, :2], dim=0)[0]
    moving = going.norm(dim=-1) * motion.fps > 0.3
    cosine = torch.nn.functional.cosine_similarity(facing[moving], going[moving], dim=-1)
    assert float(cosine.median()) > 0.85
    at = lambda joint: motion.positions[:, STANDARD.index(joint)]  # noqa: E731
    left = -motion.rot[:, 0, :, 0]
    assert (((at("right_hip") - at("left_hip")) * left).sum(-1) > 0.1).all()
    for side in SIDES:
        h, k, a, f = (at(f"{side}_{part}") for part in ("hip", "knee", "ankle", "foot"))
        hinge = torch.linalg.cross(k - h, a - k)  # a knee that bends turns the shin back about the body's left
        bend = torch.asin((hinge.norm(dim=-1) / ((k - h).norm(dim=-1) * (a - k).norm(dim=-1))).clamp(max=1))
        across = motion.world[1][:, STANDARD.index(f"{side}_hip"), :, 0]
        assert ((hinge * across).sum(-1)[bend > 0.3] > 0).all()
        standing = a[:, 2] < a[:, 2].min() + 0.04
        assert (((f - a)[standing, :2] * facing[standing]).sum(-1) > 0).all()


@needs_data
@pytest.mark.parametrize(
    ("name", "limit"),
    [
        ("reactidle/003_genuine.bvh", 0.10),
        ("animated_drawings/rokoko__jesse_dance.bvh", 0.10),
        *((n, 0.10) for n in WALKS),
    ],
)
def test_residual_and_skate_of_recordings(name, limit):
    motion = io.load(DATA / name)
    exact, standard = retarget(motion), retarget(motion, proportions="standard")
    assert exact.residual < 0.025  # the aim
    assert exact.residual <= standard.residual < limit
    for found in (exact, standard):
        before, after = skates(motion, found)
        assert after <= before + 0.01


def test_a_motion_without_usable_frames_is_refused(generator):
    motion = wild(generator)
    with pytest.raises(ShapeError, match="no frames"):
        retarget(motion.cut(0, 0))
    with pytest.raises(DataError, match="not finite"):
        retarget(replace(motion, root=motion.root * torch.nan))
    assert retarget(motion.cut(0, 1)).motion.frames == 1
