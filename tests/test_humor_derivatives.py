"""Derivatives of a transition and of the prior, against autograd through the paper's form in one, and differences."""

import copy

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.func import jacrev

from motionlab import rotation
from motionlab.humor import gauss_newton, state
from motionlab.humor.gauss_newton import CHANGE, LATENTS, XI
from motionlab.humor.state import ADDED
from tests.rolled_inputs import F64, advanced, between, first_states, network, own, turned

BLOCKS = {"xi": slice(0, XI), "turn": slice(XI, XI + 1), "way": slice(XI + 1, CHANGE)}
COUNT = 3


@pytest.fixture(scope="module", params=[False, True], ids=["official", "with a skip"])
def model(request):
    return network(skip=request.param)


@pytest.fixture(scope="module")
def inputs():
    generator = torch.Generator().manual_seed(0)
    return own(first_states(generator, COUNT)), 0.7 * torch.randn(COUNT, LATENTS, generator=generator, dtype=F64)


@pytest.fixture(scope="module")
def found(model, inputs):
    return gauss_newton.transition_slopes(model, *inputs)


@pytest.fixture(scope="module")
def truth(model, inputs):
    """(N, 210, 210 + 48) by autograd through ``Cvae.decode``, ``state.apply`` and ``state.heading``."""
    x, z = inputs
    middle, frame = advanced(model, x, z, torch.zeros(COUNT, CHANGE, dtype=F64))

    def change(both):
        y, other = advanced(model, x, z + both[CHANGE:], both[:CHANGE].expand(COUNT, -1))
        return between(middle, frame, y, other)

    return jacrev(change)(torch.zeros(CHANGE + LATENTS, dtype=F64))


@pytest.mark.parametrize("cause", [*BLOCKS, "z"])
@pytest.mark.parametrize("effect", BLOCKS)
def test_every_block_of_a_transition_is_that_of_autograd(found, truth, effect, cause):
    theirs = truth[:, BLOCKS[effect], CHANGE:] if cause == "z" else truth[:, BLOCKS[effect], BLOCKS[cause]]
    ours = found.of_z[:, BLOCKS[effect]] if cause == "z" else found.of_change[:, BLOCKS[effect], BLOCKS[cause]]
    torch.testing.assert_close(ours, theirs, atol=1e-10, rtol=1e-10)
    nothing = (effect == "xi" and cause in ("turn", "way")) or (effect, cause) == ("turn", "way")
    assert bool(ours.abs().max() > 1e-12) != nothing  # where a frame stands changes nothing in it


def test_control_rotations_turned_from_the_right_are_noticed(model, inputs, found):
    x, z = inputs
    middle, frame = advanced(model, x, z, torch.zeros(COUNT, CHANGE, dtype=F64))
    matrices = x[:, ADDED:].unflatten(1, (22, 3, 3))  # M = R^T: M w turns from the right
    way = torch.zeros(COUNT, CHANGE, dtype=F64)
    way[:, ADDED:XI] = torch.randn(COUNT, 66, generator=torch.Generator().manual_seed(3), dtype=F64)
    other = way.clone()
    other[:, ADDED:XI] = (matrices.mT @ way[:, ADDED:XI].unflatten(1, (22, 3))[..., None]).flatten(1)
    measured = between(middle, frame, *advanced(model, x, z, 1e-8 * other)) / 1e-8
    ours = (found.of_change @ way[..., None])[..., 0]
    right = (found.of_change @ other[..., None])[..., 0]
    assert (right - measured).abs().max() < 1e-4 and (ours - measured).abs().max() > 0.1


def test_the_priors_slopes_are_those_of_autograd(model, inputs):
    x, _ = inputs
    rows, reference = gauss_newton.prior_slopes(model, x), model.prior(x)
    theirs = jacrev(lambda xi: torch.cat(model.prior(turned(x, xi.expand(COUNT, -1))), -1))(torch.zeros(XI, dtype=F64))
    torch.testing.assert_close(rows, theirs, atol=1e-11, rtol=1e-10)
    assert theirs[..., :ADDED].norm() > 0.1 and theirs[..., ADDED:].norm() > 0.1
    way = torch.randn(COUNT, XI, generator=torch.Generator().manual_seed(4), dtype=F64)
    up, down = (torch.cat(model.prior(turned(x, s * way)), -1) for s in (1e-8, -1e-8))
    torch.testing.assert_close((rows @ way[..., None])[..., 0], (up - down) / 2e-8, atol=1e-5, rtol=1e-5)
    official = turned(x, way * 1e-8)[..., state.OFFICIAL_ORDER.argsort()]  # control: these are others
    assert (torch.cat(model.prior(official), -1) - torch.cat(reference, -1)).abs().max() > 1e-2


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-8, 1e-4, 0.05, 0.0999, 0.1001, 1.0, 3.1, torch.pi, 5.0])
def test_the_left_jacobian_at_any_angle(generator, size):
    """dR = [J dv] R; by autograd through ours, and by scipy's rotations."""
    v = size * torch.nn.functional.normalize(torch.randn(5, 3, generator=generator, dtype=F64), dim=-1)
    ours = rotation.left_jacobian(v)
    slope = jacrev(lambda d: rotation.exp(v + d))(torch.zeros(3, dtype=F64))  # (5, 3, 3, 3 causes)
    claimed = rotation.skew(ours.mT) @ rotation.exp(v)[:, None]  # (5, 3 causes, 3, 3)
    torch.testing.assert_close(claimed, slope.movedim(-1, 1), atol=1e-10, rtol=0)
    way = np.array([0.3, -0.5, 0.8])
    turns = [Rotation.from_rotvec(v.numpy() + s * way) for s in (1e-6, -1e-6)]
    measured = torch.from_numpy((turns[0] * turns[1].inv()).as_rotvec() / 2e-6)
    torch.testing.assert_close(ours @ torch.from_numpy(way), measured, atol=1e-8, rtol=0)
    if size > 0.04:  # control: the right one is its transpose
        assert (ours.mT @ torch.from_numpy(way) - measured).abs().max() > 1e-2


def test_a_body_on_its_side_has_finite_slopes(model, inputs):
    x, z = (value.clone() for value in inputs)
    side = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=F64)
    x[0, ADDED : ADDED + 9] = side.mT.flatten()
    resting = copy.deepcopy(model)
    for weight in resting.decoder.parameters():
        weight.zero_()
    assert all(part.isfinite().all() for part in gauss_newton.transition_slopes(resting, x, z))
    assert gauss_newton.prior_slopes(model, x).isfinite().all()
