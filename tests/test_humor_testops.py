"""The three stages end to end, small: what they must find, and what they must survive."""

import copy
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from motionlab import optimise, rotation
from motionlab.errors import DataError, ShapeError
from motionlab.humor import priors, stages, state, testops, unknowns
from motionlab.humor import start as starts
from motionlab.humor.energies import JOINTS, RGB
from motionlab.humor.evidence import Evidence, Observation3D, evidence
from motionlab.humor.rollout import infer, rollout
from motionlab.humor.testops import Schedule
from motionlab.observation import look_at
from studies.shared import savings
from tests.fit_inputs import QUICK, error, finite, joints, keypoints
from tests.interrupted import interrupted

POSES = Schedule(steps=(2, 4, 0), inner=20)


@pytest.fixture(scope="module")
def short(walk):
    return walk.cut(0, 8)


# --------------------------------------------------------------------------------------------------- what is found
def test_stages_one_and_two_find_clean_joints(kit, walk):
    fitted = testops.fit(joints(walk), kit, schedule=POSES, weights=replace(JOINTS, joints3d_smooth=(0.1, 0.1, 0.0)))
    assert (error(fitted.stages[1], walk) < 0.15).all()
    assert (error(fitted.stages[2], walk) < 0.02).all()
    assert list(fitted.stages) == [1, 2]


def test_stages_one_and_two_find_clean_keypoints(kit, walk, camera):
    fitted = testops.fit(keypoints(walk, camera), kit, schedule=Schedule(steps=(3, 10, 0)))
    relative = fitted.motion.positions - fitted.motion.root[..., None, :]
    true = walk.positions - walk.root[..., None, :]
    assert (relative - true).norm(dim=-1).mean() < 0.06
    assert (error(fitted.motion, walk) < 0.5).all()


def test_stage_three_is_a_roll_out_of_what_it_returns(kit, short):
    fitted = testops.fit(joints(short), kit, schedule=QUICK)
    again = rollout(kit.motion, fitted.first, fitted.z).states
    torch.testing.assert_close(state.unpack(again)["trans"], fitted.motion.root[:, 1:], atol=1e-5, rtol=0)
    assert fitted.contacts.shape == (2, 8, 9)
    assert (fitted.contacts[:, 0] == fitted.contacts[:, 1]).all()


def test_stage_three_lowers_its_energy(kit, walk, monkeypatch):
    """In each sub-stage, and as a whole below a search in which no latent of the motion prior moves."""
    schedule = replace(QUICK, inner=10)
    fitted = testops.fit(joints(walk), kit, schedule=schedule)
    for fit in fitted.results[3]:
        assert (fit.energy < fit.history[0]).all()
    total = sum(fitted.energies[3].values())
    torch.testing.assert_close(total, fitted.results[3][-1].energy, rtol=1e-3, atol=1e-3)
    assert (error(fitted.motion, walk) < 0.04).all()
    real = optimise.minimise_batch

    def without_latents(energy, variables, **how):
        return real(energy, {name: x for name, x in variables.items() if name != "z"}, **how)

    monkeypatch.setattr(stages, "minimise_batch", without_latents)
    frozen = testops.fit(joints(walk), kit, schedule=schedule)
    assert (total < sum(frozen.energies[3].values()) - 0.2).all()


@pytest.mark.parametrize("control", [False, True])
def test_a_search_ends_by_its_own_energy(control, monkeypatch):
    """To the bit, where rows do not touch each other's rounding."""
    if control:  # one tolerance, the mean, serves all clips
        search = lambda *args, tolerance_change, **how: optimise.minimise_batch(  # noqa: E731
            *args, tolerance_change=float(tolerance_change.mean()), **how
        )
        monkeypatch.setattr(stages, "minimise_batch", search)

    def terms(_, at):
        x, y = at.trans.unbind(-1)
        return {"valley": at.orient * ((1 - x).square() + 100 * (y - x.square()).square())}

    valley = torch.tensor([[-1.2, 1.0]] * 2)
    unknown = unknowns.Unknowns(trans=valley, orient=torch.tensor([1.0, 1e6]), latent=torch.zeros(2, 0))
    budget = {"steps": 5, "inner": 20, "tolerance": Schedule().tolerance}
    anything = SimpleNamespace(rows=lambda index: None)
    every = slice(None), slice(1)
    both, alone = (stages._search(terms, anything, *stages._as_they_are(unknown.rows(k), ("trans",)), **budget)[0]
                   for k in every)  # fmt: skip
    assert torch.equal(both.trans[:1], alone.trans) != control


# ------------------------------------------------------------------------------------------------ what is survived
def test_no_batch_axis(kit, short):
    assert testops.fit(joints(short.clip(0)), kit, schedule=QUICK).motion.root.shape == (1, 8, 3)


def test_an_unknown_camera_is_assumed_and_said(kit, short, camera):
    seen = replace(keypoints(short, camera), camera=None)
    fitted = testops.fit(seen, kit, schedule=QUICK)
    assert finite(fitted)
    assert "focal length" in fitted.notes[0]
    assert fitted.cameras[0].width == 1280
    assert "guessed" not in testops.fit(seen, kit, schedule=QUICK, size=(1280, 720)).notes[0]


def test_the_floor_is_refined_where_asked(kit, short, camera):
    seen = keypoints(short, camera)
    fixed = testops.fit(seen, kit, schedule=QUICK)
    free = testops.fit(seen, kit, schedule=QUICK, floor="refine")
    torch.testing.assert_close(fixed.cameras[0].rotation, camera.rotation, atol=1e-6, rtol=0)
    assert (free.cameras[0].rotation - camera.rotation).abs().max() > 1e-5
    assert "floor_reg" in free.energies[3] and "floor_reg" not in fixed.energies[3]


def test_ctrl_c_keeps_the_best_so_far(kit, short, monkeypatch):
    monkeypatch.setattr(stages, "pose_terms", interrupted(stages.pose_terms, 15))
    fitted = testops.fit(joints(short), kit, schedule=QUICK)
    assert finite(fitted)
    assert 3 not in fitted.stages
    assert any("interrupted" in note for note in fitted.notes)


def test_bad_input_is_named(kit, walk, camera):
    seen = keypoints(walk, camera)
    with pytest.raises(DataError, match="frames per second"):
        testops.fit(replace(joints(walk), fps=60.0), kit)
    with pytest.raises(DataError, match="no keypoint"):
        testops.fit(replace(seen, names=tuple(f"p{i}" for i in range(25))), kit)
    with pytest.raises(DataError, match="needs a camera"):
        testops.fit(replace(seen, camera=None), kit, floor="camera")
    with pytest.raises(DataError, match="no frame"):
        testops.fit(joints(walk.cut(0, 0)), kit)
    with pytest.raises(ShapeError, match="cameras"):
        testops.fit(seen, kit, cameras=[camera] * 3)
    with pytest.raises(ShapeError, match="visible"):
        Observation3D(walk.positions, torch.ones(2, 3, 22, dtype=torch.bool))
    with pytest.raises(ValueError, match="mode"):
        testops.fit(joints(walk), kit, mode="quick")


# ----------------------------------------------------------------------------------------------------------- the parts
def problem(kit, observation, weights=JOINTS):
    return stages.Problem(evidence(observation), kit, weights)


def test_the_3d_start_is_exact_for_the_mean_pose(kit):
    gen = torch.Generator().manual_seed(0)
    rest = torch.randn(22, 3, generator=gen)
    turn, trans = rotation.random((1, 6), gen), torch.randn(1, 6, 3, generator=gen)
    points = (rest @ turn.mT) + trans[..., None, :]
    weight = torch.ones(1, 6, 22)
    weight[:, 5, 2:] = 0  # two points give no orientation
    found_trans, found_turn, enough = starts.start_3d(Evidence(points, weight, 30.0), rest)
    assert enough.tolist() == [[True] * 5 + [False]]
    torch.testing.assert_close(found_turn[:, :5], turn[:, :5], atol=1e-4, rtol=0)
    torch.testing.assert_close(found_trans[:, :5], trans[:, :5], atol=1e-4, rtol=0)


@pytest.mark.parametrize("yaw", [0.0, 90.0, 180.0, 270.0])
def test_the_2d_start_sees_front_and_back(kit, walk, yaw):
    """Whichever way somebody faces, the start is on the right side, and about as far away as they are."""
    start = walk.cut(0, 8)
    turn = rotation.rotation_about("z", torch.deg2rad(torch.tensor(yaw)))
    rot = start.rot.clone()
    rot[..., 0, :, :] = turn @ rot[..., 0, :, :]
    turned = replace(start, rot=rot, root=(turn @ start.root[..., None])[..., 0])
    eye = turned.root[0, 0] + torch.tensor([4.0, 0.0, 0.3])
    view = look_at(eye, turned.root[0, 0], focal=1000.0, width=1280, height=720)
    unknown = testops.start_stage_1(problem(kit, keypoints(turned.clip(slice(0, 1)), view), RGB))
    off = rotation.geodesic(unknowns.to_matrix(unknown.orient), rot[:1, :, 0])
    assert off.max() < torch.pi / 3
    assert (unknown.trans - turned.root[:1]).norm(dim=-1).max() < 0.8


def test_rounded_coordinates_begin_where_the_old_ones_are(kit, walk):
    p = problem(kit, joints(walk))
    unknown = testops.start_stage_1(p)
    moving = ("trans", "orient", "latent", "betas")
    new, old = stages._preconditioned(unknown, moving, kit, p.evidence, JOINTS.of(2))
    there = unknown.named()
    for name, value in old(new, slice(None)).named().items():
        torch.testing.assert_close(value, there[name])


def test_rounded_coordinates_need_fewer_steps(kit, walk):
    p = problem(kit, joints(walk))
    budget = {"steps": 2, "inner": 20}
    unknown = testops.start_stage_1(p)
    moving = stages._as_they_are(unknown, ("trans", "orient", "latent", "betas"))
    _, plain = stages._search(partial(stages.pose_terms, stage=2), p, *moving, **budget)
    _, quick = stages.stage_1_and_2(p, unknown, 2, **budget)
    assert (quick.energy < plain.energy).all()


@pytest.mark.parametrize("control", [False, True])
def test_a_turn_written_by_parallel_vectors_stops_no_search(kit, walk, control, monkeypatch):
    """The same rotations with the second vector of one frame laid on the first: stage 2 ends where it would."""
    if control:
        monkeypatch.setattr(unknowns, "reorthogonalised", lambda turn: turn)
    p = problem(kit, joints(walk))
    plain = testops.start_stage_1(p)
    orient = plain.orient.clone()
    orient[:, 5, 3:] = orient[:, 5, :3] + 1e-3 * orient[:, 5, 3:]
    torch.testing.assert_close(unknowns.to_matrix(orient), unknowns.to_matrix(plain.orient), atol=1e-3, rtol=0)
    flat, aim = (
        stages.stage_1_and_2(p, u, 2, steps=2, inner=10)[1].energy for u in (replace(plain, orient=orient), plain)
    )
    assert ((flat < 1.05 * aim).all() and not control) or ((flat > 1.5 * aim).all() and control), (flat, aim)


def test_the_start_of_stage_three_follows_stage_two(kit, walk):
    """Noise of 3 cm in stage 2; the control, the official start from pairs of stage 2, drifts further."""
    gen = torch.Generator().manual_seed(0)
    shaken = replace(walk, root=walk.root + 0.03 * torch.randn(walk.root.shape, generator=gen))
    states = state.from_motion(shaken, causal=kit.motion.causal)
    z, curvature, _ = starts._follow(kit.motion, states, torch.ones(2, 24, 22), 2e-5)
    drift = []
    for latents in (z, infer(kit.motion, states)[0].mean):
        rolled = state.unpack(rollout(kit.motion, states[:, 0], latents).states)["joints"]
        drift.append((rolled - shaken.positions[:, 1:]).norm(dim=-1).mean())
    assert drift[0] < 0.1
    assert drift[0] < 0.8 * drift[1], drift
    assert torch.linalg.eigvalsh(curvature).min() > -1e-3


def test_the_start_of_stage_three_takes_the_priors_mean_where_nothing_is_known(kit, walk):
    states = state.from_motion(walk, causal=kit.motion.causal)
    z, *_ = starts._follow(kit.motion, states, torch.zeros(2, 24, 22), 1e-4)
    first = unknowns.first_state_in_heading_frame(states[:, 0])
    torch.testing.assert_close(z[:, 0], kit.motion.prior(first).mean, atol=1e-4, rtol=0)


def in_float64(p):
    """A problem and its priors in float64, the camera free."""
    seen, view = p.evidence, p.evidence.view
    if view is not None:
        view = replace(view, free=True, **{n: getattr(view, n).double() for n in ("intrinsics", "rotation", "centre")})
    seen = replace(seen, values=seen.values.double(), weight=seen.weight.double(), view=view)
    models = (copy.deepcopy(model).double() for model in (p.priors.motion, p.priors.pose))
    return replace(p, evidence=seen, priors=priors.Priors(*models, p.priors.initial))


def official_and_faithful(kit, seen, weights):
    """Per stage and mode: weighted terms and gradients in all unknowns, at one point, which noise has moved."""
    p = replace(problem(kit, seen, weights), mode="official")
    unknown = replace(testops.start_stage_1(p), betas=torch.full((2, 8), 0.3))
    motion = unknowns.motion_of(unknowns.pose(unknown, kit, p.evidence), 30.0)
    shared = unknown.shared()
    how = (shared, p.evidence.confidence_per_joint, kit, p.mode)
    rolled, _ = starts.start_stage_3(motion, unknown.latent, *how)
    noise = torch.Generator().manual_seed(0)
    for stage, at in ((1, unknown), (2, unknown), (3, rolled)):
        at = at.map(lambda x: (x + 0.01 * torch.randn(x.shape, generator=noise)).double())
        found = []
        for form in ({}, savings.OFFICIAL):
            here, point = replace(in_float64(p), **form), at.map(lambda x: x.clone().requires_grad_())
            terms = stages.motion_terms(here, point) if stage == 3 else stages.pose_terms(here, point, stage)
            leaves = point.named()
            slopes = torch.autograd.grad(sum(terms.values()).sum(), list(leaves.values()), allow_unused=True)
            found.append((terms, dict(zip(leaves, slopes, strict=True))))
        yield stage, *found


@pytest.mark.parametrize("exact", [True, False], ids=["exact heading", "official heading"])
@pytest.mark.parametrize("view", [True, False], ids=["2-D", "3-D"])
def test_official_and_faithful_modes_see_one_energy_and_one_gradient(kit, short, camera, view, exact, monkeypatch):
    """In float64, with the heading put right, to 1e-5. With the official acos (the control) stage 3 differs, and its
    gradient by more than its value."""
    if exact:
        monkeypatch.setattr(savings, "alignment", savings.exact_alignment)
    seen, weights = (keypoints(short, camera), RGB) if view else (joints(short), JOINTS)
    for stage, (ours, our_slopes), (theirs, their_slopes) in official_and_faithful(kit, seen, weights):
        assert ours.keys() == theirs.keys() and len(ours) >= (1, 4, 8)[stage - 1]
        terms = max(((ours[n] - theirs[n]).abs().max() / ours[n].abs().max()).item() for n in ours)
        there = [(x, their_slopes[n]) for n, x in our_slopes.items() if x is not None and x.any()]
        slopes = max(((x - y).norm() / x.norm()).item() for x, y in there)
        assert all((our_slopes[n] is None) == (their_slopes[n] is None) for n in our_slopes)
        if exact or stage < 3:
            assert max(terms, slopes) < 1e-5, (stage, terms, slopes)
        else:
            assert terms > 1e-4 and slopes > terms, (stage, terms, slopes)


def test_each_mode_has_its_own_schedule(kit, walk, camera, monkeypatch):
    """The official video demo has 80 steps in stage 2, its 3-D configurations 70."""
    asked = []
    monkeypatch.setattr(testops, "_Track", lambda schedule, *_: asked.append(schedule.steps) or 1 / 0)
    for mode in testops.MODES:
        for seen in (keypoints(walk, camera), joints(walk)):
            with pytest.raises(ZeroDivisionError):
                testops.fit(seen, kit, mode=mode)
    assert asked == 2 * [Schedule.lean().steps] + [(30, 80, 70), (30, 70, 70)]
