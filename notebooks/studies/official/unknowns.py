"""From the unknowns of a fit to a posed body, at the official price: what ``humor.unknowns`` does in "lean" mode.

Rotations are vectors and are turned into matrices and back between any two steps; joints come from a full mesh; a
stage-3 energy evaluates that mesh five times, three of them for one frame.

Source: the official HuMoR fitting code (Rempe et al. 2021), as measured: 5 body evaluations per closure of stage 3.
Differs: the official code asks for the first frame's joints three times, in two frames of reference. The world is
fixed here, so that one answer serves, and the other two are paid for and dropped (without their share of the backward
pass). It evaluates the sequence in the world's frame and in the camera's; here twice in the world's. Its body layer
has the size of the whole clip also while only 15 frames are rolled out; here that of what is rolled out.
"""

import torch
from torch import Tensor

from motionlab.humor import state
from motionlab.humor.evidence import Evidence
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import Rollout
from motionlab.humor.unknowns import Parametrisation, Posed, Rolled, Unknowns
from studies.official import rollout as official_rollout
from studies.official.body import body_joints_by_lbs, first_joints_by_lbs
from studies.official.rotation import matrix_to_axis_angle, pose_from_axis_angle

FIRST_FRAME_CALLS = 3


def _posed(root: Tensor, aa: Tensor, each: Unknowns, evidence: Evidence, joints: Tensor | None = None) -> Posed:
    """One evaluation of the body; ``joints``: from an earlier one, to be used beside this one's landmarks."""
    now, marks = body_joints_by_lbs(root, aa, each.betas)
    joints = now if joints is None else joints
    observed = now if evidence.view is None else evidence.view.pixels(marks, each.camera)
    return Posed(root, pose_from_axis_angle(aa), joints, observed, each.betas, each.camera)


def _pose_vectors(each: Unknowns, priors: Priors) -> Tensor:
    """Rotation vectors (..., 22, 3): the root's as they are, the body's out of the pose prior's matrices."""
    body = matrix_to_axis_angle(priors.pose.decode(each.latent))
    return torch.cat((each.orient[..., None, :], body), -2)


def pose(unknown: Unknowns, priors: Priors, evidence: Evidence) -> Posed:
    """Stages 1 and 2, arguments as ``unknowns.pose``; orient (G, W, T, 3)."""
    each = unknown.per_window()
    return _posed(each.trans, _pose_vectors(each, priors), each, evidence)


def first_state(unknown: Unknowns, priors: Priors, frames: int) -> Tensor:
    """x0 (B, 339), world; ``frames`` of the sequence that the body layer was made for."""
    each = unknown.per_window()
    aa, trans, betas = _pose_vectors(each, priors), each.trans, each.betas
    for _ in range(FIRST_FRAME_CALLS):
        joints = first_joints_by_lbs(trans, aa, betas, frames)
    rot = pose_from_axis_angle(aa)
    parts = {"trans": trans, "root_orient": rot[:, 0], "pose_body": rot[:, 1:], "joints": joints}
    speeds = {"trans_vel": each.trans_vel, "root_orient_vel": each.root_orient_vel}
    return state.pack(parts | speeds | {"joints_vel": each.joints_vel.unflatten(-1, (22, 3))})


def rollout(unknown: Unknowns, priors: Priors) -> tuple[Tensor, Rollout, Tensor]:
    """What the official code calls its roll-out function: the first state with its body, the chain with the prior in
    it, and the result as rotation vectors. States (B, T, 339), the roll-out, vectors (B, T, 22, 3)."""
    z = unknown.per_window().z
    first = first_state(unknown, priors, z.shape[1] + 1)
    rolled = official_rollout.rollout(priors.motion, first, z)
    states = torch.cat((first[:, None], rolled.states), 1)
    parts = state.unpack(states)
    aa = matrix_to_axis_angle(torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), -3))
    return states, rolled, aa


def roll(unknown: Unknowns, priors: Priors, evidence: Evidence) -> Rolled:
    """Stage 3, arguments as ``unknowns.roll``."""
    states, rolled, aa = rollout(unknown, priors)
    each = unknown.per_window()
    trans = states[..., state.SLICES["trans"]]
    joints, _ = body_joints_by_lbs(trans, aa, each.betas)
    return Rolled(states, rolled, _posed(trans, aa, each, evidence, joints))


#: For ``testops.fit`` in official mode: what the official code does, at its price.
FAITHFUL = Parametrisation(pose, roll)
