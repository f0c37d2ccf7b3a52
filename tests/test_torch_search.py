"""studies.shared.torch_search.minimise: known minima, exact budgets, and what survives NaN and Ctrl-C."""

import math

import pytest
import torch

from motionlab.errors import NotConverged, ShapeError
from studies.shared.torch_search import HUMOR, minimise
from tests.interrupted import interrupted

METHODS = pytest.mark.parametrize("how", [{"method": "lbfgs"}, {"method": "adam", "lr": 0.3}], ids=["lbfgs", "adam"])


def rosenbrock(v):
    x, y = v["x"][0], v["x"][1]
    return (1 - x) ** 2 + 100 * (y - x**2) ** 2


def start(*values):
    return {"x": torch.tensor(values, dtype=torch.float64, requires_grad=True)}


def test_rosenbrock_by_its_own_and_by_the_official_settings():
    """torch's tolerance of 1e-9 is absolute: the official settings leave the energy between 0 and it."""
    found = minimise(rosenbrock, start(-1.2, 1.0))
    assert (found.variables["x"] - 1).abs().max() < 1e-6 and found.converged and found.reason == "gradient"
    assert found.closures == len(found.history) and found.energy == min(found.history)
    official = minimise(rosenbrock, start(-1.2, 1.0), steps=30, **HUMOR)
    assert official.reason == "steps" and 1e-12 < official.energy < 1e-9


@METHODS
@pytest.mark.parametrize("budget", [1, 7])
def test_budget_is_spent_exactly(how, budget):
    found = minimise(rosenbrock, start(-1.2, 1.0), **how, steps=1000, max_closures=budget, tolerance_grad=0.0)
    assert found.closures == budget and found.reason == "closures" and not found.converged


@METHODS
def test_nan_after_the_start_returns_the_best_so_far(how):
    seen = []

    def energy(v):
        seen.append(v["x"].detach().clone())
        return rosenbrock(v) * (math.nan if len(seen) == 6 else 1.0)

    found = minimise(energy, start(-1.2, 1.0), **how)
    assert found.reason == "non-finite" and found.energy == min(found.history[:-1])
    assert torch.equal(found.variables["x"], seen[found.history.index(found.energy)])


@METHODS
def test_interrupt_keeps_the_best(how):
    found = minimise(interrupted(rosenbrock, 10), start(-1.2, 1.0), **how)
    assert found.reason == "interrupted" and found.closures == 9 and found.energy == min(found.history)


def test_wrong_use_is_named():
    for energy in (lambda v: v["x"].log().sum(), lambda v: (v["x"] ** 2).sum().sqrt() * math.nan):
        with pytest.raises(NotConverged, match="start"):
            minimise(energy, start(-1.0))
    with pytest.raises(ValueError, match="method"):
        minimise(rosenbrock, start(1.0, 2.0), method="newton")
    with pytest.raises(ShapeError, match="scalar"):
        minimise(lambda v: v["x"] * 2, start(1.0, 2.0))
    with pytest.raises(ValueError, match="x requires gradients"):
        minimise(rosenbrock, {"x": torch.zeros(2)})
