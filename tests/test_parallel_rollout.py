"""The roll-out by Newton's method must be the roll-out; its linear algebra is checked against dense solves."""

import pytest
import torch

from motionlab.humor import parallel_rollout as newton
from motionlab.humor import state, workload
from motionlab.humor.rollout import rollout
from motionlab.humor.slopes import XI
from motionlab.skeleton import STANDARD

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


@pytest.mark.parametrize("weight", [0.0, 0.3, 10.0])
def test_damped_is_the_dense_least_squares(weight):
    a, c = system(4)
    whole, right = dense(a, c)
    normal = whole.mT @ whole + weight * torch.eye(len(right)).double()
    assert torch.allclose(
        newton.damped(a, c, weight).flatten(), torch.linalg.solve(normal, whole.mT @ right), atol=1e-10
    )


def test_control_damping_changes_the_answer():
    a, c = system(4)
    assert (newton.damped(a, c, 0.3) - newton.recursed(a, c)).abs().max() > 0.1


def test_change_and_missing_are_inverse(chain):
    _, first, _ = chain
    generator = torch.Generator().manual_seed(3)
    x = newton.lean(first).expand(4, -1)
    d = 0.2 * torch.randn(4, XI, generator=generator, dtype=torch.float64)
    assert torch.allclose(newton.missing(newton.changed(x, d), x), d, atol=1e-9)


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


def test_first_states_are_exact_after_as_many_iterations(chain):
    model, _, z = chain
    start, exact, guess = guess_of(chain, 0.3)
    for k in (1, 3):
        found = newton.newton(model, start, z, guess, iterations=k)
        assert torch.allclose(found.states[:k, :141], exact[:k, :141], atol=1e-8)


def test_control_without_the_jacobians_one_state_an_iteration(chain):
    model, _, z = chain
    start, _, guess = guess_of(chain, 0.3)

    def jacobi(a, c):
        return c

    slow = newton.newton(model, start, z, guess, iterations=3, solve=jacobi)
    fast = newton.newton(model, start, z, guess, iterations=3)
    assert slow.errors[-1] > 10 * fast.errors[-1]
    assert slow.errors[-1] > 1e-4


def test_damped_newton_arrives_too(chain):
    model, _, z = chain
    start, _, guess = guess_of(chain, 0.05)
    found = newton.newton(model, start, z, guess, iterations=30, damping=1.0)
    assert found.errors[-1] < 1e-5


def test_until_wants_it_for_good():
    errors = torch.tensor([1.0, 1e-5, 1.0, 1e-5, 1e-6])
    found = newton.Newton(errors, errors, errors, errors)
    assert found.until(1e-4) == 3
    assert found.until(1e-9) is None
