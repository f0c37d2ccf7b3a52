"""Fit a body to a few keypoints and watch the joints that nobody observes.

The thesis sees the legs move while only the left arm and the face have detections (3.3.2). The legs are
descendants of the pelvis and ancestors of nothing that is observed, so any gradient on them comes through
skinning weights that should not be there. The energy is written in the notebook; here are its surroundings.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.body import BodyModel
from motionlab.motion import Motion
from motionlab.observation import Camera, look_at, project
from motionlab.skeleton import fk
from motionlab.skinning import influence
from studies.shared.torch_search import minimise

#: What the thesis's clip still saw.
ARM = ("left_shoulder", "left_elbow", "left_wrist")
FACE = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")
LEGS = tuple(f"{side}_{part}" for part in ("hip", "knee", "ankle", "foot") for side in ("left", "right"))
#: Step lengths: L-BFGS scales by curvature, Adam gives every parameter, however small its gradient, about this step.
STEP = {"lbfgs": 1.0, "adam": 0.02}


@dataclass(frozen=True, eq=False)
class Case:
    """One person, or several (...), of whom the left arm and the face are seen by one camera.

    arm, legs: indices of their joints. face: vertices of the mesh. observed: pixels (..., T, 8, 2), the arm's first, of
    a body without faults: joints by kinematics, face vertices moved rigidly with the head. theta, root: where a fit
    starts, every joint at rest and the root in its place; theta (..., T, J, 6) in 6D.
    """

    body: BodyModel
    camera: Camera
    arm: list[int]
    face: list[int]
    legs: list[int]
    observed: Tensor
    theta: Tensor
    root: Tensor
    fps: float


#: Case, theta (..., T, J, 6), root (..., T, 3) to (...): one energy a person.
Energy = Callable[[Case, Tensor, Tensor], Tensor]


def people(motions: Sequence[Motion]) -> Motion:
    """Stacks clips of equal length, each turned and moved so that it starts in one place and faces one way."""
    stood = [_turned(m) for m in motions]
    rot, root = (torch.stack([getattr(m, name) for m in stood]) for name in ("rot", "root"))
    return Motion(stood[0].skeleton, root, rot, stood[0].fps)


def case(body: BodyModel, truth: Motion) -> Case:
    """Builds the case of one clip, or of several that start in one place and face one way (:func:`people`)."""
    theta = rotation.matrix_to_sixd(torch.eye(3)).expand(*truth.rot.shape[:-2], 6).clone()
    theta[..., 0, :] = rotation.matrix_to_sixd(truth.rot[..., 0, :, :])
    arm, legs = body.skeleton.indices(ARM), body.skeleton.indices(LEGS)
    face = [body.keypoint_vertices[name] for name in FACE]
    camera = _facing(truth.root.flatten(0, -2)[0], truth.rot.flatten(0, -4)[0, 0])
    positions, world = fk(body.skeleton, truth.root, truth.rot)
    head = body.skeleton.index("head")
    rigid = (body.template[face] - body.joints[head]) @ (world[..., head, :, :] @ body.bind_rot[head].mT).mT
    seen = torch.cat((positions[..., arm, :], rigid + positions[..., head, None, :]), dim=-2)
    observed = project(camera, seen)[0]
    return Case(body, camera, arm, face, legs, observed, theta, truth.root.clone(), truth.fps)


def gradient(case: Case, energy: Energy) -> tuple[float, float]:
    """Computes the norm of the energy's first gradient on all rotations, and on those of the legs."""
    theta = case.theta.clone().requires_grad_()
    energy(case, theta, case.root).sum().backward()
    return theta.grad.norm().item(), theta.grad[..., case.legs, :].norm().item()


class PartialFit(NamedTuple):
    """What a fit to the arm and the face did: fitted motions (..., T), and by budget in closures how far a leg joint
    had moved at most in the pelvis's frame at the best point up to there, mm (...)."""

    moved: Motion
    legs_mm: dict[int, Tensor]


def fit(
    case: Case, energy: Energy, *, closures: int, method: str, lr: float | None = None, budgets: Sequence[int] = ()
) -> PartialFit:
    """Minimises ``energy(case, theta, root)`` with Adam or L-BFGS, which may evaluate it ``closures`` times.

    Adam moves every parameter by its own gradient alone, so that several people at once are fitted as if each were
    alone, and each one's best point is kept; L-BFGS takes one person. lr: step length, else that of ``STEP``. budgets:
    numbers of closures after which the legs are measured too; those beyond the end repeat it.
    """
    rest, seen, calls = _legs_in_pelvis(case, case.theta), {}, 0
    lowest = torch.full(case.theta.shape[:-3], torch.inf)
    theta, root = case.theta.clone(), case.root.clone()

    def watched(variables: dict[str, Tensor]) -> Tensor:
        nonlocal calls
        values = energy(case, variables["theta"], variables["root"])
        better = values.detach() < lowest
        lowest[better] = values.detach()[better]
        theta[better], root[better] = variables["theta"].detach()[better], variables["root"].detach()[better]
        calls += 1
        if calls in budgets:
            seen[calls] = moved()
        return values.sum()

    def moved() -> Tensor:
        return 1000 * (_legs_in_pelvis(case, theta) - rest).norm(dim=-1).amax((-2, -1))

    start = {"theta": case.theta.clone().requires_grad_(), "root": case.root.clone().requires_grad_()}
    minimise(watched, start, method=method, steps=closures, max_closures=closures, lr=lr or STEP[method])
    made = Motion(case.body.skeleton, root, rotation.sixd_to_matrix(theta), case.fps, name="fitted to arm and face")
    return PartialFit(made, {at: seen.get(at, moved()) for at in (*budgets, closures)})


def legs_mm(
    body: BodyModel, truth: Motion, energy: Energy, *, method: str, budgets: Sequence[int], lr: float | None = None
) -> Tensor:
    """Computes how far the legs move in the fits of several clips (N, T): (N, budgets), mm; the last budget ends it."""
    how = {"closures": budgets[-1], "method": method, "lr": lr, "budgets": budgets}
    alone = [replace(truth, root=x, rot=r) for x, r in zip(truth.root, truth.rot, strict=True)]
    fits = [fit(case(body, some), energy, **how) for some in ([truth] if method == "adam" else alone)]
    return torch.cat([torch.stack([f.legs_mm[at].reshape(-1) for at in budgets], dim=1) for f in fits])


def leak_percent(body: BodyModel, pose: Motion) -> float:
    """Computes what share of the face keypoints' rotation gradient reaches the legs in one pose (1 frame), percent."""
    face = [body.keypoint_vertices[name] for name in FACE]
    grid = influence(body, pose.root[0], pose.rot[0], face)
    return 100 * float(grid[:, body.skeleton.indices(LEGS)].norm() / grid.norm())


def _turned(motion: Motion) -> Motion:
    """A clip that starts above the origin and faces along x."""
    forward = motion.rot[0, 0] @ torch.tensor([0.0, 0.0, 1.0])
    turn = rotation.exp(torch.tensor([0.0, 0.0, -torch.atan2(forward[1], forward[0]).item()]))
    root = (motion.root - motion.root[0] * torch.tensor([1.0, 1.0, 0.0])) @ turn.mT
    return replace(motion, root=root, rot=torch.cat((turn @ motion.rot[:, :1], motion.rot[:, 1:]), dim=1))


def _facing(root: Tensor, orientation: Tensor) -> Camera:
    """A webcam in front of a person at root (3,), orientation (3, 3), level with the chest."""
    forward = orientation @ torch.tensor([0.0, 0.0, 1.0])
    forward = torch.nn.functional.normalize(forward[:2], dim=0)
    chest = root + torch.tensor([0.0, 0.0, 0.3])
    eye = chest + 3.5 * torch.cat((forward, torch.zeros(1)))
    return look_at(eye, chest, focal=1000.0, width=1280, height=960)


def _legs_in_pelvis(case: Case, theta: Tensor) -> Tensor:
    rot = rotation.sixd_to_matrix(theta)
    seated = torch.cat((torch.eye(3).expand(*rot.shape[:-3], 1, 3, 3), rot[..., 1:, :, :]), dim=-3)
    return fk(case.body.skeleton, torch.zeros(*rot.shape[:-3], 3), seated)[0][..., case.legs, :]
