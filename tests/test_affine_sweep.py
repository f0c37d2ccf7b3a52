"""Notebook 08's sweep with gradients against one dense solve."""

import pytest
import torch

from studies.nb08_fast.affine_sweep import affine_sweep
from tests.test_humor_gauss_newton_sweep import CLIPS, F64, FRAMES, MANY, N, Z, draw, drawn, energy, swept


@pytest.fixture(scope="module")
def case():
    return drawn()


@pytest.fixture(scope="module")
def sloped(case):
    """What the affine sweep takes: the same energy with gradients, and something that holds the controls."""
    held = draw(7, CLIPS, FRAMES - 1, Z, Z)
    return {
        "of_frame": case["frame"].mT @ case["frame"],
        "a": case["a"],
        "b": case["b"],
        "rows": case["pair"],
        "of_control": held.mT @ held + torch.eye(Z, dtype=F64),
        "slope": draw(8, CLIPS, FRAMES, N),
        "control_slope": draw(9, CLIPS, FRAMES - 1, Z),
    }


def sloped_energy(case, sloped, y, z):
    """Of a first change (N,) and controls ((T - 1) Z,) of the first clip."""
    z = z.unflatten(0, (FRAMES - 1, Z))
    one = {name: value[:1] for name, value in case.items()}
    total = energy(one, y[None], z[None])[0] + 0.5 * torch.einsum("ti,tij,tj->", z, sloped["of_control"][0], z)
    for t in range(FRAMES):
        total = total + sloped["slope"][0, t] @ y
        if t < FRAMES - 1:
            total = total + sloped["control_slope"][0, t] @ z[t]
            y = case["a"][0, t] @ y + case["b"][0, t] @ z[t]
    return total


def least(quadratic, at):
    """Where a quadratic function is least, by one dense solve."""
    h, g = (getattr(torch.autograd.functional, what)(quadratic, at) for what in ("hessian", "jacobian"))
    return at - torch.linalg.solve(h, g)


def dense_least(case, sloped, y):
    """The best controls after a first change (N,), and what they cost, by one dense solve."""
    nothing = torch.zeros(MANY, dtype=F64)
    best = least(lambda z: sloped_energy(case, sloped, y, z), nothing)
    return best, sloped_energy(case, sloped, y, best)


def test_what_is_walked_is_the_dense_solution(case, sloped):
    found, y = affine_sweep(**sloped), draw(10, CLIPS, N)
    changes, controls = found.walked(sloped["a"], sloped["b"], y)
    best, _ = dense_least(case, sloped, y[0])
    torch.testing.assert_close(controls[0].flatten(), best, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(changes[:, 0], y)
    last = sloped["a"][:, -1] @ changes[:, -2, :, None] + sloped["b"][:, -1] @ controls[:, -1, :, None]
    torch.testing.assert_close(changes[:, -1], last[..., 0])
    wrong, _ = dense_least(case, sloped | {"slope": 0 * sloped["slope"]}, y[0])  # control: gradients matter
    assert (wrong - best).norm() > 0.1 * best.norm()


def test_cost_and_slope_of_the_first_change_are_those_of_the_least(case, sloped):
    found, nothing = affine_sweep(**sloped), torch.zeros(N, dtype=F64)
    base = dense_least(case, sloped, nothing)[1]
    for number in range(3):
        y = draw(11 + number, N)
        claimed = 0.5 * y @ found.first[0] @ y + found.slope[0] @ y
        torch.testing.assert_close(dense_least(case, sloped, y)[1] - base, claimed, atol=1e-8, rtol=1e-9)


def test_without_gradients_the_gains_are_those_of_the_plain_sweep(case, sloped):
    eye = torch.eye(Z, dtype=F64).expand(CLIPS, FRAMES - 1, Z, Z)
    still = {name: 0 * sloped[name] for name in ("slope", "control_slope")}
    found, plain = affine_sweep(**sloped | still | {"of_control": 0.3 * eye}), swept(case, 0.3)
    torch.testing.assert_close(found.gains, plain.gains, atol=1e-10, rtol=1e-9)
    torch.testing.assert_close(found.first, plain.first, atol=1e-10, rtol=1e-9)
    assert not found.offsets.any() and not found.slope.any()
