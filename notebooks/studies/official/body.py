"""A full body as the official code evaluates it: a mesh of SMPL-H's size, posed by axis-angle, every vertex every time.

6,890 vertices, 52 joints, 16 shape directions, pose correctives. No such body may be shipped here, so its surface is
random numbers; but its first 22 joints and its landmarks lie exactly where ``body_shape`` puts them, so that what the
energies see is what forward kinematics alone would give them, at the official price.

Source: Loper et al. 2015 (SMPL), Eq. 2-4, in the order of operations that the official code's body layer has; sizes of
SMPL-H.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab.humor.body_shape import landmarks, offsets
from motionlab.skeleton import STANDARD, fk
from studies.official.rotation import axis_angle_to_matrix

VERTICES, JOINTS, SHAPES, MARKS = 6890, 52, 16, 25
#: Fifteen joints in each hand, three to a finger.
PARENTS = (*STANDARD.parents, *(p for hand in range(2) for f in range(5)
           for p in (20 + hand, 22 + 15 * hand + 3 * f, 23 + 15 * hand + 3 * f)))  # fmt: skip


@dataclass(frozen=True, eq=False)
class FullBody:
    """The arrays of such a body; its first 52 vertices are its joints and the next 25 its landmarks.

    template (V, 3), shape_directions (V, 3, 16), pose_directions (459, 3 V), regressor (52, V), weights (V, 52).
    """

    template: Tensor
    shape_directions: Tensor
    pose_directions: Tensor
    regressor: Tensor
    weights: Tensor

    def rest(self, betas: Tensor) -> Tensor:
        """Rest positions (N, 52 + 25, 3) of joints and landmarks of people with shapes (N, 8)."""
        root = betas.new_zeros(len(betas), 3)
        upright = torch.eye(3).to(betas).expand(len(betas), len(STANDARD), 3, 3)
        joints, turns = fk(replace(STANDARD, offsets=offsets(betas)), root, upright)
        marks = landmarks(joints[:, None], turns[:, None], betas)[:, 0]
        fingers = joints[:, [20] * 15 + [21] * 15]
        return torch.cat((joints, fingers, marks), 1)


@lru_cache(maxsize=2)
def smplh_sized(dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> FullBody:
    """The one body of this size; random where nothing looks."""
    generator = torch.Generator().manual_seed(0)

    def noise(*shape: int, scale: float) -> Tensor:
        return scale * torch.randn(*shape, generator=generator)

    known = JOINTS + MARKS
    pose = noise(9 * (JOINTS - 1), VERTICES, 3, scale=0.001)
    pose[:, :known] = 0
    weights = noise(VERTICES, JOINTS, scale=2.0).softmax(-1)
    weights[:JOINTS] = torch.eye(JOINTS)
    weights[JOINTS:known] = F.pad(_landmark_weights(), (0, JOINTS - len(STANDARD)))
    regressor = torch.zeros(JOINTS, VERTICES)
    regressor[:, :JOINTS] = torch.eye(JOINTS)
    body = (noise(VERTICES, 3, scale=0.5), noise(VERTICES, 3, SHAPES, scale=0.01), pose.flatten(1), regressor, weights)
    return FullBody(*(x.to(device, dtype) for x in body))


def _landmark_weights() -> Tensor:
    """How much of each joint's movement each landmark makes, (25, 22)."""
    betas = torch.zeros(len(STANDARD), 8)
    turns = torch.eye(3).expand(len(STANDARD), 1, len(STANDARD), 3, 3)
    moved = F.pad(torch.eye(len(STANDARD))[:, None, :, None], (0, 2))  # joint j a metre to the left
    return (landmarks(moved, turns, betas) - landmarks(torch.zeros_like(moved), turns, betas))[:, 0, :, 0].mT


def skin(body: FullBody, trans: Tensor, aa: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
    """Joints (N, 52, 3) and vertices (N, V, 3), world, of N frames: trans (N, 3), aa (N, 22, 3), betas (N, 8)."""
    count = len(trans)
    pose = torch.cat((aa, aa.new_zeros(count, JOINTS - len(STANDARD), 3)), 1)
    padded = F.pad(betas, (0, SHAPES - betas.shape[1]))
    shaped = body.template + torch.einsum("bl,mkl->bmk", padded, body.shape_directions)
    exact = body.rest(betas)
    shaped = torch.cat((exact, shaped[:, exact.shape[1] :]), 1)
    joints = torch.einsum("bik,ji->bjk", shaped, body.regressor)
    rot = axis_angle_to_matrix(pose.reshape(-1, 3)).view(count, JOINTS, 3, 3)
    bend = (rot[:, 1:] - torch.eye(3).to(rot)).flatten(1)
    posed = shaped + torch.matmul(bend, body.pose_directions).view(count, -1, 3)
    places, transforms = _chain(rot, joints)
    blended = torch.matmul(body.weights.expand(count, -1, -1), transforms.view(count, JOINTS, 16)).view(count, -1, 4, 4)
    one = posed.new_ones(count, posed.shape[1], 1)
    skinned = torch.matmul(blended, torch.cat((posed, one), 2)[..., None])[:, :, :3, 0]
    return places + trans[:, None], skinned + trans[:, None]


def _chain(rot: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Joint positions (N, 52, 3) and 4x4 transforms relative to the rest pose, joint after joint."""
    up = list(PARENTS[1:])
    bones = torch.cat((joints[:, :1], joints[:, 1:] - joints[:, up]), 1)
    local = torch.cat((F.pad(rot, (0, 0, 0, 1)), F.pad(bones[..., None], (0, 0, 0, 1), value=1.0)), -1)
    chain = [local[:, 0]]
    for joint, parent in enumerate(up, start=1):
        chain.append(torch.matmul(chain[parent], local[:, joint]))
    world = torch.stack(chain, 1)
    there = torch.matmul(world, F.pad(joints, (0, 1))[..., None])
    return world[:, :, :3, 3], world - F.pad(there, (3, 0))


def body_joints_by_lbs(root: Tensor, aa: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
    """Joints (B, T, 22, 3) and landmarks (B, T, 25, 3), world: all vertices of all frames are posed for them.

    root (B, T, 3): the pelvis. aa (B, T, 22, 3): rotation vectors. betas (B, 8).
    """
    batch, frames = root.shape[:2]
    per_frame = betas[:, None].expand(-1, frames, -1).flatten(0, 1)
    joints, vertices = skin(smplh_sized(root.dtype, root.device), root.flatten(0, 1), aa.flatten(0, 1), per_frame)
    found = joints[:, : len(STANDARD)], vertices[:, JOINTS : JOINTS + MARKS]
    return found[0].unflatten(0, (batch, frames)), found[1].unflatten(0, (batch, frames))


def first_joints_by_lbs(root: Tensor, aa: Tensor, betas: Tensor, frames: int) -> Tensor:
    """Joints (B, 22, 3) of one frame each, root (B, 3), aa (B, 22, 3): asked of a body layer that knows only batches of
    all B x ``frames``, into which the one frame is expanded."""
    root, aa = root[:, None].expand(-1, frames, -1), aa[:, None].expand(-1, frames, -1, -1)
    return body_joints_by_lbs(root, aa, betas)[0][:, 0]
