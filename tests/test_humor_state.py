"""The state's one order, and the way from and to the official one."""

import pytest
import torch

from motionlab import rotation
from motionlab.humor import state
from motionlab.humor.priors import Cvae, from_weights, official_weights
from motionlab.humor.state import ADDED, OFFICIAL_ORDER, OFFICIAL_SLICES, STATE, VECTORS

OFFICIAL = OFFICIAL_ORDER.argsort()  # ours[..., OFFICIAL] are official states


@pytest.fixture
def states(generator):
    parts = {name: torch.randn(4, *shape, generator=generator) for name, shape in state.SHAPES.items()}
    turned = {name: rotation.random(parts[name].shape[:-2], generator) for name in state.TURNED}
    return state.pack(parts | turned)


def test_parts_go_in_and_out(states):
    parts = state.unpack(states)
    assert torch.equal(state.pack(parts), states)
    assert torch.equal(states[:, 9:75], parts["joints"].flatten(1))
    assert torch.equal(states[:, ADDED:VECTORS], parts["root_orient"].mT.flatten(1))  # row by row of the transposed
    assert sum(state.SHAPES[name] == (3, 3) for name in state.TURNED) == 1


def test_official_states_hold_the_same_parts_elsewhere(states):
    official = states[..., OFFICIAL]
    for name, part in state.unpack(states).items():
        assert torch.equal(official[:, OFFICIAL_SLICES[name]], part.flatten(1)), name
    assert torch.equal(official[..., OFFICIAL_ORDER], states)
    assert not torch.equal(official, states)  # control: it is another order
    assert torch.equal(state.OFFICIAL_DELTA_ORDER.sort().values, torch.arange(state.DELTA))


def test_official_weights_answer_official_states_as_ours_answer_ours(states, generator):
    """A checkpoint's tensors, run on official states by hand, give the official order of what the model gives."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Cvae(64)
    plain = Cvae(64)
    plain.load_state_dict(official_weights(model))
    z = torch.randn(4, model.latent, generator=generator)
    raw, theirs = model.decode(states, z), plain.decode(states[..., OFFICIAL], z)
    torch.testing.assert_close(raw, theirs[:, state.OFFICIAL_DELTA_ORDER], atol=1e-5, rtol=1e-5)
    both = states, states.flip(0)
    ours, others = model.posterior(*both), plain.posterior(*(x[..., OFFICIAL] for x in both))
    torch.testing.assert_close(ours.mean, others.mean, atol=1e-5, rtol=1e-5)
    assert (plain.decode(states, z)[:, state.OFFICIAL_DELTA_ORDER] - raw).abs().max() > 1e-2  # control
    again = from_weights(official_weights(model), "nowhere", "")
    assert all(torch.equal(a, b) for a, b in zip(again.state_dict().values(), model.state_dict().values(), strict=True))
    assert (STATE, state.DELTA) == (339, 216)
