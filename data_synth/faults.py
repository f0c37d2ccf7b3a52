"""Ground truth spoiled on purpose: what an audit must notice."""

from dataclasses import replace

import torch

from motionlab.motion import Motion


def drifting(motion: Motion, speed: float = 0.01) -> Motion:
    """The whole body slides along +x at ``speed`` m/s, contacts unchanged."""
    seconds = torch.arange(motion.frames).to(motion.root) / motion.fps
    return replace(motion, root=motion.root + seconds[:, None] * motion.root.new_tensor([speed, 0.0, 0.0]))


def lowered(motion: Motion, metres: float = 0.01) -> Motion:
    """The whole body sinks by ``metres``."""
    return replace(motion, root=motion.root - motion.root.new_tensor([0.0, 0.0, metres]))


def knees_reflected(motion: Motion) -> Motion:
    """Knees that bend forward what they bent backward."""
    rot = motion.rot.clone()
    knees = motion.skeleton.indices(("left_knee", "right_knee"))
    rot[..., knees, :, :] = rot[..., knees, :, :].mT
    return replace(motion, rot=rot)
