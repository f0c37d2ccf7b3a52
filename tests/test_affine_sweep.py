"""Notebook 08's sweep with gradients against one dense solve."""

import pytest
import torch

from studies.nb08_fast.affine_sweep import affine_sweep
from tests.draws import draw
from tests.test_humor_gauss_newton_sweep import CLIPS, F64, FRAMES, MANY, N, Z, drawn, energy


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


def dense_least(case, sloped, y):
    """The best controls after a first change (N,), by one dense solve."""
    nothing = torch.zeros(MANY, dtype=F64)
    parts = (getattr(torch.autograd.functional, what) for what in ("hessian", "jacobian"))
    h, g = (part(lambda z: sloped_energy(case, sloped, y, z), nothing) for part in parts)
    return -torch.linalg.solve(h, g)


def test_what_is_walked_is_the_dense_solution(case, sloped):
    found, y = affine_sweep(**sloped), draw(10, CLIPS, N)
    changes, controls = found.walked(sloped["a"], sloped["b"], y)
    best = dense_least(case, sloped, y[0])
    torch.testing.assert_close(controls[0].flatten(), best, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(changes[:, 0], y)
    last = sloped["a"][:, -1] @ changes[:, -2, :, None] + sloped["b"][:, -1] @ controls[:, -1, :, None]
    torch.testing.assert_close(changes[:, -1], last[..., 0])
    wrong = dense_least(case, sloped | {"slope": 0 * sloped["slope"]}, y[0])  # control: gradients matter
    assert (wrong - best).norm() > 0.1 * best.norm()
