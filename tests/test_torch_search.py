"""The search that 02 and 03 were measured with: a known minimum, and budgets spent exactly."""

import pytest
import torch

from studies.shared.torch_search import minimise

METHODS = pytest.mark.parametrize("how", [{"method": "lbfgs"}, {"method": "adam", "lr": 0.3}], ids=["lbfgs", "adam"])


def rosenbrock(v):
    x, y = v["x"][0], v["x"][1]
    return (1 - x) ** 2 + 100 * (y - x**2) ** 2


def start(*values):
    return {"x": torch.tensor(values, dtype=torch.float64, requires_grad=True)}


def test_rosenbrock():
    found = minimise(rosenbrock, start(-1.2, 1.0))
    assert (found.variables["x"] - 1).abs().max() < 1e-6 and found.reason == "gradient"
    assert found.closures == len(found.history) and found.energy == min(found.history)


@METHODS
@pytest.mark.parametrize("budget", [1, 7])
def test_budget_is_spent_exactly(how, budget):
    found = minimise(rosenbrock, start(-1.2, 1.0), **how, steps=1000, max_closures=budget, tolerance_grad=0.0)
    assert found.closures == budget and found.reason == "closures"
