"""Where a fit begins: root position and orientation of every frame, found in closed form from what is visible.

Differs: the official code starts every 3-D clip at identity, and a video at one orientation and one depth (from
bones counted as zero where they were not detected). Unseen frames stay there; here they are interpolated.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.baselines import interpolate
from motionlab.humor.observed import Evidence, View
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT

#: The rigid part of the body, for the 3-D start; the limbs count little, as they move.
_TORSO = STANDARD.indices(
    ["pelvis", "left_hip", "right_hip", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"]
)
_LIMB_WEIGHT = 0.02
_MIN_SPREAD = 0.02  # metres: the second principal spread below which visible points give no orientation


def start_3d(evidence: Evidence, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The mean pose laid onto the visible joints of each frame by the best rotation (weighted Procrustes).

    rest (22, 3): joints of the mean pose, root at the origin, its orientation identity.

    Returns:
        trans (B, T, 3), orientation (B, T, 3, 3), and which frames (B, T) had enough to see.
    """
    share = torch.full((22,), _LIMB_WEIGHT).to(rest)
    share[_TORSO] = 1.0
    weight = evidence.weight * share
    total = weight.sum(-1).clamp(min=1e-6)[..., None]
    part = weight[..., None] / total[..., None]
    here, there = (part * rest).sum(-2), (part * evidence.values).sum(-2)
    x, y = rest - here[..., None, :], evidence.values - there[..., None, :]
    spread = torch.linalg.svdvals((part.sqrt() * x).double())[..., 1]
    enough = (weight > 0).sum(-1).ge(3) & spread.gt(_MIN_SPREAD)
    moment = torch.where(enough[..., None, None], y.mT @ (part * x), torch.eye(3).to(rest))
    turn = rotation.nearest(moment)
    return there - (turn @ here[..., None])[..., 0], turn, enough


def start_2d(evidence: Evidence, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The mean pose put in front of the camera: orientations from a grid, the position in closed form for each.

    For an orientation the pinhole equations are linear in the position t: with q the turned landmark in the camera
    and (a, b) its pixel on the plane at depth one, t_x - a t_z = a q_z - q_x, t_y - b t_z = b q_z - q_y. Of 144
    orientations (16 headings; upright, leaning 50 degrees each way, lying each way) the sequence with the least
    reprojection error and turning is found over time (Viterbi): the person does not flip from frame to frame.

    A few keypoints close together leave the depth open: there the start may jump, and stage 1 has to undo that.

    rest (25, 3): landmarks of the mean pose, root at the origin, its orientation identity.

    Returns:
        trans (B, T, 3), orientation (B, T, 3, 3), and which frames (B, T) had enough to see, 4 keypoints.
    """
    view = evidence.view
    poses, upright_cost = _orientations()
    poses, upright_cost = poses.to(rest), upright_cost.to(rest)
    trans, cost = _place(evidence, view, poses, rest)  # (B, T, N, 3), (B, T, N)
    enough = (evidence.weight > 0).sum(-1) >= 4
    cost = torch.where(enough[..., None], cost + upright_cost, 0.0)
    path = _viterbi(cost, rotation.geodesic(poses[:, None], poses[None]).square())
    at = path[..., None, None].expand(*path.shape, 1, 3)
    return trans.gather(2, at)[:, :, 0], poses[path], enough


def filled(trans: Tensor, turn: Tensor, known: Tensor, fps: float) -> tuple[Tensor, Tensor]:
    """Root (B, T, 3) and orientation (B, T, 3, 3), interpolated where not ``known`` (B, T); ends hold.

    A clip of which nothing is known stands upright at the origin, its feet on the floor, and looks along +y.
    """
    none = ~known.any(-1)
    up, height = UPRIGHT.to(turn), STANDARD.standing_height().to(trans)
    trans = torch.where(none[:, None, None], torch.nn.functional.pad(height[None], (2, 0)), trans)
    turn = torch.where(none[:, None, None, None], up, turn)
    still = torch.eye(3).to(turn).expand(*turn.shape[:2], 21, 3, 3)
    motion = Motion(STANDARD, trans, torch.cat((turn[:, :, None], still), 2), fps)
    whole = interpolate(motion, known | none[:, None])
    return whole.root, whole.rot[:, :, 0]


def _orientations() -> tuple[Tensor, Tensor]:
    """144 root orientations (144, 3, 3) in the world, and what each costs for not being upright."""
    ways = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, 1.0], [0, 0, -1.0]])
    lean = torch.cat((torch.zeros(1, 3), math.radians(50) * ways, math.radians(95) * ways))
    yaw = torch.arange(16) * (2 * math.pi / 16)
    turns = rotation.rotation_about("z", yaw)[:, None] @ UPRIGHT @ rotation.exp(lean)
    return turns.flatten(0, 1), torch.tensor([0.0, *(4 * [1.0]), *(4 * [1.5])]).repeat(16) * 0.02


def _place(evidence: Evidence, view: View, poses: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Best world positions (B, T, N, 3) of N orientations, and their robust reprojection errors (B, T, N).

    Errors are in units of the person's apparent size, weighted by confidence.
    """
    k = view.intrinsics[:, None, None]
    plane = (evidence.values - k[..., :2, 2]) / torch.stack((k[..., 0, 0], k[..., 1, 1]), -1)  # (B, T, K, 2)
    weight = evidence.weight.square()
    q = torch.einsum("bij,njk,lk->bnli", view.rotation, poses, rest)  # (B, N, K, 3), camera axes
    a, b = plane[:, :, None].unbind(-1)
    w = weight[:, :, None]
    o = torch.zeros_like(a)
    rows = torch.stack((torch.stack((o + 1, o, -a), -1), torch.stack((o, o + 1, -b), -1)), -2)  # (B, T, 1, K, 2, 3)
    right = torch.stack((a * q[:, None, ..., 2] - q[:, None, ..., 0], b * q[:, None, ..., 2] - q[:, None, ..., 1]), -1)
    normal = torch.einsum("btnk,btnkri,btnkrj->btnij", w, rows, rows) + 1e-6 * torch.eye(3).to(rest)
    moment = torch.einsum("btnk,btnkri,btpkr->btpi", w, rows, right)
    local = torch.linalg.solve(normal, moment[..., None])[..., 0]
    depth = local[..., 2].clamp(0.5, 50.0)
    # where the depth is not sensible, the other two follow from a sensible one
    local = torch.cat((local[..., :2] * (depth / local[..., 2].clamp(min=0.5))[..., None], depth[..., None]), -1)
    seen = q[:, None] + local[..., None, :]
    error = (seen[..., :2] / seen[..., 2:].clamp(min=0.1) - plane[:, :, None]) * depth[..., None, None]  # metres
    cost = (w * (error.square().sum(-1) / (0.04 + error.square().sum(-1)))).sum(-1) / w.sum(-1).clamp(min=1e-6)
    world = torch.einsum("bji,btnj->btni", view.rotation, local) + view.centre[:, None, None]
    return world, cost


def _viterbi(cost: Tensor, change: Tensor, weight: float = 0.3) -> Tensor:
    """The cheapest path (B, T) through costs (B, T, N), with ``weight`` times ``change`` (N, N) for every step."""
    total, back = cost[:, 0], []
    for now in cost.unbind(1)[1:]:
        best, origin = (total[:, :, None] + weight * change).min(1)
        total, back = best + now, [*back, origin]
    path = [total.argmin(-1)]
    for origin in reversed(back):
        path.append(origin.gather(1, path[-1][:, None])[:, 0])
    return torch.stack(path[::-1], 1)
