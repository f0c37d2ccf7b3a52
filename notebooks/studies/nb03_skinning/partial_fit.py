"""Fit a body to a few keypoints and watch the joints that nobody observes.

The thesis sees the legs move while only the left arm and the face have detections (3.3.2). The legs are
descendants of the pelvis and ancestors of nothing that is observed, so any gradient on them comes through
skinning weights that should not be there.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.body import BodyModel, lbs
from motionlab.motion import Motion
from motionlab.observation import Camera, look_at, project
from motionlab.skeleton import fk
from studies.shared.torch_search import FitResult, minimise

#: What the thesis's clip still saw.
ARM = ("left_shoulder", "left_elbow", "left_wrist")
FACE = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")
LEGS = tuple(f"{side}_{part}" for part in ("hip", "knee", "ankle", "foot") for side in ("left", "right"))


def facing(motion: Motion, *, metres: float = 3.5) -> Camera:
    """A webcam in front of the person of a clip's first frame, level with the chest."""
    forward = motion.rot[0, 0] @ torch.tensor([0.0, 0.0, 1.0])
    forward = torch.nn.functional.normalize(forward[:2], dim=0)
    chest = motion.root[0] + torch.tensor([0.0, 0.0, 0.3])
    eye = chest + metres * torch.cat((forward, torch.zeros(1)))
    return look_at(eye, chest, focal=1000.0, width=1280, height=960)


def arm_and_face(body: BodyModel, root: Tensor, rot: Tensor) -> Tensor:
    """World positions (..., T, 8, 3): the left arm's joints by kinematics, the face's vertices by skinning."""
    joints = fk(body.skeleton, root, rot)[0][..., body.skeleton.indices(ARM), :]
    face = lbs(body, body.skeleton, root, rot, vertices=[body.keypoint_vertices[name] for name in FACE])
    return torch.cat((joints, face), dim=-2)


@dataclass(frozen=True, eq=False)
class PartialFit:
    """What a fit to the arm and the face did.

    legs_mm: largest displacement of a leg joint in the pelvis's frame between start and end, mm.
    leg_gradient: share of the first gradient's norm that lies on leg rotations.
    pixels: mean reprojection error at the end. moved: the fitted motion. fit: its history.
    """

    legs_mm: float
    leg_gradient: float
    pixels: float
    moved: Motion
    fit: FitResult


def fit_arm_and_face(
    body: BodyModel,
    truth: Motion,
    camera: Camera,
    *,
    closures: int,
    method: str = "lbfgs",
    lr: float | None = None,
    smoothness: float = 10.0,
) -> PartialFit:
    """Fit all rotations and the root to the projected arm and face of a motion (T frames).

    E = sum |pi(keypoint) - pi(truth)|^2 / (5 px)^2 + smoothness sum |R_{t+1} - R_t|^2 (two columns), L-BFGS on 6D

    method "lbfgs" scales its steps by curvature; "adam" gives every parameter, however small its gradient, a
    step of about ``lr`` (0.02). Both may evaluate E ``closures`` times.

    The observations come from the body without its blend's faults: joints and face vertices moved rigidly with
    the head. The start is the truth's root with every joint at rest.

    Source: thesis 3.3.2, second issue.
    """
    skeleton = body.skeleton
    observed = project(camera, _rigid_arm_and_face(body, truth))[0]
    start = rotation.matrix_to_sixd(torch.eye(3)).expand(truth.frames, len(skeleton), 6).clone()
    start[:, 0] = rotation.matrix_to_sixd(truth.rot[:, 0])
    legs = skeleton.indices(LEGS)

    def energy(variables: dict[str, Tensor]) -> Tensor:
        rot = rotation.sixd_to_matrix(variables["theta"])
        pixels = project(camera, arm_and_face(body, variables["root"], rot))[0]
        data = ((pixels - observed) / 5.0).square().sum()
        return data + smoothness * rotation.matrix_to_sixd(rot).diff(dim=0).square().sum()

    first = start.clone().requires_grad_()
    energy({"theta": first, "root": truth.root}).backward()
    fit = minimise(
        energy,
        {"theta": start.requires_grad_(), "root": truth.root.clone().requires_grad_()},
        method=method,
        steps=closures,
        max_closures=closures,
        lr=lr or {"lbfgs": 1.0, "adam": 0.02}[method],
    )
    before = _legs_in_pelvis(body, rotation.sixd_to_matrix(start.detach()))
    rot = rotation.sixd_to_matrix(fit.variables["theta"])
    after = _legs_in_pelvis(body, rot)
    moved = Motion(skeleton, fit.variables["root"], rot, truth.fps, name="fitted to arm and face")
    pixels = project(camera, arm_and_face(body, moved.root, moved.rot))[0]
    return PartialFit(
        legs_mm=1000 * (after - before).norm(dim=-1).max().item(),
        leg_gradient=(first.grad[:, legs].norm() / first.grad.norm()).item(),
        pixels=(pixels - observed).norm(dim=-1).mean().item(),
        moved=moved,
        fit=fit,
    )


def _rigid_arm_and_face(body: BodyModel, motion: Motion) -> Tensor:
    positions, world = fk(body.skeleton, motion.root, motion.rot)
    head = body.skeleton.index("head")
    local = body.template[[body.keypoint_vertices[name] for name in FACE]] - body.joints[head]
    turn = world[:, head] @ body.bind_rot[head].mT
    face = local @ turn.mT + positions[:, head, None]
    return torch.cat((positions[:, body.skeleton.indices(ARM)], face), dim=-2)


def _legs_in_pelvis(body: BodyModel, rot: Tensor) -> Tensor:
    seated = torch.cat((torch.eye(3).expand(len(rot), 1, 3, 3), rot[:, 1:]), dim=1)
    return fk(body.skeleton, torch.zeros(len(rot), 3), seated)[0][:, body.skeleton.indices(LEGS)]
