"""Somebody who stands in a T, which many tests begin with."""

import torch

from motionlab.motion import Motion
from motionlab.skeleton import STANDARD, UPRIGHT, Skeleton


def standing(frames: int = 3, fps: float = 30.0, skeleton: Skeleton = STANDARD, *, at=(0.0, 0.0)) -> Motion:
    """A T-pose (frames,) that faces +y, its soles on the floor, its pelvis above ``at``."""
    rot = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    rot[:, 0] = UPRIGHT
    return Motion(skeleton, torch.tensor([*at, float(skeleton.standing_height())]).repeat(frames, 1), rot, fps)
