"""Where the gradient of a vertex goes: which joints move it, which should, and what pruning stops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.body import BodyModel, lbs
from motionlab.motion import Motion
from motionlab.skinning import ancestors, displacement, prune


def influence(body: BodyModel, root: Tensor, rot: Tensor, vertices: Sequence[int]) -> Tensor:
    """How far each vertex moves per radian that each joint turns, at one pose: (K, J), metres per radian.

    The Frobenius norm of d v_k / d w_j at w = 0, where joint j has rotation rot_j exp(w_j).

    Args:
        root: (3,). rot: (J, 3, 3). vertices: K indices into the mesh.
    """

    def place(turn: Tensor) -> Tensor:  # (J, 3) -> (K, 3)
        turned = rot @ rotation.exp(turn)
        return lbs(body, body.skeleton, root[None], turned[None], vertices=vertices)[0]

    jacobian = torch.func.jacrev(place)(torch.zeros_like(rot[..., 0]))  # (K, 3, J, 3)
    return jacobian.square().sum((1, 3)).sqrt()


@dataclass(frozen=True, eq=False)
class Leakage:
    """Gradient of keypoints that reaches joints which should not move them.

    influence (K, J): metres per radian. allowed (K, J): True for the joints that hold the keypoint and all above.
    """

    influence: Tensor
    allowed: Tensor

    @property
    def per_joint(self) -> Tensor:
        """Leaked influence (J,), metres per radian, root of the sum of squares over the keypoints."""
        return torch.where(self.allowed, 0, self.influence).square().sum(0).sqrt()

    @property
    def share(self) -> float:
        """Leaked gradient norm over the whole gradient norm."""
        return float(self.per_joint.norm() / self.influence.norm())


def leakage(body: BodyModel, root: Tensor, rot: Tensor, vertices: Sequence[int], holds: float = 0.05) -> Leakage:
    """Gradient leakage at one pose; see :class:`Leakage`.

    A joint *holds* a vertex if its weight there is at least ``holds``; through the kinematic chain every
    joint above it moves the vertex rightly, so only what reaches any other joint has leaked.

    Source: thesis 3.3.2.
    """
    held = (body.weights[torch.as_tensor(vertices)] >= holds).long()
    return Leakage(influence(body, root, rot, vertices), held @ ancestors(body.skeleton).long() > 0)


def sweep(body: BodyModel, motion: Motion, vertices: Sequence[int], thresholds: Sequence[float]) -> list[dict]:
    """What each pruning threshold buys and costs, one dict per threshold.

    Keys: threshold, removed (share of the non-zero weights), leakage (share of gradient norm at the first frame),
    mean_mm and max_mm (vertex displacement over the motion).
    """
    rows = []
    root, rot = motion.root.flatten(0, -2)[0], motion.rot.flatten(0, -4)[0]
    for threshold in thresholds:
        pruned = prune(body, threshold)
        mean, largest = displacement(body, pruned, motion)
        rows.append(
            {
                "threshold": threshold,
                "removed": 1 - int((pruned.weights > 0).sum()) / int((body.weights > 0).sum()),
                "leakage": leakage(pruned, root, rot, vertices).share,
                "mean_mm": 1000 * mean,
                "max_mm": 1000 * largest,
            }
        )
    return rows
