"""Stage 3 by closed-loop Gauss-Newton: its coordinates are round, its roll-outs exact, its energies never rise."""

from copy import deepcopy
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from data_synth import clips
from motionlab import optimise
from motionlab.errors import NotConverged, ShapeError
from motionlab.humor import coordinates, energies, feedback_solver, priors, stages, state, unknowns
from motionlab.humor.coordinates import linearised, unwhiten
from motionlab.humor.energies import JOINTS, RGB
from motionlab.humor.evidence import Evidence
from motionlab.humor.feedback_solver import Plan, minimise_from, solve
from motionlab.humor.priors import FIRST_STATE_SIZE, InitGmm, Priors, first_state_features
from motionlab.humor.rollout import sample_rollout
from motionlab.humor.stages import Problem, motion_terms
from motionlab.humor.unknowns import Unknowns
from studies.shared.workload import random_priors, workload
from tests.draws import seeded
from tests.interrupted import interrupted
from tests.rolled_inputs import F64, network

FRAMES, CLIPS = 5, 2
KINDS = ("joints", "fixed", "free")
STEADY = Plan(rounds=2, closures=6, tolerance=0.0, stride=1, trial_rounds=0)


@pytest.fixture(scope="module")
def cases(kit):
    """By name: a problem and unknowns a little beside its truth."""
    return made(kit.pose)


@pytest.fixture(scope="module")
def smooth(kit):
    """The same with a pose prior without kinks, across which this file takes differences, and without the hinges of
    contact heights."""
    pose, found = deepcopy(kit.pose), {}
    pose.slopes = (1.0, 1.0, 1.0)
    for kind, (problem, unknown) in made(pose).items():
        weights = replace(problem.weights, contact_height=(0.0, 0.0, 0.0))
        found[kind] = replace(problem, weights=weights), unknown
    return found


def made(pose):
    """Problems whose truth is a roll-out of their prior itself, a random network with soft norms; the Gaussians of its
    first state are no balls."""
    model = network(64)
    model.decoder.net[-1].weight *= 0.3
    for layer in model.modules():
        if isinstance(layer, torch.nn.GroupNorm):
            layer.eps = 1.0
    walk = clips.draw(1, seeded(), actions=("walk",))[0].motion.cut(0, FRAMES)
    work = workload(walk, random_priors(seeded(), width=32), seeded(), batch=CLIPS).to(torch.float64)
    priors = Priors(model, deepcopy(pose).double(), None)
    first = unknowns.first_state(work.moving, priors)
    start = first_state_features(unknowns.first_state_in_heading_frame(first)).mean(0)
    spread = 0.05 * torch.randn(12, FIRST_STATE_SIZE, FIRST_STATE_SIZE, generator=seeded(1), dtype=F64)
    spread = spread @ spread.mT + 0.05 * torch.eye(FIRST_STATE_SIZE, dtype=F64)
    mixture = InitGmm(torch.full((12,), 1 / 12, dtype=F64), noisy(start.expand(12, -1), 0.1, 2), spread)
    priors = replace(priors, initial=mixture)
    truth = replace(work.moving, z=noisy(sample_rollout(model, first, FRAMES - 1).z, 0.3, 3))
    seen = work.problem.evidence
    view = replace(seen.view, intrinsics=seen.view.intrinsics * torch.tensor([1.0, 0.9, 1.0]).double()[:, None])
    seen = replace(seen, view=view)  # of two focal lengths
    joints = Evidence(torch.zeros(CLIPS, FRAMES, 22, 3, dtype=F64), torch.ones(CLIPS, FRAMES, 22, dtype=F64), walk.fps)
    kinds = {"joints": joints, "fixed": replace(seen, view=replace(view, free=False)), "free": seen}
    found = {}
    for kind, begun in kinds.items():
        spread = {"z": 0.3, "trans": 0.02, "orient": 0.05, "camera": 0.01 * (kind == "free")}
        begin = replace(truth, camera=None) if kind == "joints" else truth
        unknown = Unknowns(**{n: noisy(x, spread.get(n, 0.2), 5) for n, x in begin.named().items()})
        there = unknowns.roll(truth, priors, begun).body.observed
        noised = replace(begun, values=noisy(there, 0.01 if kind == "joints" else 3.0, 4))
        weights = JOINTS if kind == "joints" else RGB
        found[kind] = Problem(noised, priors, weights), unknown
    return found


def noisy(x, scale, number):
    return x + scale * torch.randn(x.shape, generator=seeded(number), dtype=F64)


def total(problem, unknown):
    """Stage 3's energies (B,) as every other search computes them."""
    with torch.no_grad():
        return sum(motion_terms(problem, unknown).values())


def one(problem, unknown, rows):
    """Some recordings alone."""
    rows = torch.tensor(rows)
    return problem.rows(rows), unknown.rows(rows)


def of_both(a, b):
    """The recordings of both, those of a first."""
    return Unknowns(**{n: torch.cat((x, b.named()[n])) for n, x in a.named().items()})


def nought(white):
    return {"nu": torch.zeros_like(white.base), "first": torch.zeros_like(white.first[..., 0])}


# ---------------------------------------------------------------------------------------------------- the coordinates
def residuals(problem, at, rolled, touching, robust, whites):
    """What the Gauss-Newton matrix is of, in one vector (B, m), term by term from the paper; terms without squares
    as the weights have them at the middle."""
    frames = rolled.states.shape[1]
    weights, view = problem.weights.of(3, frames=frames), problem.evidence.view
    body, carried = rolled.body, state.unpack(rolled.states)["joints"]
    prior, z = rolled.rollout.prior, rolled.rollout.z
    bones = carried[:, :, 1:] - carried[:, :, list(energies.BONE_PARENTS)]
    slip = body.joints[:, :, list(energies.CONTACT_JOINTS)].diff(dim=1)
    start = priors.first_state_features(unknowns.first_state_in_heading_frame(rolled.states[:, 0]))
    found = {
        "joint_consistency": body.joints - carried,
        "bone_length": bones.norm(dim=-1).diff(dim=1),
        "contact_vel": touching[:, 1:, :, None].sqrt() * slip,
        "motion_prior": torch.cat(((z - prior.mean) * (-0.5 * prior.log_var).exp(), 0.5**0.5 * prior.log_var), -1),
        "init_motion_prior": start @ whites,
        "shape_prior": (2 * frames) ** 0.5 * at.betas,
        "joints3d" if view is None else "joints2d": robust * (body.observed - problem.evidence.values),
    }
    if view is not None and view.free:
        found["floor_reg"] = frames**0.5 * view.floor(at.camera)
    return torch.cat([(weights[n] ** 0.5 * r).flatten(1) for n, r in found.items()], 1)


def hessian(problem, unknown, white):
    """J^T J (N, N) of the first recording in its coordinates, nu before first, by central differences of roll-outs."""
    problem, unknown = one(problem, unknown, [0])
    white = white.rows(torch.tensor([0]))
    _, middle = unwhiten(problem, unknown, white, nought(white))
    touching = energies.contact_probabilities(middle.rollout.contact_logits)
    robust = problem.evidence.weight[..., None]
    if problem.evidence.view is not None:
        off = middle.body.observed - problem.evidence.values
        robust = 2**0.5 * robust * 100.0**2 / (100.0**2 + off.square())
    gmm = problem.priors.initial
    first = unknowns.first_state_in_heading_frame(middle.states[:, 0])
    share = gmm.each(priors.first_state_features(first)).softmax(-1)[0]
    whites = torch.linalg.cholesky(torch.einsum("k,kij->ij", share, torch.linalg.inv(gmm.covariances.double())))
    sizes = white.base[0].numel(), white.first.shape[1]
    step, unit = 1e-7, torch.eye(sum(sizes), dtype=F64)
    many = unknown.map(lambda x: x.expand(len(unit), *x.shape[1:]))
    same = torch.zeros(len(unit), dtype=torch.long)
    rows, wide = problem.rows(same), white.rows(same)

    def at(s):
        nu, first = (s * unit).split(sizes, 1)
        new = {"nu": nu.unflatten(1, white.base.shape[1:]), "first": first}
        return residuals(rows, *unwhiten(rows, many, wide, new), touching, robust, whites)

    slopes = (at(step) - at(-step)) / (2 * step)
    return slopes @ slopes.mT, sizes[0]


@pytest.mark.parametrize("kind", KINDS)
def test_the_gauss_newton_matrix_is_the_identity_in_the_new_coordinates(smooth, kind):
    """Of nu; nothing couples it to the first state, whose own matrix is that of its shaper but for a ridge."""
    problem, unknown = smooth[kind]
    with torch.no_grad():
        white = linearised(problem, unknown, stride=1)
        h, n = hessian(problem, unknown, white)
        torch.testing.assert_close(h[:n, :n], torch.eye(n, dtype=F64), atol=2e-3, rtol=0)
        assert h[:n, n:].abs().max() < 2e-3
        values = torch.linalg.eigvalsh(h[n:, n:])  # small where its ridge is all that holds a direction
        assert values.min() > 0 and values.max() < 1 + 2e-3 and (values > 0.9).float().mean() > 0.8
        back = torch.linalg.inv(white.first[0])
        ours, theirs = back.mT @ back, back.mT @ h[n:, n:] @ back
        gap = (ours - theirs) / (ours.diagonal()[:, None] * ours.diagonal()).sqrt()
        assert (gap - gap.diagonal().diag()).abs().max() < 2e-3 and gap.diagonal().min() > -2e-3


@pytest.mark.parametrize("part", ["gains", "shared", "whiteners"])
def test_control_with_one_part_of_the_coordinates_missing_they_are_not_round(smooth, part):
    problem, unknown = smooth["joints"]
    with torch.no_grad():
        white = linearised(problem, unknown, stride=1)
        wrong = {"gains": 0 * white.gains, "shared": 0 * white.shared, "whiteners": 1.2 * white.whiteners}[part]
        base = unknown.z if part == "gains" else white.base
        h, n = hessian(problem, unknown, white._replace(base=base, **{part: wrong}))
        assert (h[:n] - torch.eye(len(h), dtype=F64)[:n]).abs().max() > 0.05


@pytest.mark.parametrize(("kind", "stride"), [("joints", 1), ("fixed", 3), ("free", 1), ("free", 100)])
def test_anywhere_is_an_exact_roll_out_of_the_unknowns_there(cases, kind, stride):
    """However seldom the networks are differentiated."""
    problem, unknown = cases[kind]
    with torch.no_grad():
        white = linearised(problem, unknown, stride=stride)
        new = {n: 0.3 * torch.randn(x.shape, generator=seeded(3), dtype=F64) for n, x in nought(white).items()}
        at, rolled = unwhiten(problem, unknown, white, new)
        there = replace(at, z=rolled.rollout.z)
        theirs = unknowns.roll(there, problem.priors, problem.evidence)
        found = sum(stages.rolled_terms(problem, rolled).values())
    torch.testing.assert_close(rolled.states, theirs.states, atol=1e-9, rtol=0)
    torch.testing.assert_close(found, total(problem, there), atol=0, rtol=1e-9)
    assert (theirs.states - unknowns.roll(unknown, problem.priors, problem.evidence).states).abs().max() > 1e-3


def test_gradients_in_the_coordinates_are_finite_differences(cases):
    problem, unknown = cases["free"]
    white = linearised(problem, unknown, stride=1)
    point = {n: 0.1 * torch.randn(x.shape, generator=seeded(4), dtype=F64) for n, x in nought(white).items()}

    def value(new):
        return sum(stages.rolled_terms(problem, unwhiten(problem, unknown, white, new)[1]).values()).sum()

    leaves = {n: x.clone().requires_grad_() for n, x in point.items()}
    slopes = dict(zip(leaves, torch.autograd.grad(value(leaves), leaves.values()), strict=True))
    for name, slope in slopes.items():
        way, step = torch.randn(slope.shape, generator=seeded(5), dtype=F64), 1e-7
        with torch.no_grad():
            up, down = (value(point | {name: point[name] + s * way}) for s in (step, -step))
        torch.testing.assert_close((slope * way).sum(), (up - down) / (2 * step), rtol=1e-4, atol=1e-3)


def test_who_lies_on_the_side_or_is_behind_the_camera_has_coordinates(cases):
    """Without a heading the frame keeps its axes; pixels of what is behind the camera pull nobody."""
    problem, unknown = cases["fixed"]
    side = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=F64)
    lying = unknowns.from_matrix(side.expand_as(unknowns.to_matrix(unknown.orient)), "lean")
    assert all(x.isfinite().all() for x in linearised(problem, replace(unknown, orient=lying)))
    seen, about = problem.evidence, torch.tensor([-1.0, 1, -1], dtype=F64).diag()
    behind = replace(seen, view=replace(seen.view, rotation=about @ seen.view.rotation))
    blind = replace(seen, weight=torch.zeros_like(seen.weight))
    found = [linearised(replace(problem, evidence=each), unknown) for each in (behind, blind, seen)]
    for ours, theirs in zip(*found[:2], strict=True):
        torch.testing.assert_close(ours, theirs)
    assert (found[2].gains - found[1].gains).abs().max() > 1e-3  # control


# ----------------------------------------------------------------------------------------------------------- the search
@pytest.mark.parametrize("kind", KINDS)
def test_what_comes_back_has_the_reported_energy_and_it_is_lower(cases, kind):
    problem, unknown = cases[kind]
    kept = unknown.map(torch.clone).named()
    began = total(problem, unknown)
    found, fits = solve(problem, unknown, replace(STEADY, mode_jumps=0))  # a leap may begin lower
    assert {n: x.shape for n, x in found.named().items()} == {n: x.shape for n, x in kept.items()}
    torch.testing.assert_close(fits[0].history[0], began, atol=0, rtol=1e-9)
    torch.testing.assert_close(total(problem, found), fits[-1].energy, atol=0, rtol=1e-9)
    assert (fits[0].energy < 0.8 * began).all() and (fits[1].energy <= fits[0].energy).all()
    torch.testing.assert_close(fits[1].history[0], fits[0].energy, atol=0, rtol=1e-9)
    assert all(torch.equal(x, kept[n]) for n, x in unknown.named().items())  # what was passed in stays
    if kind == "fixed":
        assert torch.equal(found.camera, unknown.camera)


def test_a_clip_whose_round_gained_little_is_done_and_stays(cases):
    """One of the two starts where it ends, the other does not."""
    problem, unknown = cases["joints"]
    ahead, _ = solve(*one(problem, unknown, [0]), replace(STEADY, closures=12))
    mixed = of_both(ahead, unknown.rows(slice(1, None)))
    found, fits = solve(problem, mixed, replace(STEADY, rounds=3, closures=5, tolerance=0.1))
    assert len(fits) > 2 and fits[-1].reasons[0] == "no decrease"
    assert torch.equal(fits[1].energy[0], fits[-1].energy[0])
    torch.testing.assert_close(total(problem, found), fits[-1].energy, atol=0, rtol=1e-9)
    assert all(fit.history.shape[1] == CLIPS and fit.energy.shape == (CLIPS,) for fit in fits)


def rows_of(linearise, sizes):
    """The same, and notes how many clips it was asked for."""

    def noted(problem, unknown, **how):
        sizes.append(len(unknown.z))
        return linearise(problem, unknown, **how)

    return noted


def test_of_two_starts_the_lower_goes_on(cases):
    """Clip by clip, and what is found and reported is what each start would have found by itself."""
    problem, unknown = cases["joints"]
    far = replace(unknown, z=noisy(unknown.z, 2.0, 9))
    rows = slice(0, 1), slice(1, 2)
    here, there = (of_both(a.rows(rows[0]), b.rows(rows[1])) for a, b in ((unknown, far), (far, unknown)))
    plan, sizes, noted = replace(STEADY, mode_jumps=0, trial_rounds=1), [], []
    how = {"linearise": rows_of(linearised, sizes), "note": lambda: noted.append(1)}
    found, fits = solve(problem, here, plan, second_start=there, **how)
    assert sizes == [2 * CLIPS, CLIPS]
    alone = [solve(problem, begin, plan) for begin in (here, there)]
    first = torch.minimum(*(fits[0].energy for _, fits in alone))
    torch.testing.assert_close(fits[0].energy, first, atol=0, rtol=1e-6)
    lower = torch.stack([fits[0].energy for _, fits in alone]).argmin(0)
    assert lower.tolist() == [0, 1]
    ends = torch.stack([fits[-1].energy for _, fits in alone]).gather(0, lower[None])[0]
    torch.testing.assert_close(total(problem, found), ends, atol=0, rtol=1e-4)
    torch.testing.assert_close(total(problem, found), fits[-1].energy, atol=0, rtol=1e-9)
    assert all(fit.history.shape[1:] == (CLIPS,) for fit in fits)
    assert len(noted) == sum(fit.closures for fit in fits)


def test_a_second_start_that_is_the_first_costs_nothing(cases):
    """Of two clips only the second has another start: three searches, and each ends as it would have."""
    problem, unknown = cases["joints"]
    far = replace(unknown, z=noisy(unknown.z, 2.0, 9))
    there, sizes = of_both(unknown.rows(slice(0, 1)), far.rows(slice(1, 2))), []
    plan = replace(STEADY, mode_jumps=0, trial_rounds=1)
    _, fits = solve(problem, unknown, plan, second_start=there, linearise=rows_of(linearised, sizes))
    assert sizes == [CLIPS + 1, CLIPS]
    torch.testing.assert_close(fits[-1].energy, solve(problem, unknown, plan)[1][-1].energy, atol=0, rtol=1e-4)


def test_a_start_that_is_not_finite_leaves_the_other(cases):
    problem, unknown = cases["joints"]
    starts = [unknown, replace(unknown, z=torch.full_like(unknown.z, torch.nan))]
    plan = replace(STEADY, trial_rounds=1)
    alone = total(problem, solve(problem, unknown, plan)[0])
    for first, second in (starts, starts[::-1]):
        found, _ = solve(problem, first, plan, second_start=second)
        torch.testing.assert_close(total(problem, found), alone, rtol=1e-3, atol=0)


def test_a_search_ends_where_steps_gain_too_little(cases):
    problem, unknown = cases["joints"]
    white, every = linearised(problem, unknown), torch.arange(CLIPS)
    nowhere = torch.zeros_like(white.first[..., 0])
    alone = [minimise_from(problem, unknown, white, every, white.first, nowhere, 12, enough=e)[1] for e in (0.0, 1e9)]
    assert alone[0].closures == 12 and alone[0].reasons == ["closures"] * CLIPS
    assert alone[1].closures < 6 and alone[1].reasons == ["no decrease"] * CLIPS  # the first goes down the gradient
    gains = -alone[0].history.cummin(0).values.diff(dim=0)
    some = minimise_from(problem, unknown, white, every, white.first, nowhere, 12, enough=0.3 * gains.amax(0))[1]
    assert 3 < some.closures <= 12 and "no decrease" in some.reasons
    assert ((some.energy < alone[1].energy) & (some.energy >= alone[0].energy)).all()
    one_of_two = torch.tensor([0.0, 1e9], dtype=white.first.dtype)
    mixed = minimise_from(problem, unknown, white, every, white.first, nowhere, 12, enough=one_of_two)[1]
    assert mixed.reasons == ["closures", "no decrease"]
    torch.testing.assert_close(mixed.energy[0], alone[0].energy[0])
    torch.testing.assert_close(mixed.energy[1], alone[1].energy[1])


def test_a_round_that_ends_higher_is_thrown_away(cases, monkeypatch):
    """As rounding may have it; and it is not what is reported."""
    problem, unknown = cases["joints"]
    right, calls = optimise.minimise_batch, []

    def worse(*args, **how):
        calls.append(1)
        fit = right(*args, **how)
        if len(calls) == 1:
            return fit
        return replace(fit, energy=fit.energy + 1e3, variables={n: x + 1.0 for n, x in fit.variables.items()})

    monkeypatch.setattr(feedback_solver, "minimise_batch", worse)
    found, fits = solve(problem, unknown, replace(STEADY, closures=4))
    torch.testing.assert_close(total(problem, found), fits[0].energy, atol=0, rtol=1e-9)
    assert len(fits) == 2 and torch.equal(fits[1].energy, fits[0].energy)


def test_a_recording_without_transitions(cases):
    problem, unknown = cases["joints"]
    with pytest.raises(ShapeError):
        solve(problem, replace(unknown, z=unknown.z[:, :0]), STEADY)


def test_single_precision_and_two_frames():
    """The least that there is; in float32, as fits have it."""
    walk = clips.draw(1, seeded(), actions=("walk",))[0].motion.cut(0, 2)
    work = workload(walk, random_priors(seeded(), width=64), seeded(), batch=1)
    began = total(work.problem, work.moving)
    found, fits = solve(work.problem, work.moving, STEADY)
    assert found.z.shape == (1, 1, 48) and found.z.dtype == torch.float32
    assert (fits[-1].energy < began).all()
    torch.testing.assert_close(total(work.problem, found), fits[-1].energy, atol=0, rtol=1e-3)
    assert all(x.isfinite().all() for x in found.named().values())


# ----------------------------------------------------------------------------------------------- what is missing or bad


@pytest.mark.parametrize("kind", ["joints", "free"])
def test_keypoints_without_weight_do_not_matter_and_a_clip_may_have_none(cases, kind):
    problem, unknown = cases[kind]
    weight, values = problem.evidence.weight.clone(), problem.evidence.values.clone()
    weight[0, 1:3], weight[1] = 0.0, 0.0
    found = []
    for gone in (0.0, 500.0):
        values[weight == 0] = gone
        seen = replace(problem, evidence=replace(problem.evidence, values=values.clone(), weight=weight))
        began = total(seen, unknown)
        there, fits = solve(seen, unknown, Plan(rounds=1, closures=4))
        assert (fits[-1].energy <= began).all() and fits[-1].energy[0] < began[0]
        assert all(x.isfinite().all() for x in there.named().values())
        found.append(there)
    for here, there in zip(*(each.named().values() for each in found), strict=True):
        torch.testing.assert_close(here, there, atol=1e-9, rtol=1e-9)


def test_networks_that_are_not_finite_are_no_fit(cases):
    problem, unknown = cases["joints"]
    with torch.no_grad():
        broken = network(64)
        broken.decoder.net[-1].bias[5] = torch.nan
    with pytest.raises(NotConverged):
        solve(replace(problem, priors=replace(problem.priors, motion=broken)), unknown, STEADY)


def test_one_bad_clip_leaves_the_others_alone(cases):
    problem, unknown = cases["joints"]
    alone, own = solve(*one(problem, unknown, [0]), STEADY)
    for name in ("z", "trans"):
        bad = unknown.map(torch.clone)
        getattr(bad, name)[1, ..., 0] = torch.nan
        found, fits = solve(problem, bad, STEADY)
        torch.testing.assert_close(fits[-1].energy[:1], own[-1].energy, atol=0, rtol=1e-5)
        assert (found.z[0] - alone.z[0]).abs().max() < 1e-3


@pytest.mark.parametrize("at", [2, 9])
def test_an_interrupt_ends_at_the_best_so_far(cases, at, monkeypatch):
    """Ctrl-C in the first round or the second: one is enough."""
    problem, unknown = cases["joints"]
    began = total(problem, unknown)
    monkeypatch.setattr(feedback_solver, "rolled_terms", interrupted(stages.rolled_terms, at))
    found, fits = solve(problem, unknown, Plan(rounds=4, closures=6, tolerance=0.0, mode_jumps=0))
    assert stages.interrupted(fits[-1]) and sum(fit.closures for fit in fits) == at - 1
    assert (total(problem, found) <= began * (1 + 1e-9)).all()
    torch.testing.assert_close(total(problem, found), fits[-1].energy, atol=0, rtol=1e-9)


def second(change):
    """Linearisations, of which the second of a fit is changed."""
    calls = []

    def linearised(*args, **how):
        calls.append(1)
        white = coordinates.linearised(*args, **how)
        return change(white) if len(calls) == 2 else white

    return linearised


def test_an_interrupt_while_differentiating_keeps_what_the_first_round_found(cases):
    problem, unknown = cases["joints"]
    began = total(problem, unknown)

    try:
        found, fits = solve(problem, unknown, STEADY, linearise=second(Mock(side_effect=KeyboardInterrupt)))
    except KeyboardInterrupt:  # which would end the tests
        pytest.fail("the first round is lost")
    assert len(fits) == 1 and (total(problem, found) < began).all()


def test_a_last_clip_that_cannot_be_differentiated_keeps_what_it_had(cases):
    """NaN gains in the second round, of all clips that still run."""
    problem, unknown = cases["joints"]
    began = total(problem, unknown)
    broken = second(lambda white: white._replace(gains=white.gains * torch.nan))
    found, fits = solve(problem, unknown, STEADY, linearise=broken)
    assert len(fits) == 1 and (total(problem, found) < began).all()
    torch.testing.assert_close(total(problem, found), fits[-1].energy, atol=0, rtol=1e-9)


@pytest.mark.parametrize("bad", [*({n: 0} for n in ("stride", "closures", "rounds")), {"mode_jumps": -1}])
def test_a_plan_without_work(bad):
    with pytest.raises(ValueError, match="1 or more"):
        Plan(**bad)
