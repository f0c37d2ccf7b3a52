"""From the unknowns of a fit to a posed body: rotations, forward kinematics, landmarks, pixels.

Leading axes: G recordings, W windows of each (one where a recording is no longer than a window), T frames. Shape and
camera belong to a recording, everything else to a window. Here B = G W rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.frames import heading_frame
from motionlab.humor import compiled, state
from motionlab.humor.closed_loop import steered_rollout
from motionlab.humor.observed import Evidence
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import Rollout, rollout
from motionlab.humor.shape import landmarks, offsets
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, Skeleton, fk

Variables = Mapping[str, Tensor]
#: What belongs to a recording rather than to one of its windows.
SHARED = ("betas", "camera")


class Posed(NamedTuple):
    """A body in B rows of T frames: root (B, T, 3), rot (B, T, 22, 3, 3), joints (B, T, 22, 3), world; the points
    that were observed (B, T, K, D): joints, or pixels of the 25 landmarks; betas (B, 8) and camera (B, 3)."""

    root: Tensor
    rot: Tensor
    joints: Tensor
    observed: Tensor
    betas: Tensor
    camera: Tensor | None


class Rolled(NamedTuple):
    """A roll-out with its first state in front: states (B, T, 339), the roll-out itself, and the body it poses."""

    states: Tensor
    rollout: Rollout
    body: Posed


def rows(variables: Variables, name: str) -> Tensor:
    """A variable with one row per window, (B, ...)."""
    value = variables[name]
    if name not in SHARED:
        return value.flatten(0, 1)
    windows = variables["trans"].shape[1]
    return value if windows == 1 else value.repeat_interleave(windows, 0)


def to_matrix(turn: Tensor) -> Tensor:
    """Rotations (..., 3, 3) from 6 numbers, or from rotation vectors where there are 3."""
    return rotation.sixd_to_matrix(turn) if turn.shape[-1] == 6 else rotation.exp(turn)


def from_matrix(turn: Tensor, mode: str) -> Tensor:
    """The unknowns of a rotation (..., 3, 3): 6 numbers in "lean" mode, a rotation vector (..., 3) in "faithful"."""
    return rotation.matrix_to_sixd(turn) if mode == "lean" else rotation.log(turn)


def skeleton_of(betas: Tensor) -> Skeleton:
    """The standard skeleton of B people with shapes (B, 8); offsets (B, 1, 22, 3)."""
    return replace(STANDARD, offsets=offsets(betas)[:, None])


def _posed(root: Tensor, rot: Tensor, variables: Variables, evidence: Evidence) -> Posed:
    betas = rows(variables, "betas")
    camera = rows(variables, "camera") if "camera" in variables else None
    joints, turns = fk(skeleton_of(betas), root, rot)
    if evidence.view is None:
        return Posed(root, rot, joints, joints, betas, camera)
    pixels = evidence.view.pixels(landmarks(joints, turns, betas), camera)
    return Posed(root, rot, joints, pixels, betas, camera)


def pose(variables: Variables, priors: Priors, evidence: Evidence) -> Posed:
    """Stages 1 and 2: every frame's root and pose latent are unknowns.

    trans (G, W, T, 3), orient (G, W, T, 6 or 3), latent (G, W, T, 32), betas (G, 8), camera (G, 3) where there is one.
    """
    turn = to_matrix(rows(variables, "orient"))
    body = priors.pose.decode(rows(variables, "latent"))
    return _posed(rows(variables, "trans"), torch.cat((turn[..., None, :, :], body), -3), variables, evidence)


def first_state(variables: Variables, priors: Priors) -> Tensor:
    """x0 (B, 339), world: root, pose latent and velocities are unknowns, its joints follow from them and the shape."""
    turn = to_matrix(rows(variables, "orient"))
    body = priors.pose.decode(rows(variables, "latent"))
    trans = rows(variables, "trans")
    rot = torch.cat((turn[:, None], body), -3)
    skeleton = replace(STANDARD, offsets=offsets(rows(variables, "betas")))
    parts = {"trans": trans, "root_orient": turn, "pose_body": body, "joints": fk(skeleton, trans, rot)[0]}
    speeds = {name: rows(variables, name) for name in ("trans_vel", "root_orient_vel")}
    return state.pack(parts | speeds | {"joints_vel": rows(variables, "joints_vel").unflatten(-1, (22, 3))})


def roll(variables: Variables, priors: Priors, evidence: Evidence) -> Rolled:
    """Stage 3: the motion that a first state and latents z (G, W, T - 1, 48) decode to."""
    first, z = first_state(variables, priors), rows(variables, "z")
    frozen = not any(weight.requires_grad for weight in priors.motion.decoder.parameters())
    fast = frozen and compiled.fits(first, z)
    found = steered_rollout(priors.motion, first, z)[0] if fast else rollout(priors.motion, first, z)
    return rolled_from(first, found, variables, evidence)


def rolled_from(first: Tensor, rolled: Rollout, variables: Variables, evidence: Evidence) -> Rolled:
    """A roll-out from first states (B, 339) with the body that it poses."""
    states = torch.cat((first[:, None], rolled.states), 1)
    parts = state.unpack(states)
    rot = torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), -3)
    return Rolled(states, rolled, _posed(parts["trans"], rot, variables, evidence))


def local_first(states: Tensor) -> Tensor:
    """First states (B, 339) in their own heading frames."""
    parts = state.unpack(states)
    return state.localise(states, heading_frame(parts["trans"], parts["root_orient"]))


def motion_of(body: Posed, fps: float, name: str = "", contacts: Tensor | None = None) -> Motion:
    """The motion (B, T) of a posed body, each row on its own skeleton, without gradients."""
    skeleton = skeleton_of(body.betas.detach())
    return Motion(skeleton, body.root.detach(), body.rot.detach(), fps, contacts, name)
