"""The unknowns of a fit, and the posed body that they stand for: rotations, forward kinematics, landmarks, pixels.

A recording that is longer than the roll-out can carry is cut into overlapping windows of one length. In stage 3
neighbours are asked to agree over the frames they share (``stages``); what is left of the gap is blended here.

Source: HuMoR (Rempe et al. 2021), section 4; windows: the official code's ``use_split`` (60 frames, at least 10 shared,
the remainder spread), which keeps the earlier one's frames.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.errors import ShapeError
from motionlab.humor import state
from motionlab.humor.body_shape import landmarks, offsets
from motionlab.humor.evidence import Evidence
from motionlab.humor.priors import Priors
from motionlab.humor.rollout import Rollout, rollout
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, Skeleton, fk

_SHARED = ("betas", "camera")  # what belongs to a recording rather than to one of its windows
_FLAT = 0.1  # the sine of the angle between the two vectors of a rotation, below which they are nearly parallel
#: The unknowns of the first state, x0.
FIRST = ("trans", "orient", "latent", "trans_vel", "root_orient_vel", "joints_vel")


@dataclass(frozen=True, eq=False)
class Unknowns:
    """What a fit looks for: G recordings, W windows of each (one where a recording is no longer than a window).

    Stages 1 and 2, of every frame: trans (G, W, T, 3) and orient (G, W, T, 6, or 3 in official mode) of the root,
    world; latent (G, W, T, 32) of the pose prior. Stage 3: the same of the first state (G, W, ...), with trans_vel (G,
    W, 3), root_orient_vel (G, W, 3) and joints_vel (G, W, 66), and the latents z (G, W, T - 1, 48) of the transitions;
    None before. Of a recording: betas (G, 8), shape in standard deviations; camera (G, 3), its change of tilt, roll and
    height, None for observations in 3-D.
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
        """Returns those of a recording by name."""
        return {name: value for name, value in self.named().items() if name in _SHARED}

    def per_window(self) -> Self:
        """Returns the same with one row for each of the B = G W windows, as one leading axis."""
        found, windows = self.named(), self.trans.shape[1]
        own = {name: value.flatten(0, 1) for name, value in found.items() if name not in _SHARED}
        shared = {name: x if windows == 1 else x.repeat_interleave(windows, 0) for name, x in self.shared().items()}
        return Unknowns(**own, **shared)


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


def _posed(root: Tensor, rot: Tensor, each: Unknowns, evidence: Evidence) -> Posed:
    joints, turns = fk(skeleton_of(each.betas), root, rot)
    view = evidence.view
    seen = joints if view is None else view.pixels(landmarks(joints, turns, each.betas), each.camera)
    return Posed(root, rot, joints, seen, each.betas, each.camera)


def pose(unknown: Unknowns, priors: Priors, evidence: Evidence) -> Posed:
    """Computes the bodies of stages 1 and 2, where every frame's root and pose latent are unknowns."""
    each = unknown.per_window()
    rot = torch.cat((to_matrix(each.orient)[..., None, :, :], priors.pose.decode(each.latent)), -3)
    return _posed(each.trans, rot, each, evidence)


def first_state(unknown: Unknowns, priors: Priors) -> Tensor:
    """Computes x0 (B, 339), world, from its unknowns; its joints follow from root, pose and shape."""
    each = unknown.per_window()
    turn, body = to_matrix(each.orient), priors.pose.decode(each.latent)
    skeleton = replace(STANDARD, offsets=offsets(each.betas))
    return state.pack({
        "trans": each.trans, "trans_vel": each.trans_vel, "root_orient": turn,
        "root_orient_vel": each.root_orient_vel, "pose_body": body,
        "joints": fk(skeleton, each.trans, torch.cat((turn[:, None], body), -3))[0],
        "joints_vel": each.joints_vel.unflatten(-1, (22, 3)),
    })  # fmt: skip


def roll(unknown: Unknowns, priors: Priors, evidence: Evidence) -> Rolled:
    """Computes the bodies of stage 3: the motion that a first state and latents decode to."""
    first = first_state(unknown, priors)
    return rolled_from(first, rollout(priors.motion, first, unknown.z.flatten(0, 1)), unknown, evidence)


def rolled_from(first: Tensor, rolled: Rollout, unknown: Unknowns, evidence: Evidence) -> Rolled:
    """Computes the body that a roll-out from first states (B, 339) poses."""
    states = torch.cat((first[:, None], rolled.states), 1)
    parts = state.unpack(states)
    rot = torch.cat((parts["root_orient"][..., None, :, :], parts["pose_body"]), -3)
    return Rolled(states, rolled, _posed(parts["trans"], rot, unknown.per_window(), evidence))


def first_state_in_heading_frame(states: Tensor) -> Tensor:
    """Computes first states (B, 339) in their own heading frames."""
    return state.localise(states, state.heading(states))


def motion_of(body: Posed, fps: float, contacts: Tensor | None = None) -> Motion:
    """Returns the motion (B, T) of a posed body, each row on its own skeleton, without gradients."""
    return Motion(skeleton_of(body.betas.detach()), body.root.detach(), body.rot.detach(), fps, contacts)


def window_starts(frames: int, length: int, overlap: int) -> tuple[int, ...]:
    """Computes the first frames of the fewest windows of ``length`` that cover ``frames`` and share ``overlap``.

    Raises:
        ShapeError: windows that could not move on.
    """
    if not 0 < overlap < length:
        raise ShapeError(f"overlap: expected 1 to {length - 1} of {length} frames, got {overlap}")
    if frames <= length:
        return (0,)
    count = -(-(frames - overlap) // (length - overlap))
    return tuple(round(k * (frames - length) / (count - 1)) for k in range(count))


def cut_windows(x: Tensor, starts: Sequence[int], length: int) -> Tensor:
    """Cuts windows (G, W, L, ...) out of (G, T, ...)."""
    return x[:, torch.tensor(starts)[:, None] + torch.arange(min(length, x.shape[1]))]


def stitch_windows(x: Tensor, starts: Sequence[int]) -> Tensor:
    """Computes one (G, T, ...) from windows (G, W, L, ...); over shared frames the weight moves evenly, of rotations
    (..., J, 3, 3) along the shortest way."""
    out = x[:, 0]
    for w, start in enumerate(starts[1:], start=1):
        shared = out.shape[1] - start
        ramp = (torch.arange(1, shared + 1) / (shared + 1)).to(x)
        before, after = out[:, start:], x[:, w, :shared]
        if x.ndim > 5:  # rotations: numbers of a frame have four axes here
            ramp = ramp.reshape(-1, *(1,) * (x.ndim - 5))  # (shared, 1 per joint)
            mixed = rotation.slerp(before, after, ramp.expand(before.shape[1:-2]))
        else:
            mixed = torch.lerp(before, after, ramp.reshape(-1, *(1,) * (x.ndim - 3)))
        out = torch.cat((out[:, :start], mixed, x[:, w, shared:]), 1)
    return out
