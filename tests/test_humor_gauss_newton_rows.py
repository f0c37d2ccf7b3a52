"""Gauss-Newton rows against autograd through naive residuals; and what the energies themselves say."""

from dataclasses import replace

import pytest
import torch
from torch.func import grad, jacrev

from motionlab.heading import Frame
from motionlab.humor import energies, gauss_newton, state
from motionlab.humor.body_shape import landmarks, offsets
from motionlab.humor.energies import BONE_PARENTS, CONTACT_JOINTS, JOINTS, RGB
from motionlab.humor.evidence import LEVEL, Evidence, View
from motionlab.humor.gauss_newton import CHANGE, XI
from motionlab.skeleton import STANDARD, fk
from tests.draws import draw
from tests.rolled_inputs import F64, first_states, own, placed, still, turned

CLIPS, FRAMES = 2, 3


@pytest.fixture(scope="module")
def case():
    """Everything that the rows of two clips are made of, but for what was seen."""
    x = own(first_states(torch.Generator().manual_seed(0), CLIPS * FRAMES)).unflatten(0, (CLIPS, FRAMES))
    frame = placed(still(x), draw(1, CLIPS, FRAMES, 3))  # somewhere in the world
    return {
        "x": x,
        "turn": frame.turn,
        "shift": frame.shift,
        "steps": frame.turn[:, :-1] @ frame.turn[:, 1:].mT,
        "betas": draw(2, CLIPS, 8),
        "camera": 0.05 * draw(3, CLIPS, 3),
        "touching": draw(4, CLIPS, FRAMES, 9).sigmoid(),
    }


def film(*, free):
    """A camera 7 m away, detections tens of pixels off and some of them missing."""
    intrinsics = torch.tensor([[1000.0, 0, 640], [0, 900, 360], [0, 0, 1]], dtype=F64).expand(CLIPS, 3, 3)
    centre = torch.tensor([0.0, -7.0, 1.2], dtype=F64).expand(CLIPS, 3)
    view = View(intrinsics, LEVEL.double().expand(CLIPS, 3, 3), centre, (1280, 720), free)
    weight = draw(5, CLIPS, FRAMES, 25).sigmoid()
    weight[:, 1, 3:9] = 0.0
    return Evidence(0.5 * draw(6, CLIPS, FRAMES, 25, 2), weight, 30.0, view)


def least_squares(weights):
    """The weights of a set but for contact heights, which are hinges."""
    return {n: w for n, w in weights.of(3, frames=FRAMES).items() if n != "contact_height"}


def seen(case, kind):
    """Evidence, and the weights of its energy."""
    if kind == "joints":
        weight = (draw(5, CLIPS, FRAMES, 22) > 0).to(F64)
        return Evidence(draw(6, CLIPS, FRAMES, 22, 3), weight, 30.0), least_squares(JOINTS)
    shown = film(free=kind == "free")
    points = world(case, torch.zeros(CLIPS, FRAMES, CHANGE + 11, dtype=F64), shown, camera=case["camera"])[2]
    return replace(shown, values=points + 60 * shown.values), least_squares(RGB)


def world(case, change, evidence, camera):
    """Body joints, carried joints and what is seen of changed frames, in the world; every frame has betas of its own,
    and a camera. Turn after turn, by ``fk``, ``landmarks`` and ``View``."""
    frame = placed(Frame(case["turn"], case["shift"]), change[..., XI:CHANGE])
    states = state.globalise(turned(case["x"], change[..., :XI]), frame)
    parts = state.unpack(states)
    betas = case["betas"][:, None] + change[..., CHANGE : CHANGE + 8]
    rot = torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), -3)
    joints, turns = fk(replace(STANDARD, offsets=offsets(betas)), parts["trans"], rot)
    if evidence.view is None:
        return joints, parts["joints"], joints
    points = landmarks(joints[:, :, None], turns[:, :, None], betas)[:, :, 0]
    free = change[..., CHANGE + 8 :] if evidence.view.free else 0.0
    view, pixels = evidence.view, []
    for t in range(FRAMES):
        now = camera + (free[:, t] if evidence.view.free else free)
        pixels.append(view.pixels(points[:, t : t + 1], now)[:, 0])
    return joints, parts["joints"], torch.stack(pixels, 1)


def residuals(case, change, evidence, weights, robust):
    """All of them in one vector (B, m): a twin, term by term from the paper."""
    body, carried, points = world(case, change, evidence, case["camera"])
    bones = (carried[:, :, 1:] - carried[:, :, list(BONE_PARENTS)]).norm(dim=-1)
    slip = body[:, 1:, list(CONTACT_JOINTS)] - body[:, :-1, list(CONTACT_JOINTS)]
    found = {
        "joint_consistency": body - carried,
        "bone_length": bones[:, 1:] - bones[:, :-1],
        "contact_vel": case["touching"][:, 1:, :, None].sqrt() * slip,
    }
    name = "joints3d" if evidence.view is None else "joints2d"
    found[name] = robust * (points - evidence.values)
    return torch.cat([(weights[n] ** 0.5 * r).flatten(1) for n, r in found.items()], 1)


def energy(case, change, evidence, weights):
    """The same by ``energies``, of all clips."""
    body, carried, points = world(case, change, evidence, case["camera"])
    terms = {
        "joint_consistency": energies.joint_consistency(body, carried),
        "bone_length": energies.bone_length(carried),
        "contact_vel": energies.contact_vel(body, case["touching"]),
    }
    if evidence.view is None:
        terms["joints3d"] = energies.joints3d(points, evidence.values, evidence.weight > 0)
    else:
        terms["joints2d"] = energies.joints2d(points, evidence.values, evidence.weight)
    return sum(weights[n] * terms[n] for n in terms).sum()


def weighing(case, evidence, nothing):
    """What multiplies a data residual, frozen: 1 or 0, or the root of 2 conf^2 (s^2 / (s^2 + r^2))^2."""
    if evidence.view is None:
        return evidence.weight[..., None]
    off = world(case, nothing, evidence, case["camera"])[2] - evidence.values
    return 2**0.5 * evidence.weight[..., None] * 100.0**2 / (100.0**2 + off.square())


def assembled(rows):
    """J^T J (B, T n, T n) of all frames from the rows of single frames and of pairs."""
    clips, frames, _, n = rows.of_frame.shape
    h = torch.zeros(clips, frames, n, frames, n, dtype=F64)
    for t in range(frames):
        h[:, t, :, t] += rows.of_frame[:, t].mT @ rows.of_frame[:, t]
    for t in range(frames - 1):
        before, after = rows.before[:, t], rows.after[:, t]
        h[:, t, :, t] += before.mT @ before
        h[:, t + 1, :, t + 1] += after.mT @ after
        h[:, t, :, t + 1] += before.mT @ after
        h[:, t + 1, :, t] += after.mT @ before
    return h


# ----------------------------------------------------------------------------------------------------------- the rows
@pytest.mark.parametrize("kind", ["joints", "fixed", "free"])
def test_rows_are_the_gauss_newton_matrix_of_naive_residuals(case, kind):
    evidence, weights = seen(case, kind)
    found = gauss_newton.residual_rows(**case, evidence=evidence, weights=weights)
    size = found.of_frame.shape[-1]
    assert size == CHANGE + (11 if kind == "free" else 8)
    nothing = torch.zeros(CLIPS, FRAMES, size, dtype=F64)
    robust = weighing(case, evidence, nothing)
    slopes = jacrev(lambda c: residuals(case, nothing + c, evidence, weights, robust))(nothing[0])
    h = torch.einsum("bmtn,bmsk->btnsk", slopes, slopes)
    ours = assembled(found)
    torch.testing.assert_close(ours, h, atol=1e-8, rtol=1e-8)
    if kind == "free":
        assert h[:, 0, -3:, 0, -3:].diagonal(dim1=1, dim2=2).amin() > 1.0

    if kind == "joints":  # the twin's residuals are the energy's, half their squares
        half = 0.5 * residuals(case, nothing, evidence, weights, robust).square().sum()
        torch.testing.assert_close(half, energy(case, nothing, evidence, weights))
    slope = grad(lambda c: energy(case, nothing + c, evidence, weights))(nothing)
    theirs = torch.einsum("bmtn,bm->btn", slopes, residuals(case, nothing, evidence, weights, robust))
    torch.testing.assert_close(slope, theirs, atol=1e-8, rtol=1e-8)


def test_control_wrong_turns_between_frames_and_wrong_weights_are_noticed(case):
    evidence, weights = seen(case, "joints")
    good = assembled(gauss_newton.residual_rows(**case, evidence=evidence, weights=weights))
    for wrong in (
        gauss_newton.residual_rows(**case | {"steps": case["steps"].mT}, evidence=evidence, weights=weights),
        gauss_newton.residual_rows(**case | {"touching": 1 - case["touching"]}, evidence=evidence, weights=weights),
        gauss_newton.residual_rows(**case, evidence=evidence, weights=weights | {"bone_length": 20.0}),
        gauss_newton.residual_rows(**case, evidence=replace(evidence, weight=1 - evidence.weight), weights=weights),
    ):
        assert (assembled(wrong) - good).abs().max() > 0.01
    seen_by, weights = seen(case, "fixed")
    good = assembled(gauss_newton.residual_rows(**case, evidence=seen_by, weights=weights))
    for name in ("turn", "shift", "camera"):
        moved = case | {name: case[name].mT if name == "turn" else case[name] + 0.3}
        assert (
            assembled(gauss_newton.residual_rows(**moved, evidence=seen_by, weights=weights)) - good
        ).abs().max() > 0.01


@pytest.mark.parametrize("kind", ["joints", "free"])
def test_what_was_not_seen_has_no_row(case, kind):
    """All of its row is nought, and no number of it matters."""
    evidence, weights = seen(case, kind)
    blind = replace(evidence, weight=torch.zeros_like(evidence.weight))
    found = gauss_newton.residual_rows(**case, evidence=blind, weights=weights)
    assert not found.of_frame[:, :, 66:].any() and found.of_frame[:, :, :66].any()
    values = torch.where(evidence.weight[..., None] > 0, evidence.values, 1e6)
    moved = gauss_newton.residual_rows(**case, evidence=replace(evidence, values=values), weights=weights)
    usual = gauss_newton.residual_rows(**case, evidence=evidence, weights=weights)
    assert all(map(torch.equal, moved, usual))


def test_without_contacts_nobody_holds_the_feet(case):
    evidence, weights = seen(case, "joints")
    weights = {n: w for n, w in weights.items() if n != "contact_vel"}
    found = gauss_newton.residual_rows(**case, evidence=evidence, weights=weights)
    assert not found.before[:, :, 21:].any() and found.before[:, :, :21].any()


def test_a_body_behind_the_camera_has_finite_rows_that_do_not_pull_it(case):
    evidence, weights = seen(case, "free")
    behind = replace(evidence.view, centre=evidence.view.centre + torch.tensor([0.0, 20.0, 0.0], dtype=F64))
    found = gauss_newton.residual_rows(**case, evidence=replace(evidence, view=behind), weights=weights)
    assert all(part.isfinite().all() for part in found) and not found.of_frame[:, :, 66:, : CHANGE + 8].any()
    near = replace(evidence.view, centre=evidence.view.centre + torch.tensor([0.0, 7.0, 0.0], dtype=F64))
    through = gauss_newton.residual_rows(**case, evidence=replace(evidence, view=near), weights=weights)
    assert all(part.isfinite().all() for part in through)
