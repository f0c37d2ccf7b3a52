"""The roll-out by Newton's method must be the roll-out; its linear algebra is checked against dense solves."""

import pytest
import torch

from motionlab.humor import state
from motionlab.humor.rollout import rollout
from motionlab.humor.shooting.derivatives import XI
from motionlab.skeleton import STANDARD
from studies.nb08_fast import parallel_rollout as newton
from studies.shared import workload

STEPS = 6


@pytest.fixture(scope="module")
def chain():
    """A small prior in double precision, a first state in its heading frame (339,), latents (T, 48)."""
    generator = torch.Generator().manual_seed(0)
    model = workload.random_priors(generator, width=32).motion.double()
    rest = STANDARD.offsets.cumsum(0)[None].double()
    rot = torch.eye(3).double().expand(1, 22, 3, 3)
    parts = {
        "trans": torch.tensor([[0.3, -0.2, 0.9]]).double(), "root_orient": rot[:, 0], "pose_body": rot[:, 1:],
        "joints": rest, "trans_vel": torch.zeros(1, 3).double(), "root_orient_vel": torch.zeros(1, 3).double(),
        "joints_vel": torch.zeros(1, 22, 3).double(),
    }  # fmt: skip
    z = torch.randn(STEPS, 48, generator=generator, dtype=torch.float64)
    return model, state.pack(parts), z


def system(size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    a = 0.5 * torch.randn(STEPS, size, size, generator=generator, dtype=torch.float64)
    return a, torch.randn(STEPS, size, generator=generator, dtype=torch.float64)


def dense(a, c):
    """I - A as one matrix (T n, T n), and c as one vector."""
    steps, size = c.shape
    whole = torch.eye(steps * size, dtype=a.dtype)
    for t in range(1, steps):
        whole[t * size : (t + 1) * size, (t - 1) * size : t * size] = -a[t]
    return whole, c.flatten()


def test_recursion_is_the_dense_solve():
    a, c = system(4)
    whole, right = dense(a, c)
    assert torch.allclose(newton.recursed(a, c).flatten(), torch.linalg.solve(whole, right), atol=1e-12)


def test_chain_is_the_library_s_roll_out(chain):
    model, first, z = chain
    with torch.no_grad():
        mine = newton.chained(model, newton.lean(first)[0], z)
        theirs = newton.lean(rollout(model, first, z[None]).states[0])
    assert torch.allclose(mine, theirs, atol=1e-9)


def guess_of(chain, noise):
    model, first, z = chain
    start = newton.lean(first)[0]
    with torch.no_grad():
        exact = newton.chained(model, start, z)
    d = noise * torch.randn(STEPS, XI, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return start, exact, newton.changed(exact, d)


def test_newton_finds_the_roll_out(chain):
    model, _, z = chain
    start, exact, guess = guess_of(chain, 0.05)
    found = newton.newton(model, start, z, guess, iterations=STEPS)
    assert found.errors[0] > 1e-2
    assert found.errors[-1] < 1e-7
    assert torch.allclose(found.states, exact, atol=1e-6)
    assert 0 < found.until(1e-4) <= STEPS
