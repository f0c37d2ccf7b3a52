"""The same motion on other bodies, held another way: what changes, and what must not."""

from dataclasses import replace

import pytest
import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import rotation, train_small
from motionlab.humor import init_gmm, state, variety
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD

LEGS = STANDARD.indices(["pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"])
LOOSE = STANDARD.indices(
    ["spine1", "spine2", "spine3", "neck", "head"]
    + [f"{side}_{name}" for side in ("left", "right") for name in ("collar", "shoulder", "elbow", "wrist", "foot")]
)
HANDS = STANDARD.indices(["left_wrist", "right_wrist"])
EXACT = 1e-6  # float32


def perform(action: str) -> Motion:
    return ACTIONS[action](SUBJECTS[0], torch.Generator().manual_seed(2)).motion


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def walk():
    return perform("walk")


@pytest.fixture(scope="module")
def floor():
    """Down onto hands and knees and up again."""
    motion = perform("floor")
    assert 30 < resting(motion).sum() < motion.frames - 100
    return motion


def resting(motion: Motion) -> torch.Tensor:
    """(T,) bool: frames in which a hand touches the floor."""
    hands = [motion.skeleton.contact_names.index(name) for name in ("left_wrist", "right_wrist")]
    return motion.contacts[:, hands].any(-1)


def turns(motion: Motion, other: Motion) -> torch.Tensor:
    """(T, J, 3): rotation vectors from the one to the other, in the joints' axes."""
    return rotation.log((motion.rot.mT @ other.rot).double())


# ------------------------------------------------------------------------------------------------ other bodies
def test_other_bodies_keep_angles_and_feet(walk, generator):
    motion = walk.cut(0, 60)
    other = variety.other_body(motion, generator)
    assert torch.equal(other.rot, motion.rot)
    assert (other.skeleton.offsets.norm(dim=-1) / motion.skeleton.offsets.norm(dim=-1).clamp(min=1e-9))[1:].std() > 0.01
    lowest = [m.positions[..., 2].amin(-1) for m in (motion, other)]
    assert (lowest[0] - lowest[1]).abs().max() < 0.04
    made = train_small.first_states([motion], 10, generator)
    assert made.shape == (24, 138)  # itself, its mirror image, and both on other bodies
    world = state.from_motion(motion)[::10]
    assert torch.allclose(made[:6], init_gmm.features(state.localise(world, state.heading(world))), atol=1e-6)


def test_feet_of_other_bodies_hardly_slide(walk):
    """Speed, m/s, of joints of the feet that stand; the control keeps the old path under the new legs."""

    def slide(motion: Motion) -> torch.Tensor:
        speed = 30 * motion.positions[:, STANDARD.contact_indices[3:7]].diff(dim=0)[..., :2].norm(dim=-1)
        return speed[(walk.contacts[1:, 3:7] > 0) & (walk.contacts[:-1, 3:7] > 0)].mean()

    others = [variety.other_body(walk, seeded(seed)) for seed in range(8)]
    found = torch.stack([slide(other) for other in others])
    control = torch.stack([slide(replace(other, root=walk.root)) for other in others])
    assert slide(walk) < 1e-3 and found.max() < 0.06
    assert found.mean() < 0.7 * control.mean()


# -------------------------------------------------------------------------------------------- held another way
def test_only_loose_joints_turn(walk):
    held = variety.held_otherwise(walk, seeded(1))
    still = [j for j in range(len(STANDARD)) if j not in LOOSE]
    assert torch.equal(held.rot[:, still], walk.rot[:, still]) and torch.equal(held.root, walk.root)
    assert (turns(walk, held)[:, LOOSE].norm(dim=-1).amax(0) > 0.01).all()  # every one of them does


def test_pelvis_and_legs_stay_where_they_are(walk):
    held = variety.held_otherwise(walk, seeded(1))
    moved = (held.positions - walk.positions).norm(dim=-1)
    assert moved[:, LEGS].max() < EXACT
    assert moved[:, HANDS].max() > 0.02  # control: others do move
    assert torch.equal(held.contacts, walk.contacts)


def test_a_ball_of_the_foot_stays_near(walk):
    """The foot joint lies where the ankle puts it; its own turn only moves what is beyond it."""
    held = variety.held_otherwise(walk, seeded(1))
    feet = STANDARD.indices(["left_foot", "right_foot"])
    assert (held.positions - walk.positions)[:, feet].norm(dim=-1).max() < EXACT


def test_hands_on_the_floor_do_not_move(floor):
    rests = resting(floor)
    for seed in range(3):
        moved = (variety.held_otherwise(floor, seeded(seed)).positions - floor.positions).norm(dim=-1)[:, HANDS]
        assert moved[rests].max() < 1e-5
        assert moved[~rests].max() > 0.02
    free = variety.held_otherwise(replace(floor, contacts=torch.zeros_like(floor.contacts)), seeded(2))
    assert (free.positions - floor.positions).norm(dim=-1)[rests][:, HANDS].max() > 0.02  # control


def test_turns_fade_within_half_a_second_of_a_hand(floor):
    free = variety._free(floor)
    rests = resting(floor)
    assert free[rests].abs().max() < EXACT and (free >= -EXACT).all() and (free <= 1 + EXACT).all()
    near = torch.nn.functional.max_pool1d(rests.float()[None], 2 * 16 + 1, 1, 16)[0] > 0
    assert torch.allclose(free[~near], torch.ones(()), atol=EXACT) and (~near).any()
    assert free.diff().abs().max() < 0.06 + EXACT  # one part in 17 per frame


def test_rotations_stay_rotations(walk, floor):
    for motion in (walk, floor):
        rot = variety.varied(motion, seeded(3)).rot.double()
        assert (rot @ rot.mT - torch.eye(3)).abs().max() < 1e-5
        assert torch.allclose(torch.linalg.det(rot), torch.ones(()).double(), atol=1e-5)


def steps(motion: Motion, held: Motion) -> float:
    """The largest turn, radians, that one frame adds to what the motion does itself."""
    return float(turns(motion, held)[:, LOOSE].diff(dim=0).norm(dim=-1).max())


@pytest.mark.parametrize("seed", range(4))
def test_turns_are_smooth(walk, floor, seed):
    """At most twice what three waves of the fastest rate, each of three standard deviations, add per frame."""
    per_frame = 2 * torch.pi * variety.FASTEST / 30
    wave = 3 * variety.SWAYS * 3
    bound = 2 * wave * per_frame
    assert steps(walk, variety.held_otherwise(walk, seeded(seed))) < bound
    whole = 2 * (wave + 3 * variety.HELD * 3**0.5)  # what fades away in 17 frames around a hand's rest
    assert steps(floor, variety.held_otherwise(floor, seeded(seed))) < bound + whole / 17


def test_control_fast_sways_are_no_longer_smooth(walk, monkeypatch):
    limit = 2 * 9 * variety.SWAYS * 2 * torch.pi * variety.FASTEST / 30
    monkeypatch.setattr(variety, "FASTEST", 15.0)
    assert max(steps(walk, variety.held_otherwise(walk, seeded(seed))) for seed in range(4)) > limit


def test_sizes_are_those_written_down(walk):
    """Over many draws, the turns have the standard deviation of the constant and the waves together."""
    short = walk.cut(0, 40)
    found = torch.cat([turns(short, variety.held_otherwise(short, seeded(seed)))[:, LOOSE] for seed in range(60)])
    waves = 3 * variety.SWAYS**2 / 2
    expected = (4 / 3 * (variety.HELD**2 + waves)) ** 0.5  # twice a uniform number squared is 4/3 in the mean
    assert found.square().mean().sqrt() == pytest.approx(expected, rel=0.1)
    assert found.mean().abs() < 0.02


# ---------------------------------------------------------------------------------------------------- randomness
@pytest.mark.parametrize("make", [variety.other_body, variety.held_otherwise, variety.varied])
def test_the_generator_alone_decides(walk, make):
    motion = walk.cut(0, 30)
    one, same, other = (make(motion, seeded(seed)).positions for seed in (4, 4, 5))
    assert torch.equal(one, same) and (one - other).abs().max() > 0.01


def test_the_motion_itself_is_left_alone(walk):
    before = walk.rot.clone(), walk.root.clone(), walk.skeleton.offsets.clone()
    variety.varied(walk, seeded(1))
    assert all(torch.equal(*pair) for pair in zip(before, (walk.rot, walk.root, walk.skeleton.offsets), strict=True))


# -------------------------------------------------------------------------------------------- contacts, or none
def test_contacts_go_along_and_are_mirrored_with_it(floor):
    varied = variety.varied(floor, seeded(1))
    assert torch.equal(varied.contacts, floor.contacts)
    assert torch.equal(mirror(varied).contacts, mirror(floor).contacts)
    assert not torch.equal(mirror(varied).contacts, floor.contacts)  # control: the sides do differ
    assert torch.equal(variety.varied(mirror(floor), seeded(1)).contacts, mirror(floor).contacts)


def test_a_motion_without_contacts(walk):
    """As one whose hands touch nothing."""
    bare = variety.varied(replace(walk, contacts=None), seeded(1))
    assert bare.contacts is None
    assert torch.equal(bare.rot, variety.varied(walk, seeded(1)).rot)


@pytest.mark.parametrize("frames", [1, 2, 7])
def test_short_motions(floor, frames):
    begin = int(resting(floor).nonzero()[0])
    short = floor.cut(begin, begin + frames)
    assert torch.allclose(variety.varied(short, seeded(1)).rot, short.rot, atol=EXACT)  # a hand rests all the time
    assert variety.varied(floor.cut(0, frames), seeded(1)).rot.isfinite().all()


def test_numbers_keep_their_type(walk):
    double = walk.cut(0, 10).to(torch.float64)
    held = variety.held_otherwise(double, seeded(1))
    assert held.rot.dtype == held.root.dtype == torch.float64
