"""The energies of HuMoR's test-time optimisation: pure functions, each a sum per clip (B,).

Metres, radians, pixels; frames at 30 per second; world z up with the floor at z = 0. What was not observed is masked
before any arithmetic, so that inf and NaN there reach neither value nor gradient.

Source: HuMoR (Rempe et al. 2021), section 4, and its official code, whose values these are; thesis 3.1.2.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from motionlab.errors import ShapeError, check_shape
from motionlab.humor.cvae import Gaussian
from motionlab.humor.weights import IMAPPER, JOINTS, KEYPOINTS, PROX, RGB, Weights
from motionlab.skeleton import STANDARD

__all__ = [
    "CONTACT_JOINTS", "IMAPPER", "JOINTS", "KEYPOINTS", "PROX", "RGB", "UNUSED_BODY_25", "Weights",
    "body_25_confidence", "bone_length", "contact_height", "contact_probabilities", "contact_vel", "floor_reg", "gmof",
    "init_motion_prior", "joint_consistency", "joints2d", "joints3d", "joints3d_smooth", "motion_prior", "pose_prior",
    "shape_prior",
]  # fmt: skip

#: Joints of BODY_25 whose confidence counts as zero: neck and hips, which OpenPose and SMPL place differently.
UNUSED_BODY_25 = (1, 9, 12)
#: The nine joints that may touch the floor, in the order of HuMoR's contact logits.
CONTACT_JOINTS = tuple(STANDARD.contact_indices)
#: The other end of each bone 1..21. The collars hang on the neck here, as in the official energy, and not on the spine;
#: all three move with the spine, so that these lengths too are constant in a body.
BONE_PARENTS = tuple({13: 12, 14: 12}.get(j, STANDARD.parents[j]) for j in range(1, len(STANDARD)))
SIGMA = 100.0  # pixels
TOUCHING = 0.08  # metres: a joint in contact may be this far from the floor


class Density(Protocol):
    """What :func:`init_motion_prior` needs of a distribution, such as ``init_gmm.InitGmm``."""

    def log_prob(self, features: Tensor) -> Tensor: ...


def _per_clip(x: Tensor) -> Tensor:
    return x.flatten(1).sum(1)


def _half_squares(x: Tensor) -> Tensor:
    return 0.5 * _per_clip(x.square())


def gmof(residual: Tensor, sigma: float = SIGMA) -> Tensor:
    """Geman-McClure, elementwise: sigma^2 r^2 / (sigma^2 + r^2), quadratic near 0 and never above sigma^2."""
    squared = residual.square()
    return sigma**2 * squared / (sigma**2 + squared)


def joints2d(pixels: Tensor, keypoints: Tensor, confidence: Tensor, sigma: float = SIGMA) -> Tensor:
    """sum conf^2 gmof(pixel - keypoint), coordinate by coordinate.

    pixels, keypoints: (B, T, K, 2), predicted and detected. confidence: (B, T, K); where it is 0, or where the
    keypoint is not finite, nothing was detected.
    """
    check_shape(pixels, "B T K 2", "pixels")
    seen = (confidence > 0) & keypoints.isfinite().all(-1)
    residual = torch.where(seen[..., None], pixels - keypoints, 0.0)
    weight = torch.where(seen, confidence, 0.0).square()
    return _per_clip(weight[..., None] * gmof(residual, sigma))


def body_25_confidence(confidence: Tensor) -> Tensor:
    """Confidences (..., 25) of BODY_25 with neck and hips at zero."""
    check_shape(confidence, "... 25", "confidence")
    return confidence.index_fill(-1, torch.tensor(UNUSED_BODY_25, device=confidence.device), 0.0)


def joints3d(joints: Tensor, observed: Tensor, visible: Tensor | None = None) -> Tensor:
    """1/2 sum |joint - observed|^2 over what is visible and finite.

    joints, observed: (B, T, N, 3), joints or other points of the body. visible: (B, T, N), all where None.
    """
    check_shape(joints, "B T N 3", "joints")
    seen = observed.isfinite().all(-1)
    seen = seen if visible is None else seen & visible.bool()
    return _half_squares(torch.where(seen[..., None], joints - observed, 0.0))


def joints3d_smooth(joints: Tensor) -> Tensor:
    """1/2 sum |J_t - J_{t-1}|^2 of joints (B, T, N, 3)."""
    check_shape(joints, "B T N 3", "joints")
    return _half_squares(joints.diff(dim=1))


def pose_prior(latent: Tensor) -> Tensor:
    """sum |latent|^2 of the pose prior's latents (B, T, 32)."""
    return _per_clip(latent.square())


def shape_prior(betas: Tensor, frames: int = 1) -> Tensor:
    """frames sum |betas|^2 of (B, n), one shape for all frames."""
    return frames * _per_clip(betas.square())


def motion_prior(z: Tensor, prior: Gaussian) -> Tensor:
    """-log N(z_t; prior of the state before) over all transitions (B, T, 48), nats."""
    return _per_clip(prior.nll(z))


def init_motion_prior(features: Tensor, initial: Density) -> Tensor:
    """-log p(first state), nats; features (B, 138) of it in its own heading frame."""
    check_shape(features, "B 138", "features")
    return -initial.log_prob(features)


def joint_consistency(body_joints: Tensor, rolled_joints: Tensor) -> Tensor:
    """1/2 sum |J - J'|^2: joints (B, T, 22, 3) that the pose implies, and those the roll-out carries beside it."""
    check_shape(body_joints, "B T N 3", "body_joints")
    return _half_squares(body_joints - rolled_joints)


def bone_length(joints: Tensor) -> Tensor:
    """1/2 sum (l_t - l_{t-1})^2 over the 21 bones between rolled-out joints (B, T, 22, 3), l their lengths."""
    check_shape(joints, "B T 22 3", "joints")
    bones = joints[..., 1:, :] - joints[..., BONE_PARENTS, :]
    return _half_squares(torch.linalg.vector_norm(bones, dim=-1).diff(dim=1))


def contact_probabilities(logits: Tensor) -> Tensor:
    """Probabilities (B, T, 9) from logits (B, T - 1, 9) of the transitions; the first frame copies the second."""
    check_shape(logits, "B T 9", "logits")
    return torch.cat((logits[:, :1], logits), dim=1).sigmoid()


def contact_vel(joints: Tensor, contacts: Tensor) -> Tensor:
    """1/2 sum p_t |J_t - J_{t-1}|^2: a joint in contact does not move.

    joints (B, T, N, 3) with contacts (B, T, N), or 22 joints with the nine of ``CONTACT_JOINTS``.
    """
    joints = _touching(joints, contacts)
    return 0.5 * _per_clip(contacts[:, 1:] * joints.diff(dim=1).square().sum(-1))


def contact_height(joints: Tensor, contacts: Tensor) -> Tensor:
    """sum p relu(|z| - 0.08 m): a joint in contact is near the floor; arguments as in :func:`contact_vel`."""
    joints = _touching(joints, contacts)
    return _per_clip(contacts * (joints[..., 2].abs() - TOUCHING).relu())


def _touching(joints: Tensor, contacts: Tensor) -> Tensor:
    check_shape(joints, "B T N 3", "joints")
    if joints.shape[2] == len(STANDARD) and contacts.shape[2:] == (len(CONTACT_JOINTS),):
        joints = joints[:, :, CONTACT_JOINTS]
    if contacts.shape != joints.shape[:3]:
        raise ShapeError(f"contacts: expected shape {tuple(joints.shape[:3])}, got {tuple(contacts.shape)}")
    return joints


def floor_reg(floor: Tensor, initial: Tensor, frames: int = 1) -> Tensor:
    """frames / 2 |floor - initial|^2; floor planes (B, 3) as normal times offset, camera coordinates, metres."""
    check_shape(floor, "B 3", "floor")
    return frames * _half_squares(floor - initial)
