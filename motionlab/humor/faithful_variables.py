"""From the unknowns of a fit to a posed body, at the official price: what ``variables`` does in "lean" mode.

Rotations are vectors and are turned into matrices and back between any two steps; joints come from a full mesh; a
stage-3 energy evaluates that mesh five times, three of them for one frame.

Source: the official HuMoR fitting code (Rempe et al. 2021), as measured: 5 body evaluations per closure of stage 3.
Differs: the official code asks for the first frame's joints three times, in two frames of reference. The world is
fixed here, so that one answer serves, and the other two are paid for and dropped (without their share of the backward
pass). It evaluates the sequence in the world's frame and in the camera's; here twice in the world's. Its body layer
has the size of the whole clip also while only 15 frames are rolled out; here that of what is rolled out.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionlab.humor import faithful, state
from motionlab.humor.faithful_body import body_joints_by_lbs, first_joints_by_lbs
from motionlab.humor.faithful_rotation import matrix_to_axis_angle, pose_from_axis_angle
from motionlab.humor.observed import Evidence
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import Rollout
from motionlab.humor.variables import Posed, Rolled, Variables, rows

FIRST_FRAME_CALLS = 3


def _posed(root: Tensor, aa: Tensor, variables: Variables, evidence: Evidence, joints: Tensor | None = None) -> Posed:
    """One evaluation of the body; ``joints``: from an earlier one, to be used beside this one's landmarks."""
    betas = rows(variables, "betas")
    camera = rows(variables, "camera") if "camera" in variables else None
    now, marks = body_joints_by_lbs(root, aa, betas)
    joints = now if joints is None else joints
    observed = now if evidence.view is None else evidence.view.pixels(marks, camera)
    return Posed(root, pose_from_axis_angle(aa), joints, observed, betas, camera)


def _pose_vectors(variables: Variables, priors: Priors) -> Tensor:
    """Rotation vectors (..., 22, 3): the root's as they are, the body's out of the pose prior's matrices."""
    body = matrix_to_axis_angle(priors.pose.decode(rows(variables, "latent")))
    return torch.cat((rows(variables, "orient")[..., None, :], body), -2)


def pose(variables: Variables, priors: Priors, evidence: Evidence) -> Posed:
    """Stages 1 and 2, arguments as ``variables.pose``; orient (G, W, T, 3)."""
    return _posed(rows(variables, "trans"), _pose_vectors(variables, priors), variables, evidence)


def first_state(variables: Variables, priors: Priors, frames: int) -> Tensor:
    """x0 (B, 339), world; ``frames`` of the sequence that the body layer was made for."""
    aa, trans, betas = _pose_vectors(variables, priors), rows(variables, "trans"), rows(variables, "betas")
    for _ in range(FIRST_FRAME_CALLS):
        joints = first_joints_by_lbs(trans, aa, betas, frames)
    rot = pose_from_axis_angle(aa)
    parts = {"trans": trans, "root_orient": rot[:, 0], "pose_body": rot[:, 1:], "joints": joints}
    speeds = {name: rows(variables, name) for name in ("trans_vel", "root_orient_vel")}
    return state.pack(parts | speeds | {"joints_vel": rows(variables, "joints_vel").unflatten(-1, (22, 3))})


def rollout(variables: Variables, priors: Priors) -> tuple[Tensor, Rollout, Tensor]:
    """What the official code calls its roll-out function: the first state with its body, the chain with the prior in
    it, and the result as rotation vectors. States (B, T, 339), the roll-out, vectors (B, T, 22, 3)."""
    z = rows(variables, "z")
    first = first_state(variables, priors, z.shape[1] + 1)
    rolled = faithful.rollout(priors.motion, first, z)
    states = torch.cat((first[:, None], rolled.states), 1)
    parts = state.unpack(states)
    aa = matrix_to_axis_angle(torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), -3))
    return states, rolled, aa


def roll(variables: Variables, priors: Priors, evidence: Evidence) -> Rolled:
    """Stage 3, arguments as ``variables.roll``."""
    states, rolled, aa = rollout(variables, priors)
    trans = states[..., state.SLICES["trans"]]
    joints, _ = body_joints_by_lbs(trans, aa, rows(variables, "betas"))
    return Rolled(states, rolled, _posed(trans, aa, variables, evidence, joints))
