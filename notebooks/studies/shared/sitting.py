"""Who sits, and who only crouches: legs bent, and the trunk behind the feet, where it would fall without a seat."""

import torch
from torch import Tensor

from motionlab import metrics
from motionlab.motion import Motion
from motionlab.skeleton import FEET

_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
SEAT = 0.12  # metres: a trunk so far behind the feet falls, unless something carries it


def unsupported(motion: Motion) -> Tensor:
    """Computes how far the trunk is behind the feet, metres (B, T), along the pelvis's heading: above 0 behind them."""
    heading = torch.nn.functional.normalize(motion.rot[..., 0, :2, 2], dim=-1)
    feet, trunk = (motion.positions[..., motion.skeleton.indices(names), :2].mean(-2) for names in (FEET, _TRUNK))
    return ((feet - trunk) * heading).sum(-1)


def sits(motion: Motion, when: Tensor) -> Tensor:
    """Computes whose thighs and knees are bent by ``metrics.SEATED`` in the mean of frames (B, T): 1 or 0 (B,)."""
    tilt, bend = (metrics.masked_mean(x.mean(-1), when, 1) for x in metrics.tilt_and_bend(motion))
    return ((tilt >= metrics.SEATED) & (bend >= metrics.SEATED)).to(tilt)


def seated(motion: Motion, when: Tensor) -> Tensor:
    """Computes who sits, 1 or 0 (B,), in frames (B, T): thighs and knees bent by ``metrics.SEATED`` and the trunk
    ``SEAT`` behind the feet, means over the frames. Who crouches bends the legs as much, over the feet."""
    return sits(motion, when) * (metrics.masked_mean(unsupported(motion), when, 1) >= SEAT)
