from dataclasses import replace

import pytest
import torch

from motionlab import rotation
from motionlab.errors import DataError
from motionlab.humor import cases, loop, testops, variables
from motionlab.humor.closed_loop import steered_rollout
from motionlab.humor.weights import JOINTS
from motionlab.posterior import curvature, legs, modes, rivals, trials
from motionlab.posterior.legs import LEGS
from motionlab.skeleton import STANDARD
from tests.fit_inputs import QUICK, joints, keypoints

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


def test_directions_and_rest_together_have_the_whole_covariance(generator):
    hessian, slopes = problem(generator)
    found = curvature.directions(hessian, slopes, 3)
    every = torch.cat((slopes @ found.vectors, slopes @ found.rest), 1)
    assert torch.allclose(every @ every.mT, slopes @ hessian.inverse() @ slopes.mT, atol=1e-8)


def test_no_other_three_directions_hold_more(generator):
    hessian, slopes = problem(generator)
    best = curvature.directions(hessian, slopes, 3)
    white = torch.linalg.cholesky(hessian.inverse())
    for _ in range(20):
        basis = torch.linalg.qr(torch.randn(12, 3, generator=generator, dtype=torch.float64)).Q
        assert (slopes @ white @ basis).square().sum() <= best.spread.square().sum() + 1e-9


def test_slopes_of_a_linear_and_of_a_curved_function():
    matrix = torch.arange(12.0).reshape(3, 4)
    linear, curved = curvature.slopes_of(lambda q: (q @ matrix.mT, q.exp()), 4, step=1e-3, chunk=3)
    assert torch.allclose(linear, matrix.double(), atol=1e-2)
    assert torch.allclose(curved, torch.eye(4).double(), atol=2e-3)


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


def test_keypoints_too(walk, camera, kit):
    seen = modes.without_legs(keypoints(walk, camera))
    fitted = testops.fit(seen, kit, cameras=[camera] * 2, schedule=QUICK)
    (point, _) = legs.points(fitted, seen, kit, frequencies=2)
    expected = sum(term[0] for term in fitted.energies[3].values()) / 0.075
    assert point.energy(torch.zeros(1, point.size)).item() == pytest.approx(float(expected), abs=0.3)
    assert point.hidden.all()


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
    """Along any direction: by differences of residuals, and by the coordinates of ``loop``, in which the matrix is the
    identity. Control: with rows for what log sigma tells, which are left out here, it is not."""
    monkeypatch.setattr(loop, "_INFORMATION", share)
    weights = replace(JOINTS, contact_height=(0, 0, 0))  # which the solver counts as parabolas
    point, step = replace(points[0], problem=replace(points[0].problem, weights=weights)), 1e-3
    around = loop.linearised(point.problem, point.unknown)
    here = variables.to_matrix(point.unknown["orient"])

    def coordinates(q):
        task, unknown = point.at(q)
        first = variables.first_state(unknown, task.priors)
        _, x = steered_rollout(task.priors.motion, first, unknown["z"][:, 0])
        turn = rotation.log(variables.to_matrix(unknown["orient"]) @ here.mT)
        parts = [turn if n == "orient" else unknown[n] - point.unknown[n] for n in loop.FIRST]
        change = torch.cat([part.flatten(1) for part in parts] + [unknown["betas"] - point.unknown["betas"]], 1)
        gap = unknown["z"][:, 0] - around.base - (around.gains @ x[..., None])[..., 0]
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


def test_cosines_are_orthonormal_and_latents_move_in_units_of_their_prior(points):
    point = points[0]
    assert torch.allclose(point.cosine @ point.cosine.mT, torch.eye(4), atol=1e-5)
    q = torch.zeros(1, point.size)
    q[0, -4 * 48] = 1.0  # the lowest frequency of the first latent
    moved = (point.at(q)[1]["z"] - point.unknown["z"])[0, 0]
    assert torch.allclose(moved[:, 0], point.sigma[:, 0] * point.cosine[0], atol=1e-5)
    assert moved[:, 1:].abs().max() == 0


def test_small_moves_along_the_directions_move_the_legs_as_foretold(clip):
    c = 0.05 * torch.eye(4, dtype=torch.float64)
    legs_there = clip.roll(c)[0]
    assert torch.allclose(clip.coordinates(legs_there), c, atol=0.03)
    assert (legs_there[:, ~clip.point.hidden] == 0).all()


def test_log_prob_is_the_energy_and_heat_flattens_it(clip):
    c = torch.tensor([[0.5, 0, 0, 0], [0, 0, 1, 0]], dtype=torch.float64)
    with torch.no_grad():
        q = (clip.centre + c @ clip.directions.vectors.mT).float()
        assert torch.allclose(clip.log_prob(c), -clip.point.energy(q))
        assert torch.allclose(clip.log_prob(c, 4.0), clip.log_prob(c) / 4)


def test_descends_and_never_climbs(clip):
    point = clip.point
    with torch.no_grad():
        here, there = point.energy(torch.stack((torch.zeros(point.size), clip.centre.float())))
    assert there <= here


def test_scatter_of_the_other_directions_has_their_size(clip, generator):
    draws = clip.scatter(3000, generator)
    sizes = clip.slopes @ clip.directions.rest
    assert draws.square().sum((1, 2, 3)).mean() == pytest.approx(float(sizes.square().sum()), rel=0.1)
    assert draws.mean(0).abs().max() < 0.1 * draws.std(0).max() + 1e-6


def away_along(clip, basis):
    """A truth whose error is 1 cm in one direction (M,)."""
    there = clip.roll(torch.zeros(1, clip.size, dtype=torch.float64))[0][0]
    return there + 0.01 * basis.reshape(there.shape).float()


def test_no_rival_holds_more_of_the_variance_than_the_energys_own_directions(clip, walk):
    found = rivals.compared([clip], [legs.truth_about_pelvis(walk.clip(0))], torch.Generator().manual_seed(0))
    ours = found[rivals.OURS][0][0]
    assert ours == pytest.approx(clip.directions.share, abs=1e-6)
    for name, ((variance, error),) in found.items():
        assert 0 < variance <= ours + 1e-9 and 0 < error < 1, name
    for name, basis in rivals.bases(clip).items():
        assert torch.allclose(basis.mT @ basis, torch.eye(4).double(), atol=1e-6), name
        assert basis.reshape(24, 6, 3, 4)[~clip.point.hidden].abs().max() < 1e-9, name


def test_whoever_has_the_errors_direction_holds_all_of_it_and_others_do_not(clip):
    for name, basis in rivals.bases(clip).items():
        truth = away_along(clip, basis[:, 0])
        found = rivals.compared([clip], [truth], torch.Generator().manual_seed(0))
        assert found[name][0][1] == pytest.approx(1.0, abs=1e-3), name
        assert found[rivals.RANDOM][0][1] < 0.9  # control


def test_a_gait_that_comes_later_is_in_the_gaits_directions(clip):
    """And legs that stand still, a fault of neither phase nor size, are not."""
    (rolled,) = clip.roll(torch.zeros(1, clip.size))[1]
    path = rolled.body.joints[0][:, list(LEGS)] - rolled.body.joints[0][:, :1]
    basis = rivals.gait(clip)
    for truth, least, most in ((torch.roll(path, 1, 0), 0.8, 1.0), (path + torch.tensor([0.0, 0, 0.1]), 0.0, 0.3)):
        away = ((truth - path) * clip.point.hidden[..., None]).flatten().double()
        assert least <= rivals.shares(basis, clip, away)[1] <= most


def test_rivals_are_counted_clip_by_clip():
    found = {rivals.OURS: [(0.6, 0.6), (0.5, 0.2)], "other": [(0.4, 0.1), (0.3, 0.5)]}
    ours, other = rivals.rows(found)
    assert other["clips in which the energy's hold more of the error"] == "1 of 2"
    assert ours["of the energy's own variance, %"] == "55 (52 to 58)"


def test_emcee_on_a_hot_clip_reports_a_long_chain(clip):
    generator = torch.Generator().manual_seed(1)
    found = trials.sampled(clip, generator, temperature=30.0, walkers=8, steps=600, draws=20)
    assert found.chain.long_enough and found.c.shape == (20, 4) and found.ways.shape == (20, 24, 6, 3)
    with torch.no_grad():
        assert torch.allclose(found.energy, -30.0 * clip.log_prob(found.c, 30.0), rtol=1e-4)
    assert found.coordinates.std() > 1.0  # a heat of 30 opens it by some standard deviations
    assert trials.sampled(clip, torch.Generator().manual_seed(2), walkers=8, steps=20) is None  # control: too short


def test_nothing_hidden_is_refused(walk, kit):
    seen = joints(walk)
    fitted = testops.fit(seen, kit, schedule=QUICK)
    with pytest.raises(DataError, match="hidden"):
        legs.opened(legs.points(fitted, seen, kit, frequencies=2)[0])


def test_truth_is_told_about_the_pelvis(walk):
    found = legs.truth_about_pelvis(walk.clip(1))
    expected = walk.clip(1).positions[5, LEGS[2]] - walk.clip(1).positions[5, 0]
    assert torch.equal(found[5, 2], expected)


# ------------------------------------------------------------------------------------------------- the other foot
def test_exchanging_legs_twice_changes_nothing_and_once_swaps_the_feet(walk):
    assert torch.allclose(modes.exchanged(modes.exchanged(walk)).rot, walk.rot, atol=1e-6)
    way, back = cases.ahead(walk), cases.ahead(modes.exchanged(walk))
    assert torch.corrcoef(torch.stack((way.flatten(), back.flatten())))[0, 1] < -0.9
    upper = [
        j for j in range(22) if j not in STANDARD.indices([f"{s}_{p}" for s in ("left", "right") for p in modes._PARTS])
    ]
    assert torch.equal(modes.exchanged(walk).rot[:, :, upper], walk.rot[:, :, upper])
    assert (modes.right_foot(walk, walk) == 1).all() and modes.right_foot(modes.exchanged(walk), walk).max() < 0.35


def test_straight_way_begins_and_ends_at_the_two_results(walk, camera, kit):
    seen = modes.without_legs(keypoints(walk, camera))
    fitted = testops.fit(seen, kit, cameras=[camera] * 2, schedule=QUICK)
    found = modes.other_foot(fitted, seen, kit, schedule=QUICK)
    ends = found.between(1, torch.tensor([0.0, 0.5, 1.0]))
    assert ends[0].item() == pytest.approx(found.energies[0, 1].item(), abs=0.3)
    assert ends[2].item() == pytest.approx(found.energies[1, 1].item(), abs=0.3)
    rows = modes.rows(found, walk, torch.linspace(0, 1, 3), ["a", "b"])
    best = modes.chosen(found, walk)
    lower = found.energies.argmin(0)
    assert best[0] == modes.right_foot(found.motions[int(lower[0])], walk)[0]
    assert len(rows) == 2 and all(row.keys() == rows[0].keys() for row in rows)
