"""Roll-outs, samples and single steps; no clip sees another. Against a naive loop: ``test_humor_rollout_steered``."""

import signal
import threading

import pytest
import torch

from motionlab import rotation
from motionlab.errors import ShapeError
from motionlab.humor import compiled, state
from motionlab.humor.priors import Cvae
from motionlab.humor.rollout import rollout, sample_rollout
from studies.shared.one_step import decode_ahead
from tests.rolled_inputs import F64, first_states, network


@pytest.fixture(scope="module")
def model():
    return network(64)


def latents(generator, batch, steps):
    return 0.7 * torch.randn(batch, steps, 48, generator=generator, dtype=F64)


def test_one_bad_clip_leaves_the_others_alone(model, generator):
    first, z = first_states(generator, 3), latents(generator, 3, 4)
    whole = rollout(model, first, z)
    z[1, 2] = torch.nan
    leaf = z.clone().requires_grad_()
    out = rollout(model, first, leaf)
    out.states[[0, 2]].square().sum().backward()
    assert torch.equal(out.states[[0, 2]], whole.states[[0, 2]]) and out.states[1, 2:].isnan().any()
    assert leaf.grad[[0, 2]].isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_a_body_exactly_on_its_side_has_no_heading_and_no_nan(model, generator, dtype):
    """The right axis up: the frame keeps its axes, and the gradient is finite."""
    net = Cvae(64).to(dtype).frozen()
    with torch.no_grad():
        net.decoder.net[-1].weight.zero_(), net.decoder.net[-1].bias.zero_()  # the state stays where it is
    first = first_states(generator, 2).to(dtype)
    side = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=dtype)
    first[0, state.SLICES["root_orient"]] = side.flatten()
    x, z = first.clone().requires_grad_(), latents(generator, 2, 3).to(dtype).requires_grad_()
    out = rollout(net, x, z)
    torch.testing.assert_close(out.states[0, -1], first[0], atol=1e-5, rtol=0)
    for slope in torch.autograd.grad(out.states.square().sum() + out.prior.mean.sum(), (x, z)):
        assert slope.isfinite().all()


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-8, 1e-4, 0.05, 0.1001, 1.0, 3.1, torch.pi, 6.3])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_the_turn_of_a_step_at_any_angle(generator, size, dtype):
    net, way = (
        Cvae(64).to(dtype).frozen(),
        torch.nn.functional.normalize(torch.randn(22, 3, generator=generator), dim=1),
    )
    with torch.no_grad():
        net.decoder.net[-1].weight.zero_(), net.decoder.net[-1].bias.zero_()
        net.decoder.net[-1].bias[state.ADDED : state.CHANGES] = size * way.flatten()
    first = first_states(generator, 2).to(dtype)
    found = rollout(net, first, latents(generator, 2, 1).to(dtype), with_prior=False).states[:, 0]
    before, after = (x[:, state.ADDED :].unflatten(1, (22, 3, 3)).mT for x in (first, found))
    local = rotation.exp((size * way).to(dtype))
    assert (after - local @ before)[:, 1:].abs().max() < 20 * torch.finfo(dtype).eps


def test_sample_is_the_roll_out_of_its_own_latents(model, generator):
    first = first_states(generator, 3)
    for drawn in (None, torch.Generator().manual_seed(5)):
        taken = sample_rollout(model, first, 7, generator=drawn)
        again = rollout(model, first, taken.z)
        torch.testing.assert_close(taken.states, again.states, atol=1e-10, rtol=0)
        torch.testing.assert_close(taken.contact_logits, again.contact_logits, atol=1e-10, rtol=0)
        torch.testing.assert_close(taken.prior.mean, again.prior.mean, atol=1e-10, rtol=0)
        torch.testing.assert_close(taken.prior.log_var, again.prior.log_var, atol=1e-10, rtol=0)
        assert (drawn is None) == torch.equal(taken.z, taken.prior.mean)
    other = sample_rollout(model, first, 7, generator=torch.Generator().manual_seed(6))
    assert not torch.equal(other.z, taken.z)


def test_decode_ahead_starts_everywhere(model, generator):
    first, z = first_states(generator, 2), latents(generator, 2, 6)
    states = torch.cat((first[:, None], rollout(model, first, z).states), dim=1)[:, :-1]
    ahead = decode_ahead(model, states, z)
    torch.testing.assert_close(ahead, rollout(model, first, z).states, atol=1e-10, rtol=0)
    other = z.clone()
    other[:, 4] += 1
    changed = (decode_ahead(model, states, other) - ahead).abs().amax((0, 2)) > 1e-6
    assert changed.tolist() == [t == 4 for t in range(6)]


@pytest.mark.parametrize(
    "first, z",
    [((2, 339), (3, 4, 48)), ((2, 338), (2, 4, 48)), ((2, 339), (2, 4, 47)), ((2, 339), (2, 0, 48)), ((339,), (4, 48))],
)
def test_shapes_that_do_not_fit(model, first, z):
    with pytest.raises(ShapeError):
        rollout(model, torch.zeros(first, dtype=F64), torch.zeros(z, dtype=F64))


@pytest.fixture
def interruptible():
    """Ctrl-C is heard, also in a process that was started in the background, where it is not."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_within_compiled_loops_is_heard_when_they_end(model, generator, interruptible):
    """A signal from another thread, wherever it falls: never the SystemError that numba makes of it."""
    first, z = first_states(generator, 1), latents(generator, 1, 200)
    rollout(model, first, z)
    for k in range(12):
        alarm = threading.Timer(0.01 + 0.002 * k, signal.raise_signal, [signal.SIGINT])
        alarm.start()
        with pytest.raises(KeyboardInterrupt):
            for _ in range(1000):
                rollout(model, first, z, with_prior=False)
        alarm.join()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_is_heard_once_and_by_whoever_listened():
    heard, before = [], signal.signal(signal.SIGINT, lambda *said: heard.append(said[0]))
    try:
        with compiled.unbroken():
            signal.raise_signal(signal.SIGINT)
            assert not heard
        assert heard == [signal.SIGINT]
        with pytest.raises(ZeroDivisionError), compiled.unbroken():
            signal.raise_signal(signal.SIGINT)
            raise ZeroDivisionError
    finally:
        signal.signal(signal.SIGINT, before)
