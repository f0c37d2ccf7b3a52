"""The same motion on other bodies, held another way: what changes, and what must not."""

from dataclasses import replace

import pytest
import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab import rotation, shipped
from motionlab.humor import examples, priors, state
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD
from tests.draws import seeded

LEGS = STANDARD.indices(["pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"])
LOOSE = STANDARD.indices(
    ["spine1", "spine2", "spine3", "neck", "head"]
    + [f"{side}_{name}" for side in ("left", "right") for name in ("collar", "shoulder", "elbow", "wrist", "foot")]
)
HANDS = STANDARD.indices(["left_wrist", "right_wrist"])
EXACT = 1e-6  # float32


def perform(action: str) -> Motion:
    return ACTIONS[action](SUBJECTS[0], torch.Generator().manual_seed(2)).motion


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
    other = examples.other_body(motion, generator)
    assert torch.equal(other.rot, motion.rot)
    assert (other.skeleton.offsets.norm(dim=-1) / motion.skeleton.offsets.norm(dim=-1).clamp(min=1e-9))[1:].std() > 0.01
    lowest = [m.positions[..., 2].amin(-1) for m in (motion, other)]
    assert (lowest[0] - lowest[1]).abs().max() < 0.04
    made = shipped._first_states([motion], 10, generator)
    assert made.shape == (24, 138)  # itself, its mirror image, and both on other bodies
    world = state.from_motion(motion)[::10]
    assert torch.allclose(made[:6], priors.first_state_features(state.localise(world, state.heading(world))), atol=1e-6)


# -------------------------------------------------------------------------------------------- held another way
def test_only_loose_joints_turn(walk):
    held = examples.held_otherwise(walk, seeded(1))
    still = [j for j in range(len(STANDARD)) if j not in LOOSE]
    assert torch.equal(held.rot[:, still], walk.rot[:, still]) and torch.equal(held.root, walk.root)
    assert (turns(walk, held)[:, LOOSE].norm(dim=-1).amax(0) > 0.01).all()  # every one of them does


def test_pelvis_and_legs_stay_where_they_are(walk):
    held = examples.held_otherwise(walk, seeded(1))
    moved = (held.positions - walk.positions).norm(dim=-1)
    assert moved[:, LEGS].max() < EXACT
    assert moved[:, HANDS].max() > 0.02  # control: others do move
    assert torch.equal(held.contacts, walk.contacts)


def test_hands_on_the_floor_do_not_move(floor):
    rests = resting(floor)
    for seed in range(3):
        moved = (examples.held_otherwise(floor, seeded(seed)).positions - floor.positions).norm(dim=-1)[:, HANDS]
        assert moved[rests].max() < 1e-5
        assert moved[~rests].max() > 0.02
    free = examples.held_otherwise(replace(floor, contacts=torch.zeros_like(floor.contacts)), seeded(2))
    assert (free.positions - floor.positions).norm(dim=-1)[rests][:, HANDS].max() > 0.02  # control


# -------------------------------------------------------------------------------------------- contacts, or none
def test_contacts_go_along_and_are_mirrored_with_it(floor):
    varied = examples.varied_motion(floor, seeded(1))
    assert torch.equal(varied.contacts, floor.contacts)
    assert torch.equal(mirror(varied).contacts, mirror(floor).contacts)
    assert not torch.equal(mirror(varied).contacts, floor.contacts)  # control: the sides do differ
    assert torch.equal(examples.varied_motion(mirror(floor), seeded(1)).contacts, mirror(floor).contacts)


@pytest.mark.parametrize("frames", [1, 2, 7])
def test_short_motions(floor, frames):
    begin = int(resting(floor).nonzero()[0])
    short = floor.cut(begin, begin + frames)
    assert torch.allclose(
        examples.varied_motion(short, seeded(1)).rot, short.rot, atol=EXACT
    )  # a hand rests all the time
    assert examples.varied_motion(floor.cut(0, frames), seeded(1)).rot.isfinite().all()
