"""Where the official code starts a video: every frame at one place, facing the camera, seen or not.

Source: the official fitting code of HuMoR (Rempe et al. 2021), as described in its issues and read from its behaviour.
"""

from __future__ import annotations

import torch
from torch import Tensor

from motionlab.humor.observed import Evidence
from motionlab.observation import BODY_25

#: The 24 bones of BODY_25.
_SIDED = (
    ("neck", "left_shoulder"), ("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"), ("mid_hip", "left_hip"),
    ("left_hip", "left_knee"), ("left_knee", "left_ankle"), ("left_ankle", "left_heel"), ("left_ankle", "left_big_toe"),
    ("left_big_toe", "left_small_toe"), ("nose", "left_eye"), ("left_eye", "left_ear"),
)  # fmt: skip
_PAIRS = (
    ("neck", "mid_hip"),
    ("neck", "nose"),
    *_SIDED,
    *((a.replace("left", "right"), b.replace("left", "right")) for a, b in _SIDED),
)
_BONES = [tuple(map(BODY_25.index, pair)) for pair in _PAIRS]
#: An upright body that looks into the camera, whose axes are right, down and forward: the rotation vector (pi, 0, 0).
FACING = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


def start_facing(evidence: Evidence, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Root (B, T, 3) and orientation (B, T, 3, 3), world: the same in every frame of a clip.

    On the camera's axis at depth f * (mean bone in metres) / (mean bone in pixels), in the frame with the most
    detections; bones that were not detected count as 0 pixels, which puts a person half seen too far away.

    rest (25, 3): landmarks of the mean pose, metres.
    """
    view, frames = evidence.view, evidence.values.shape[1]
    most = (evidence.weight > 0).sum(-1).argmax(-1)
    rows = torch.arange(len(most))
    pixels, seen = evidence.values[rows, most], evidence.weight[rows, most] > 0
    a, b = torch.tensor(_BONES).mT
    length = torch.where(seen[:, a] & seen[:, b], (pixels[:, a] - pixels[:, b]).norm(dim=-1), 0.0).mean(-1)
    depth = view.intrinsics[:, 0, 0] * (rest[a] - rest[b]).norm(dim=-1).mean() / length.clamp(min=1.0)
    place = view.centre + depth[:, None] * view.rotation[:, 2]  # the camera looks along its third row
    turn = view.rotation.mT @ FACING.to(rest)
    return place[:, None].repeat(1, frames, 1), turn[:, None].repeat(1, frames, 1, 1)
