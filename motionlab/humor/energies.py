"""The energies of HuMoR's test-time optimisation, pure functions, each a sum per clip (B,); and how much each counts.

Metres, radians, pixels; frames at 30 per second; world z up with the floor at z = 0. What was not observed is masked
before any arithmetic, so that inf and NaN there reach neither value nor gradient.

Source: HuMoR (Rempe et al. 2021), section 4, and its official code, whose values these are; thesis 3.1.2.
"""

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from motionlab.errors import check_shape
from motionlab.humor.priors import Gaussian
from motionlab.skeleton import STANDARD

#: Joints of BODY_25 whose confidence counts as zero: neck and hips, which OpenPose and SMPL place differently.
UNUSED_BODY_25 = (1, 9, 12)
#: The nine joints that may touch the floor, in the order of HuMoR's contact logits.
CONTACT_JOINTS = tuple(STANDARD.contact_indices)
#: The other end of each bone 1..21. The collars hang on the neck here, as in the official energy, and not on the spine;
#: all three move with the spine, so that these lengths too are constant in a body.
BONE_PARENTS = tuple({13: 12, 14: 12}.get(j, STANDARD.parents[j]) for j in range(1, len(STANDARD)))
SIGMA = 100.0  # pixels
TOUCHING = 0.08  # metres: a joint in contact may be this far from the floor


def _per_clip(x: Tensor) -> Tensor:
    return x.flatten(1).sum(1)


def _half_squares(x: Tensor) -> Tensor:
    return 0.5 * _per_clip(x.square())


def gmof(residual: Tensor, sigma: float = SIGMA) -> Tensor:
    """Computes Geman-McClure of residuals: sigma^2 r^2 / (sigma^2 + r^2), quadratic near 0 and never above sigma^2."""
    squared = residual.square()
    return sigma**2 * squared / (sigma**2 + squared)


def joints2d(pixels: Tensor, keypoints: Tensor, confidence: Tensor, sigma: float = SIGMA) -> Tensor:
    """Computes sum conf^2 gmof(pixel - keypoint), coordinate by coordinate, of pixels and keypoints (B, T, K, 2).

    confidence: (B, T, K); where it is 0, or where the keypoint is not finite, nothing was detected.
    """
    check_shape(pixels, "B T K 2", "pixels")
    seen = (confidence > 0) & keypoints.isfinite().all(-1)
    residual = torch.where(seen[..., None], pixels - keypoints, 0.0)
    weight = torch.where(seen, confidence, 0.0).square()
    return _per_clip(weight[..., None] * gmof(residual, sigma))


def body_25_confidence(confidence: Tensor) -> Tensor:
    """Computes confidences (..., 25) of BODY_25 with neck and hips at zero."""
    check_shape(confidence, "... 25", "confidence")
    return confidence.index_fill(-1, torch.tensor(UNUSED_BODY_25, device=confidence.device), 0.0)


def joints3d(joints: Tensor, observed: Tensor, visible: Tensor | None = None) -> Tensor:
    """Computes 1/2 sum |joint - observed|^2 over what is visible and finite.

    joints, observed: (B, T, N, 3), joints or other points of the body. visible: (B, T, N), all where None.
    """
    check_shape(joints, "B T N 3", "joints")
    seen = observed.isfinite().all(-1)
    seen = seen if visible is None else seen & visible.bool()
    return _half_squares(torch.where(seen[..., None], joints - observed, 0.0))


def joints3d_smooth(joints: Tensor) -> Tensor:
    """Computes 1/2 sum |J_t - J_{t-1}|^2 of joints (B, T, N, 3)."""
    check_shape(joints, "B T N 3", "joints")
    return _half_squares(joints.diff(dim=1))


def pose_prior(latent: Tensor) -> Tensor:
    """Computes sum |latent|^2 of the pose prior's latents (B, T, 32)."""
    return _per_clip(latent.square())


def shape_prior(betas: Tensor, frames: int = 1) -> Tensor:
    """Computes frames sum |betas|^2 of (B, n), one shape for all frames."""
    return frames * _per_clip(betas.square())


def motion_prior(z: Tensor, prior: Gaussian) -> Tensor:
    """Computes -log N(z_t; prior of the state before) over all transitions (B, T, 48), nats."""
    return _per_clip(prior.nll(z))


def init_motion_prior(features: Tensor, initial) -> Tensor:
    """Computes -log p(first state), nats, by an ``InitGmm``; features (B, 138) of it in its own heading frame."""
    check_shape(features, "B 138", "features")
    return -initial.log_prob(features)


def joint_consistency(body_joints: Tensor, rolled_joints: Tensor) -> Tensor:
    """Computes 1/2 sum |J - J'|^2 of joints (B, T, 22, 3) that the pose implies and those that the roll-out carries."""
    check_shape(body_joints, "B T N 3", "body_joints")
    return _half_squares(body_joints - rolled_joints)


def bone_length(joints: Tensor) -> Tensor:
    """Computes 1/2 sum (l_t - l_{t-1})^2 over the lengths l of the 21 bones between rolled-out joints (B, T, 22, 3)."""
    check_shape(joints, "B T 22 3", "joints")
    bones = joints[..., 1:, :] - joints[..., BONE_PARENTS, :]
    return _half_squares(torch.linalg.vector_norm(bones, dim=-1).diff(dim=1))


def contact_probabilities(logits: Tensor) -> Tensor:
    """Computes probabilities (B, T, 9) from logits (B, T - 1, 9) of the transitions; the first copies the second."""
    check_shape(logits, "B T 9", "logits")
    return torch.cat((logits[:, :1], logits), dim=1).sigmoid()


def contact_vel(joints: Tensor, contacts: Tensor) -> Tensor:
    """Computes 1/2 sum p_t |J_t - J_{t-1}|^2: a joint in contact does not move.

    joints (B, T, N, 3) with contacts (B, T, N), or 22 joints with the nine of ``CONTACT_JOINTS``.
    """
    joints = _touching(joints, contacts)
    return 0.5 * _per_clip(contacts[:, 1:] * joints.diff(dim=1).square().sum(-1))


def contact_height(joints: Tensor, contacts: Tensor) -> Tensor:
    """Computes sum p relu(|z| - 0.08 m): a joint in contact is near the floor; arguments of :func:`contact_vel`."""
    joints = _touching(joints, contacts)
    return _per_clip(contacts * (joints[..., 2].abs() - TOUCHING).relu())


def _touching(joints: Tensor, contacts: Tensor) -> Tensor:
    check_shape(joints, "B T N 3", "joints")
    if joints.shape[2] == len(STANDARD) and contacts.shape[2:] == (len(CONTACT_JOINTS),):
        joints = joints[:, :, CONTACT_JOINTS]
    check_shape(contacts, joints.shape[:3], "contacts")
    return joints


def floor_reg(floor: Tensor, initial: Tensor, frames: int = 1) -> Tensor:
    """Computes frames / 2 |floor - initial|^2 of floor planes (B, 3) as normal times offset, camera axes, metres."""
    check_shape(floor, "B 3", "floor")
    return frames * _half_squares(floor - initial)


Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Weights:
    """One triple per term, named as its function: its weight in stages 1, 2 and 3.

    A new term is a function, a field here and a line in ``stages.pose_terms`` or ``stages.rolled_terms``.

    Source: the configurations of the official code: ``RGB`` its demo, ``JOINTS`` and ``KEYPOINTS`` its AMASS tasks
    (surface keypoints go into ``joints3d``). Its PROX-D set is left out: it needs the depth term, which is not here.
    """

    joints2d: Triple = (0.0, 0.0, 0.0)
    joints3d: Triple = (0.0, 0.0, 0.0)
    pose_prior: Triple = (0.0, 0.0, 0.0)
    shape_prior: Triple = (0.0, 0.0, 0.0)
    joints3d_smooth: Triple = (0.0, 0.0, 0.0)
    motion_prior: Triple = (0.0, 0.0, 0.0)
    init_motion_prior: Triple = (0.0, 0.0, 0.0)
    joint_consistency: Triple = (0.0, 0.0, 0.0)
    bone_length: Triple = (0.0, 0.0, 0.0)
    contact_vel: Triple = (0.0, 0.0, 0.0)
    contact_height: Triple = (0.0, 0.0, 0.0)
    floor_reg: Triple = (0.0, 0.0, 0.0)

    @property
    def pull(self) -> float:
        """Computes the motion prior's weight in stage 3 beside a square metre between joints."""
        return self.motion_prior[2] / max(self.joint_consistency[2], 1e-9)

    def of(self, stage: int, *, frames: int | None = None, listed: bool = False) -> dict[str, float]:
        """Returns the weights above zero of one stage, by term.

        frames: of the clip, from the second sub-stage of stage 3 on: the initial state's weight grows by frames / 15
        (the first one's), to keep its share beside terms that are summed over frames. None: as listed.
        listed: in stage 1 also smoothness and priors, which the official code lists and leaves out.
        """
        found = {name: triple[stage - 1] for name, triple in vars(self).items()}
        if frames is not None:
            found["init_motion_prior"] *= frames / 15
        counts = vars(self) if listed or stage > 1 else ("joints2d", "joints3d")
        return {name: weight for name, weight in found.items() if weight and name in counts}


def _last(weight: float) -> Triple:
    return (0.0, 0.0, weight)


RGB = Weights(
    joints2d=(0.001, 0.001, 0.001), pose_prior=(0.04, 0.04, 0.0), shape_prior=(0.05, 0.05, 0.05),
    joints3d_smooth=(100.0, 100.0, 0.0), motion_prior=_last(0.075), init_motion_prior=_last(0.075),
    joint_consistency=_last(100.0), bone_length=_last(2000.0), contact_vel=_last(100.0), contact_height=_last(10.0),
    floor_reg=_last(0.167),
)  # fmt: skip
#: As RGB, with a quarter of its smoothness, which draws walking people towards the camera, where they move less.
#: Chosen on synthetic walks that no table uses: stage 3's error there fell from 5 to 3 cm.
RGB_LIGHT = Weights(**asdict(RGB) | {"joints3d_smooth": (25.0, 25.0, 0.0)})
JOINTS = Weights(
    joints3d=(1.0, 1.0, 1.0), pose_prior=(2e-4, 2e-4, 0.0), shape_prior=(1.67e-4, 1.67e-4, 1.67e-4),
    joints3d_smooth=(10.0, 10.0, 0.0), motion_prior=_last(1e-3), init_motion_prior=_last(1e-3),
    joint_consistency=_last(1.0), bone_length=_last(10.0), contact_vel=_last(1.0), contact_height=_last(1.0),
)  # fmt: skip
KEYPOINTS = Weights(
    **asdict(JOINTS)
    | {"joints3d_smooth": (0.1, 0.1, 0.0), "motion_prior": _last(5e-4), "init_motion_prior": _last(5e-4)}
)
