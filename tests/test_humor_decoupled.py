"""The decoupled energy: against loops over single transitions, at an exact roll-out; the toy."""

from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.humor import stages, state
from motionlab.humor.energies import KEYPOINTS, RGB_LIGHT
from motionlab.humor.evidence import evidence
from motionlab.humor.rollout import infer, rollout
from motionlab.humor.stages import Problem
from motionlab.humor.unknowns import Unknowns
from studies.nb07_decoupled import energy
from studies.nb07_decoupled.energy import Form, sequences, terms, to_persistent, to_states
from tests.fit_inputs import joints, keypoints


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


@pytest.mark.parametrize("steps", [1, 4, 23])
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


def test_a_whole_roll_out_is_stage_3_of_a_fit(kit, walk, camera):
    """The judge and ``stages.motion_terms`` say the same of the same first state and latents."""
    problem = Problem(evidence(keypoints(walk, camera), cameras=[camera] * 2), kit, RGB_LIGHT)
    states = state.from_motion(walk)
    parts = state.unpack(states[:, 0])
    with torch.no_grad():
        latent = kit.pose.encode(walk.rot[:, 0, 1:]).mean
        z = infer(kit.motion, states)[0].mean
    orient, joints_vel = rotation.matrix_to_sixd(parts["root_orient"]), parts["joints_vel"].flatten(-2)
    same = {name: parts[name] for name in ("trans", "trans_vel", "root_orient_vel")}
    unknown = Unknowns(orient=orient, latent=latent, joints_vel=joints_vel, z=z, **same).map(lambda x: x[:, None])
    unknown = replace(unknown, betas=torch.zeros(2, 8), camera=torch.zeros(2, 3))
    wanted = stages.motion_terms(problem, unknown)
    first = stages.unknowns.first_state(unknown, kit)
    x = to_persistent(torch.cat((first[:, None], states[:, 1:]), 1))
    found, _ = energy.whole(problem, {"x": x, "z": z, "betas": torch.zeros(2, 8)})
    assert set(found) == set(wanted)
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], value, atol=1e-3, rtol=1e-4)


def test_the_energy_of_whole_roll_outs_is_the_judges_and_moves_the_first_state_alone(problem, start):
    judged, _ = energy.whole(problem, start)
    point = {n: x.clone().requires_grad_() for n, x in start.items()}
    found, decoded = terms(problem, point, Form(None))
    assert decoded.states.shape == (2, 1, *start["x"].shape[1:-1], 339)
    for name, value in judged.items():
        torch.testing.assert_close(found[name].detach(), value)
    (gradient,) = torch.autograd.grad(sum(found.values()).sum(), point["x"])
    assert gradient[:, 0].abs().max() > 0 and not gradient[:, 1:].any()
