"""minimise_batch: what torch's L-BFGS does to each clip alone, whatever its neighbours are."""

import math

import pytest
import torch

from motionlab import optimise
from motionlab.errors import NotConverged, ShapeError
from studies.shared.torch_search import minimise
from tests.interrupted import interrupted


def minimise_batch(energy, variables, **how):
    """Of energies that need not be told which clips still run."""
    return optimise.minimise_batch(lambda v, rows: energy(v), variables, **how)


def rosenbrock(v):
    x = v["x"]
    return ((1 - x[:, :-1]) ** 2 + 100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2).sum(-1)


def starts(clips=7, size=6, seed=0, dtype=torch.float64):
    g = torch.Generator().manual_seed(seed)
    return (1.5 * torch.randn(clips, size, dtype=torch.float64, generator=g)).to(dtype).requires_grad_()


def row(x, b):
    return x[b : b + 1].detach().clone().requires_grad_()


def quadratics(clips=5, size=12, seed=1):
    """Energies of condition 10, 100, ..., and their minima."""
    g = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(clips, size, size, dtype=torch.float64, generator=g))
    values = torch.stack([torch.logspace(0, b + 1, size, dtype=torch.float64) for b in range(clips)])
    a, at = q @ (values[:, :, None] * q.mT), torch.randn(clips, size, dtype=torch.float64, generator=g)

    def energy(v, rows=slice(None)):
        way = v["x"] - at[rows]
        return 0.5 * (way[:, None, :] * a[rows] * way[:, :, None]).sum((-1, -2))

    return energy, at


def closures_of(fit, b):
    return int((fit.history[:, b] > fit.energy[b]).sum()) + 1


@pytest.mark.parametrize("memory", [2, 5, 100])
def test_every_clip_takes_the_path_of_torch(memory):
    """Energies, closure by closure, of one uncut step of torch's own; in a unit that keeps it from ignoring pairs."""
    x, unit = starts(), 1e8
    batch = minimise_batch(lambda v: unit * rosenbrock(v), {"x": x}, memory=memory, tolerance_grad=1e-7 * unit)
    assert set(batch.reasons) == {"gradient"}
    for b in range(len(x)):
        energy, begin = lambda v: unit * rosenbrock({"x": v["x"][None]}).sum(), {"x": x[b].detach().requires_grad_()}
        alone, history = minimise(energy, begin, steps=1, inner=900, memory=memory, tolerance_grad=1e-7 * unit)
        early = slice(0, 25)  # later, rounding has grown
        assert torch.allclose(batch.history[early, b], torch.tensor(history).double()[early], rtol=1e-6)
        assert abs(closures_of(batch, b) - len(history)) <= 0.1 * len(history)
        assert (batch.variables["x"][b] - alone["x"]).abs().max() < 1e-6


def test_quadratics_of_any_condition():
    """As good as torch's own at the same number of closures, up to a condition of 1e5."""
    energy, at = quadratics()
    x = torch.zeros_like(at)
    batch = optimise.minimise_batch(energy, {"x": x}, tolerance_grad=1e-9)
    assert (batch.variables["x"] - at).abs().max() < 1e-8
    for b in range(len(at)):
        mine, begin = lambda v, b=b: energy({"x": v["x"][None]}, [b]).sum(), {"x": x[b].detach().requires_grad_()}
        _, history = minimise(mine, begin, steps=1, inner=900, tolerance_grad=1e-9)
        assert closures_of(batch, b) <= 1.1 * len(history)


@pytest.mark.parametrize(("dtype", "memory"), [(torch.float64, 3), (torch.float32, 100)])
def test_neighbours_change_nothing(dtype, memory):
    """Bit by bit the same iterates alone, among others, and in another order."""
    x = starts(dtype=dtype)
    batch = minimise_batch(rosenbrock, {"x": x}, memory=memory, steps=4)
    order = [3, 0, 6]
    some = minimise_batch(rosenbrock, {"x": x[order].detach().requires_grad_()}, memory=memory, steps=4)
    for k, b in enumerate(order):
        alone = minimise_batch(rosenbrock, {"x": row(x, b)}, memory=memory, steps=4)
        assert torch.equal(alone.history[:, 0], batch.history[: alone.closures, b])
        assert torch.equal(alone.history[:, 0], some.history[: alone.closures, k])
        assert torch.equal(alone.variables["x"][0], batch.variables["x"][b])
        assert alone.reasons[0] == batch.reasons[b] == some.reasons[k]


def test_history_matters_to_the_path():
    """Control of the test above: another memory is seen in the energies."""
    short, long = (minimise_batch(rosenbrock, {"x": starts()}, memory=m) for m in (2, 100))
    assert short.closures != long.closures


def test_energies_are_where_it_says():
    energy, at = quadratics()
    batch = optimise.minimise_batch(energy, {"x": torch.zeros_like(at)}, steps=2)
    assert torch.allclose(batch.energy, energy(batch.variables))
    assert torch.equal(batch.energy, batch.history.amin(0))


def test_only_clips_that_still_run_are_served():
    energy, at = quadratics()
    asked = []

    def counted(v, rows):
        asked.append(len(rows))
        return energy(v, rows)

    x = torch.zeros_like(at)
    fit = optimise.minimise_batch(counted, {"x": x})
    assert asked == sorted(asked, reverse=True) and asked[0] == 5 and asked[-1] == 1
    assert sum(asked) < 0.8 * 5 * fit.closures


@pytest.mark.parametrize("place", ["start", "away"])
def test_a_clip_without_numbers_disturbs_nobody(place):
    x = starts()
    clean = minimise_batch(rosenbrock, {"x": x})

    def broken(v, rows):
        bad = (rows == 2) & ((v["x"] != x[rows]).any(-1) | (place == "start"))
        return rosenbrock(v) + torch.where(bad, math.nan, 0.0)

    hurt = optimise.minimise_batch(broken, {"x": x})
    others = [b for b in range(len(x)) if b != 2]
    assert hurt.reasons[2] == "non-finite"
    assert torch.equal(hurt.variables["x"][2], x[2])
    assert hurt.energy[2] == (math.inf if place == "start" else rosenbrock({"x": x})[2])
    assert torch.equal(hurt.variables["x"][others], clean.variables["x"][others])
    assert torch.equal(hurt.energy[others], clean.energy[others])


def test_a_wall_of_nan_is_backed_away_from():
    """log has no value left of 0: the first steps jump there, the minimum at x = 1/50 is found all the same."""
    x = torch.full((2, 1), 5.0, dtype=torch.float64, requires_grad=True)
    found = minimise_batch(lambda v: (50 * v["x"] - v["x"].log()).sum(-1), {"x": x})
    assert (found.variables["x"] - 0.02).abs().max() < 1e-6 and found.history.isnan().any()
    assert set(found.reasons) <= {"gradient", "no decrease"}


def test_gradient_that_is_not_finite_is_not_returned():
    x = torch.tensor([[1.0, 1.0], [0.0, 0.0]], requires_grad=True)
    found = minimise_batch(lambda v: v["x"].square().sum(-1).sqrt() + 1, {"x": x})
    assert found.reasons[1] == "non-finite" and found.energy[1] == math.inf and found.energy[0] < 1.1


def test_nobody_finite_at_the_start():
    with pytest.raises(NotConverged, match="no clip"):
        minimise_batch(lambda v: v["x"].log().sum(-1), {"x": torch.full((2, 3), -1.0, requires_grad=True)})


def test_variables_of_any_shape_are_found_and_inputs_stay():
    free, one, aim = torch.zeros(3, 2, 2), torch.zeros(3, requires_grad=True), torch.arange(12.0).view(3, 2, 2)
    given = {"free": free, "one": one}

    def energy(v, rows):
        return (v["free"] - aim[rows]).square().sum((-1, -2)) + (v["one"] - 2).square()

    found = optimise.minimise_batch(energy, given)
    assert {name: value.shape for name, value in found.variables.items()} == {"free": (3, 2, 2), "one": (3,)}
    assert (found.variables["free"] - aim).abs().max() < 1e-5 and (found.variables["one"] - 2).abs().max() < 1e-5
    assert not free.any() and not one.any() and one.grad is None
    assert not any(value.requires_grad for value in found.variables.values())


@pytest.mark.parametrize("budget", [0, 1, 2, 9, 33])
def test_budget_is_spent_exactly(budget):
    calls = []

    def energy(v):
        calls.append(1)
        return rosenbrock(v)

    found = minimise_batch(energy, {"x": starts()}, max_closures=budget)
    assert len(calls) == found.closures == budget and set(found.reasons) == {"closures"}


def test_interrupt_keeps_the_best():
    found = minimise_batch(interrupted(rosenbrock, 10), {"x": starts()})
    assert found.closures == 9 and set(found.reasons) == {"interrupted"}
    assert torch.equal(found.energy, found.history.amin(0))
    assert torch.allclose(rosenbrock(found.variables), found.energy)


def test_a_kink_ends_for_lack_of_progress():
    x = torch.tensor([[0.3, -0.2], [7.0, 0.1]], dtype=torch.float64, requires_grad=True)
    found = minimise_batch(lambda v: v["x"].abs().sum(-1), {"x": x}, steps=500)
    assert set(found.reasons) == {"no decrease"} and found.closures < 600


def test_float32_stops_at_its_rounding():
    """An energy of 1e5 knows nothing below 0.01: no closures are burnt on noise, and the place is right."""
    x = torch.full((3, 8), 3.0, requires_grad=True)
    found = minimise_batch(lambda v: 1e5 + ((v["x"] - 1).square() * torch.arange(1.0, 9)).sum(-1), {"x": x})
    assert set(found.reasons) == {"no decrease"} and found.closures < 60
    assert (found.variables["x"] - 1).abs().max() < 0.1 and found.energy.dtype == torch.float32


def test_tolerance_of_change_per_clip():
    """Each clip goes as far as its own number lets it, as it would alone; with the mean of all, none of them does."""
    x, tolerance = starts(4), torch.tensor([1e-1, 0.0, 1e-4, 10.0])
    batch = minimise_batch(rosenbrock, {"x": x}, tolerance_change=tolerance)
    alone = [minimise_batch(rosenbrock, {"x": row(x, b)}, tolerance_change=float(tolerance[b])) for b in range(4)]
    assert all(torch.equal(batch.energy[b], alone[b].energy[0]) for b in range(4))
    mean = minimise_batch(rosenbrock, {"x": x}, tolerance_change=tolerance.mean())  # the control
    assert (mean.energy[:3] > batch.energy[:3]).all()
    with pytest.raises(ShapeError, match="tolerance_change"):
        minimise_batch(rosenbrock, {"x": x}, tolerance_change=tolerance[:3])


def test_an_energy_of_all_clips_together_is_refused():
    with pytest.raises(ShapeError, match="energy"):
        minimise_batch(lambda v: v["x"].sum(), {"x": torch.zeros(3, 2)})
