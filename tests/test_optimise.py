"""minimise: known minima, exact budgets, and what survives NaN and Ctrl-C."""

import math

import pytest
import torch

from motionlab.errors import NotConverged, ShapeError
from motionlab.optimise import HUMOR, minimise
from tests.interrupted import interrupted


def rosenbrock(v):
    x, y = v["x"][0], v["x"][1]
    return (1 - x) ** 2 + 100 * (y - x**2) ** 2


def start(*values):
    return {"x": torch.tensor(values, dtype=torch.float64, requires_grad=True)}


def test_rosenbrock():
    result = minimise(rosenbrock, start(-1.2, 1.0))
    assert (result.variables["x"] - 1).abs().max() < 1e-6
    assert result.converged and result.reason == "gradient"
    assert result.closures == len(result.history)
    assert result.energy == min(result.history) == rosenbrock(result.variables).item()


def test_humor_settings_stop_where_the_energy_is_small_in_its_own_unit():
    """torch's tolerance of 1e-9 is absolute: the energy stays between 0 and it, the point 4e-5 off, for ever."""
    result = minimise(rosenbrock, start(-1.2, 1.0), steps=30, **HUMOR)
    assert result.reason == "steps" and 1e-12 < result.energy < 1e-9
    assert minimise(lambda v: 1e6 * rosenbrock(v), start(-1.2, 1.0), steps=30, **HUMOR).energy / 1e6 < 1e-14


@pytest.mark.parametrize("method, lr, steps", [("lbfgs", 1.0, 50), ("adam", 0.05, 3000)])
@pytest.mark.parametrize("seed", range(3))
def test_quadratic_has_its_analytic_minimum(method, lr, steps, seed):
    g = torch.Generator().manual_seed(seed)
    a = torch.randn(6, 6, dtype=torch.float64, generator=g)
    a, b = a @ a.mT + torch.eye(6), torch.randn(6, dtype=torch.float64, generator=g)
    result = minimise(
        lambda v: 0.5 * v["x"] @ a @ v["x"] - b @ v["x"], start(*[0.0] * 6), method=method, lr=lr, steps=steps
    )
    assert (result.variables["x"] - torch.linalg.solve(a, b)).abs().max() < 1e-5


@pytest.mark.parametrize("method", ["lbfgs", "adam"])
@pytest.mark.parametrize("budget", [1, 7, 20, 33])
def test_budget_is_spent_exactly(method, budget):
    calls = []

    def energy(v):
        calls.append(1)
        return rosenbrock(v)

    result = minimise(
        energy, start(-1.2, 1.0), method=method, lr=0.01, steps=1000, max_closures=budget, tolerance_grad=0.0
    )
    assert len(calls) == result.closures == budget and result.reason == "closures" and not result.converged


def test_steps_end_it():
    result = minimise(rosenbrock, start(-1.2, 1.0), method="adam", lr=1e-3, steps=12)
    assert result.reason == "steps" and result.closures == 12


def test_two_variables_one_frozen_inputs_untouched():
    free, fixed = torch.zeros(2, requires_grad=True), torch.tensor([3.0, -4.0])
    result = minimise(lambda v: (v["free"] - v["fixed"]).square().sum(), {"free": free, "fixed": fixed})
    assert (result.variables["free"] - fixed).abs().max() < 1e-5
    assert torch.equal(result.variables["fixed"], fixed) and torch.equal(free, torch.zeros(2))
    assert free.grad is None and free.requires_grad
    assert result.variables["free"].data_ptr() != free.data_ptr()
    assert not any(value.requires_grad for value in result.variables.values())


@pytest.mark.parametrize("method, lr", [("lbfgs", 1.0), ("adam", 0.3)])
def test_nan_after_the_start_returns_the_best_so_far(method, lr):
    seen = []

    def energy(v):
        seen.append(v["x"].detach().clone())
        return rosenbrock(v) * (math.nan if len(seen) == 6 else 1.0)

    result = minimise(energy, start(-1.2, 1.0), method=method, lr=lr)
    assert result.reason == "non-finite" and not result.converged and result.closures == 6
    finite = result.history[:-1]
    assert result.energy == min(finite) and math.isnan(result.history[-1])
    assert torch.equal(result.variables["x"], seen[finite.index(min(finite))])


def test_nan_gradient_with_finite_energy_is_not_returned():
    """sqrt has an infinite slope at 0, where 0 * inf = NaN: the energy alone would not tell."""
    with pytest.raises(NotConverged) as error:
        minimise(lambda v: (v["x"] ** 2).sum().sqrt(), start(0.0, 0.0))
    assert error.value.history == [0.0]


def test_nan_at_the_start_raises_with_history():
    with pytest.raises(NotConverged, match="start") as error:
        minimise(lambda v: v["x"].log().sum(), start(-1.0))
    assert len(error.value.history) == 1


@pytest.mark.parametrize("method, lr", [("lbfgs", 1.0), ("adam", 0.3)])
def test_interrupt_keeps_the_best(method, lr):
    result = minimise(interrupted(rosenbrock, 10), start(-1.2, 1.0), method=method, lr=lr)
    assert result.reason == "interrupted" and result.closures == 9
    assert rosenbrock(result.variables).item() == min(result.history) == result.energy


def test_interrupt_before_anything_is_known_goes_through():
    with pytest.raises(KeyboardInterrupt):
        minimise(interrupted(rosenbrock, 1), start(0.0, 0.0))


def test_adam_that_overshoots_returns_the_best_not_the_last():
    result = minimise(lambda v: v["x"].abs().sum(), start(0.95), method="adam", lr=0.5, steps=4)
    assert result.energy == min(result.history) < result.history[-1]
    assert result.variables["x"].abs().sum().item() == result.energy


def test_patience_ends_a_search_that_gains_nothing():
    """A kink: the slope stays 1 at the minimum, so that only a lack of progress can end the search."""
    result = minimise(lambda v: v["x"].abs().sum(), start(0.3, -0.2), steps=500)
    assert result.reason == "no decrease" and result.converged and result.closures < 500


def test_same_twice():
    one, two = (minimise(rosenbrock, start(-1.2, 1.0)) for _ in range(2))
    assert one.history == two.history and torch.equal(one.variables["x"], two.variables["x"])


def test_progress_shows_and_changes_nothing(capsys):
    shown = minimise(rosenbrock, start(-1.2, 1.0), inner=5, progress=True)
    assert "energy" in capsys.readouterr().err
    assert shown.history == minimise(rosenbrock, start(-1.2, 1.0), inner=5).history
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "kind, error, settings, energy",
    [
        ("method", ValueError, {"method": "newton"}, rosenbrock),
        ("vector", ShapeError, {}, lambda v: v["x"] * 2),
    ],
)
def test_wrong_use_is_named(kind, error, settings, energy):
    with pytest.raises(error, match=r"method|scalar"):
        minimise(energy, start(1.0, 2.0), **settings)


def test_nothing_to_move_is_named():
    with pytest.raises(ValueError, match="x requires gradients"):
        minimise(rosenbrock, {"x": torch.zeros(2)})
