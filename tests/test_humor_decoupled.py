"""The decoupled energy: against loops over single transitions, and at an exact roll-out."""

import pytest
import torch

from motionlab.humor import state
from motionlab.humor.energies import KEYPOINTS
from motionlab.humor.evidence import evidence
from motionlab.humor.rollout import infer, rollout
from motionlab.humor.stages import Problem
from studies.nb07_decoupled import energy
from studies.nb07_decoupled.energy import Form, sequences, terms, to_persistent, to_states
from tests.fit_inputs import joints


@pytest.fixture(scope="module")
def problem(kit, walk):
    return Problem(evidence(joints(walk)), kit, KEYPOINTS)


@pytest.fixture(scope="module")
def start(kit, walk):
    """States, latents and shape of two walks, a little off."""
    noise = torch.Generator().manual_seed(1)
    states = state.from_motion(walk)
    with torch.no_grad():
        z = infer(kit.motion, states)[0].mean
    x = to_persistent(states)
    x = x + 0.01 * torch.randn(x.shape, generator=noise)
    return {"x": x, "z": z + 0.1 * torch.randn(z.shape, generator=noise), "betas": torch.zeros(2, 8)}


@pytest.fixture(scope="module")
def exact(kit, start):
    """The same, x an exact roll-out."""
    first = to_states(start["x"][:, 0])
    with torch.no_grad():
        states = torch.cat((first[:, None], rollout(kit.motion, first, start["z"]).states), 1)
    return {**start, "x": to_persistent(states)}


def by_hand(model, states, z, steps):
    """x^K_t: min(K, t) single transitions from the state so many frames before, one after the other."""
    found = torch.empty_like(states)
    for b in range(len(states)):
        for t in range(states.shape[1]):
            begin = max(t - steps, 0)
            x = states[b : b + 1, begin]
            for k in range(begin, t):
                frame = state.heading(x)
                local = state.localise(x, frame)
                x = state.globalise(state.apply(local, model.decode(local, z[b : b + 1, k]))[0], frame)
            found[b, t] = x[0]
    return found


def test_sequences_are_single_transitions_in_a_loop(kit, start):
    steps = 5
    states = to_states(start["x"])[:, :9]
    with torch.no_grad():
        found = sequences(kit.motion, states, start["z"][:, :8], steps)
        for k in (1, steps):
            wanted = by_hand(kit.motion, states, start["z"], k)
            torch.testing.assert_close(found.states[:, k - 1], wanted, atol=2e-5, rtol=1e-5)
    assert found.contact_logits.shape == (2, steps, 8, 9)


@pytest.mark.parametrize("steps", [1, 4])
def test_at_an_exact_roll_out_the_energy_is_that_of_stage_3(problem, exact, steps):
    judged, _ = energy.whole(problem, exact)
    with torch.no_grad():
        found, _ = terms(problem, exact, Form(steps))
    assert (found.pop("consistency") < 0.02).all()  # a sum of 24 x 339 differences that are rounding
    assert set(found) == set(judged)
    for name, value in judged.items():
        torch.testing.assert_close(found[name], value, atol=2e-4, rtol=2e-4)


def test_control_off_the_roll_out_the_consistency_is_there(problem, start, exact):
    with torch.no_grad():
        off, on = (terms(problem, u, Form())[0]["consistency"] for u in (start, exact))
    assert (off > 100 * on).all()
