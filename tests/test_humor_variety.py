"""The same motion on other bodies: what changes, and what must not."""

import torch

from data_synth.actions import ACTIONS
from data_synth.subjects import SUBJECTS
from motionlab.humor import priors, state
from motionlab.training import chain_training, recipes


def test_other_bodies_keep_angles_and_feet(generator):
    motion = ACTIONS["walk"](SUBJECTS[0], torch.Generator().manual_seed(2)).motion.cut(0, 60)
    other = chain_training.random_body(motion, generator)
    assert torch.equal(other.rot, motion.rot)
    assert (other.skeleton.offsets.norm(dim=-1) / motion.skeleton.offsets.norm(dim=-1).clamp(min=1e-9))[1:].std() > 0.01
    lowest = [m.positions[..., 2].amin(-1) for m in (motion, other)]
    assert (lowest[0] - lowest[1]).abs().max() < 0.04
    made = recipes._first_states([motion], 10, generator)
    assert made.shape == (24, 138)  # itself, its mirror image, and both on other bodies
    world = state.from_motion(motion, causal=True)[::10]
    assert torch.allclose(made[:6], priors.first_state_features(state.localise(world, state.heading(world))), atol=1e-6)
