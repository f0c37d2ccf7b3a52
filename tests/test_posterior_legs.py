from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.humor import testops, unknowns
from motionlab.humor.energies import JOINTS
from motionlab.humor.rollout import steered_rollout
from motionlab.humor.shooting import coordinates as shooting_coordinates
from motionlab.humor.shooting.coordinates import FIRST_SIZES, linearised
from motionlab.skeleton import STANDARD
from studies.nb09_posterior import curvature, legs
from tests.fit_inputs import QUICK, joints

LOW = STANDARD.indices([f"{side}_{part}" for side in ("left", "right") for part in ("knee", "ankle", "foot")])


# ------------------------------------------------------------------------------------------------- algebra
def problem(generator, unknowns=12, places=9):
    root = torch.randn(unknowns, unknowns, generator=generator, dtype=torch.float64)
    hessian = root @ root.mT + 0.1 * torch.eye(unknowns)
    return hessian, torch.randn(places, unknowns, generator=generator, dtype=torch.float64)


def test_directions_are_the_main_axes_of_what_may_move(generator):
    hessian, slopes = problem(generator)
    covariance = slopes @ hessian.inverse() @ slopes.mT
    size, axes = torch.linalg.eigh(covariance)
    found = curvature.directions(hessian, slopes, 3)
    assert torch.allclose(found.spread.square(), size.flip(0)[:3], rtol=1e-8)
    assert torch.allclose((found.shapes * axes.flip(1)[:, :3]).sum(0).abs(), torch.ones(3).double(), atol=1e-8)
    assert found.share == pytest.approx(float(size.flip(0)[:3].sum() / size.sum()))
    assert torch.allclose(found.vectors.mT @ hessian @ found.vectors, torch.eye(3).double(), atol=1e-8)
    assert torch.allclose(slopes @ found.vectors, found.shapes * found.spread, atol=1e-8)


# ------------------------------------------------------------------------------------------------- a fitted clip
@pytest.fixture(scope="module")
def hidden(walk):
    mask = torch.zeros(2, 24, 22, dtype=torch.bool)
    mask[:, 8:, LOW] = True
    return joints(walk, mask)


@pytest.fixture(scope="module")
def fitted(hidden, kit):
    return testops.fit(hidden, kit, schedule=QUICK)


@pytest.fixture(scope="module")
def points(fitted, hidden, kit):
    return legs.points(fitted, hidden, kit, frequencies=4)


@pytest.fixture(scope="module")
def clip(points):
    return legs.opened(points[0])


def test_nought_is_the_fit_itself(points, fitted):
    for index, point in enumerate(points):
        expected = sum(term[index] for term in fitted.energies[3].values()) / JOINTS.motion_prior[2]
        assert point.energy(torch.zeros(1, point.size)).item() == pytest.approx(float(expected), abs=0.3)
        moved = point.roll(torch.zeros(1, point.size)).body.joints[0]
        assert (moved - fitted.motion.positions[index]).norm(dim=-1).max() < 1e-3
        assert point.hidden.sum() == 16 * 6 and not point.hidden[:8].any()


def test_half_the_square_of_the_residuals_is_the_energy(points):
    """But for the mixture, the normaliser of the prior and the floor, which are left out of both."""
    point = points[0]
    weights = replace(JOINTS, init_motion_prior=(0, 0, 0), contact_height=(0, 0, 0))
    point = replace(point, problem=replace(point.problem, weights=weights))
    where = torch.randn(3, point.size, generator=torch.Generator().manual_seed(5)) * 0.01
    with torch.no_grad():
        task, unknown = point.at(where)
        rolled = point.roll(where)
        found = 0.5 * curvature.residuals(task, unknown, rolled, rolled).double().square().sum(1)
        constant = 0.5 * (rolled.rollout.prior.log_var + torch.tensor(2 * torch.pi).log()).double().sum((1, 2))
        assert torch.allclose(found + constant, point.energy(where), atol=0.05)
    assert found.std() > 1  # control: they differ from each other


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_the_curvature_is_the_solvers(points, monkeypatch, share):
    """Along any direction: by differences of residuals, and by ``shooting.coordinates``, in which the matrix is the
    identity. Control: with rows for what log sigma tells, which are left out here, it is not."""
    monkeypatch.setattr(shooting_coordinates, "_INFORMATION", share)
    weights = replace(JOINTS, contact_height=(0, 0, 0))  # which the solver counts as parabolas
    point, step = replace(points[0], problem=replace(points[0].problem, weights=weights)), 1e-3
    around = linearised(point.problem, point.unknown)
    here = unknowns.to_matrix(point.unknown.orient)

    def coordinates(q):
        task, unknown = point.at(q)
        first = unknowns.first_state(unknown, task.priors)
        _, x = steered_rollout(task.priors.motion, first, unknown.z[:, 0])
        turn = rotation.log(unknowns.to_matrix(unknown.orient) @ here.mT)
        parts = [turn if n == "orient" else getattr(unknown, n) - getattr(point.unknown, n) for n in FIRST_SIZES]
        change = torch.cat([part.flatten(1) for part in parts] + [unknown.betas - point.unknown.betas], 1)
        gap = unknown.z[:, 0] - around.base - (around.gains @ x[..., None])[..., 0]
        gap = gap - (around.shared @ change[:, None, -8:, None])[..., 0]
        nu = torch.linalg.solve(around.shapers.double(), gap.double()[..., None])
        return torch.cat(
            (nu.flatten(1), torch.linalg.solve(around.first.double(), change.double()[..., None])[..., 0]), 1
        )

    def residuals(q):
        like = point.roll(torch.zeros_like(q))
        return curvature.residuals(point.at(q)[0], point.at(q)[1], point.roll(q), like).double()

    way = torch.randn(6, point.size, generator=torch.Generator().manual_seed(6))
    way[3:, : -4 * 48] = 0.0  # latents alone
    with torch.no_grad():
        ours, theirs = (
            ((f(step * way) - f(-step * way)) / (2 * step)).square().sum(1) for f in (residuals, coordinates)
        )
    off = (theirs / point.nat / ours - 1).abs().max()
    assert off < 0.01 if share == 0 else off > 0.02, off
