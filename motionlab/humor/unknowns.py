"""The unknowns of a fit, and the posed body that they stand for: rotations, forward kinematics, landmarks, pixels.

Source: HuMoR (Rempe et al. 2021), section 4.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.humor import state
from motionlab.humor.body_shape import landmarks, offsets
from motionlab.humor.evidence import Evidence
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import Rollout, rollout
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, Skeleton, fk

_FLAT = 0.1  # the sine of the angle between the two vectors of a rotation, below which they are nearly parallel
#: The unknowns of the first state, x0, and of how many numbers a small change of each is (of a rotation, its vector).
FIRST = {"trans": 3, "orient": 3, "latent": 32, "trans_vel": 3, "root_orient_vel": 3, "joints_vel": 66}


@dataclass(frozen=True, eq=False)
class Unknowns:
    """What a fit looks for, of B recordings.

    Stages 1 and 2, of every frame: trans (B, T, 3) and orient (B, T, 6, or 3 in official mode) of the root, world;
    latent (B, T, 32) of the pose prior. Stage 3: the same of the first state (B, ...), with trans_vel (B, 3),
    root_orient_vel (B, 3) and joints_vel (B, 66), and the latents z (B, T - 1, 48) of the transitions; None before. Of
    a recording: betas (B, 8), shape in standard deviations; camera (B, 3), its change of tilt, roll and height, None
    for observations in 3-D.
    """

    trans: Tensor
    orient: Tensor
    latent: Tensor
    trans_vel: Tensor | None = None
    root_orient_vel: Tensor | None = None
    joints_vel: Tensor | None = None
    z: Tensor | None = None
    betas: Tensor | None = None
    camera: Tensor | None = None

    def named(self) -> dict[str, Tensor]:
        """Returns those that are there by name, in their order."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) is not None}

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Computes the same with every tensor changed."""
        return Unknowns(**{name: change(value) for name, value in self.named().items()})

    def rows(self, index: Tensor | slice) -> Self:
        """Returns those of some recordings."""
        return self.map(lambda value: value[index])

    def detached(self) -> Self:
        """Returns the same without gradients."""
        return self.map(Tensor.detach)

    def shared(self) -> dict[str, Tensor]:
        """Returns those that all frames share, by name."""
        return {name: value for name, value in self.named().items() if name in ("betas", "camera")}


class Posed(NamedTuple):
    """A body in B recordings of T frames: root (B, T, 3), rot (B, T, 22, 3, 3), joints (B, T, 22, 3), world; the points
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


def to_matrix(turn: Tensor) -> Tensor:
    """Computes rotations (..., 3, 3) from 6 numbers, or from rotation vectors where there are 3."""
    return rotation.sixd_to_matrix(turn) if turn.shape[-1] == 6 else rotation.exp(turn)


def from_matrix(turn: Tensor, mode: str) -> Tensor:
    """Computes the unknowns of a rotation (..., 3, 3): "lean" 6 numbers, "official" a rotation vector (..., 3)."""
    return rotation.matrix_to_sixd(turn) if mode == "lean" else rotation.log(turn)


def reorthogonalised(turn: Tensor) -> Tensor:
    """Writes rotations (..., 6) anew where their two vectors are nearly parallel: there a search would stand still."""
    first, second = turn[..., :3], turn[..., 3:]
    area, sides = torch.linalg.cross(first, second).norm(dim=-1), first.norm(dim=-1) * second.norm(dim=-1)
    return torch.where((area < _FLAT * sides)[..., None], from_matrix(to_matrix(turn), "lean"), turn)


def skeleton_of(betas: Tensor) -> Skeleton:
    """Computes the standard skeleton of B people from their shapes (B, 8); offsets (B, 1, 22, 3)."""
    return replace(STANDARD, offsets=offsets(betas)[:, None])


def _posed(root: Tensor, rot: Tensor, unknown: Unknowns, evidence: Evidence) -> Posed:
    betas, camera, view = unknown.betas, unknown.camera, evidence.view
    joints, turns = fk(skeleton_of(betas), root, rot)
    seen = joints if view is None else view.pixels(landmarks(joints, turns, betas), camera)
    return Posed(root, rot, joints, seen, betas, camera)


def pose(unknown: Unknowns, priors: Priors, evidence: Evidence) -> Posed:
    """Computes the bodies of stages 1 and 2, where every frame's root and pose latent are unknowns."""
    rot = torch.cat((to_matrix(unknown.orient)[..., None, :, :], priors.pose.decode(unknown.latent)), -3)
    return _posed(unknown.trans, rot, unknown, evidence)


def of_first_state(first: Tensor, latent: Tensor, mode: str = "lean", **more: Tensor) -> Unknowns:
    """Computes the unknowns of first states (B, 339) with pose latents (B, 32), and with ``more`` of them as given."""
    parts = state.unpack(first)
    same = {name: parts[name] for name in ("trans", "trans_vel", "root_orient_vel")}
    orient, joints_vel = from_matrix(parts["root_orient"], mode), parts["joints_vel"].flatten(-2)
    return Unknowns(orient=orient, latent=latent, joints_vel=joints_vel, **same, **more)


def first_state(unknown: Unknowns, priors: Priors) -> Tensor:
    """Computes x0 (B, 339), world, from its unknowns; its joints follow from root, pose and shape."""
    turn, body = to_matrix(unknown.orient), priors.pose.decode(unknown.latent)
    skeleton = replace(STANDARD, offsets=offsets(unknown.betas))
    return state.pack({
        "trans": unknown.trans, "trans_vel": unknown.trans_vel, "root_orient": turn,
        "root_orient_vel": unknown.root_orient_vel, "pose_body": body,
        "joints": fk(skeleton, unknown.trans, torch.cat((turn[:, None], body), -3))[0],
        "joints_vel": unknown.joints_vel.unflatten(-1, (22, 3)),
    })  # fmt: skip


def roll(unknown: Unknowns, priors: Priors, evidence: Evidence) -> Rolled:
    """Computes the bodies of stage 3: the motion that a first state and latents decode to."""
    first = first_state(unknown, priors)
    return rolled_from(first, rollout(priors.motion, first, unknown.z), unknown, evidence)


def rolled_from(first: Tensor, rolled: Rollout, unknown: Unknowns, evidence: Evidence) -> Rolled:
    """Computes the body that a roll-out from first states (B, 339) poses."""
    states = torch.cat((first[:, None], rolled.states), 1)
    parts = state.unpack(states)
    rot = torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), -3)
    return Rolled(states, rolled, _posed(parts["trans"], rot, unknown, evidence))


def first_state_in_heading_frame(states: Tensor) -> Tensor:
    """Computes first states (B, 339) in their own heading frames."""
    return state.localise(states, state.heading(states))


def motion_of(body: Posed, fps: float, contacts: Tensor | None = None) -> Motion:
    """Returns the motion (B, T) of a posed body, each row on its own skeleton, without gradients."""
    return Motion(skeleton_of(body.betas.detach()), body.root.detach(), body.rot.detach(), fps, contacts)
