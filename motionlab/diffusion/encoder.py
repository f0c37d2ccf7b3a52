"""Encodes windows of motion as features for FID: the latent numbers of an autoencoder over two seconds.

It sees the root's path and the feet's sliding, and is trained on training motion alone, as features must not depend on
held-out motion.

Source: FID's features are those of a trained network (Heusel et al. 2017; for motion Guo et al. 2020, MDM).
Differs: an autoencoder, as there are no labels; root and feet count as much as all other joints together.
"""

from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import torch
from torch import Tensor, nn

from motionlab import checkpoint
from motionlab.contact import resting_heights
from motionlab.errors import ShapeError
from motionlab.heading import stuck_root
from motionlab.motion import Motion, velocity
from motionlab.skeleton import FEET, STANDARD

#: Joints whose velocities count; what of the feet is low counts once more, as sliding.
_MOVING = ("pelvis", "head", "left_wrist", "right_wrist", *FEET)
#: Numbers of a frame: the root's place, the joints about it, velocities, and how fast each foot joint slides.
FEATURE_GROUPS = {"place": 3, "joints": 3 * (len(STANDARD) - 1), "moving": 3 * len(_MOVING), "sliding": len(FEET)}
_LOW, _EDGE = 0.03, 0.01  # metres above its resting height: a foot joint is low there, and how soft the edge is
_SLOW = 0.05  # m/s: of a sliding foot's speed the logarithm counts, from about here on, or a swinging one hides it


def signals(motion: Motion) -> Tensor:
    """Computes rows (N, T, 94) of windows (N, T) on the standard joints, in the heading frame of their first frames.

    Metres and metres per second; sliding: log(1 + speed over the floor / SLOW), faded out where the joint is not low.

    Raises:
        ShapeError: not windows of two or more frames on the 22 joints.
    """
    if motion.root.ndim != 3 or motion.frames < 2 or motion.skeleton.names != STANDARD.names:
        raise ShapeError(f"expected windows (N, T > 1) on the 22 joints, got root {tuple(motion.root.shape)}")
    points = stuck_root(motion)[0].positions
    speed = velocity(points, motion.fps, dim=-3)
    feet = motion.skeleton.indices(FEET)
    rest = resting_heights(STANDARD)[[STANDARD.contact_names.index(name) for name in FEET]].to(points)
    low = torch.sigmoid((_LOW + rest - points[..., feet, 2]) / _EDGE)
    parts = (
        points[..., 0, :],
        (points[..., 1:, :] - points[..., :1, :]).flatten(-2),
        speed[..., motion.skeleton.indices(_MOVING), :].flatten(-2),
        low * (speed[..., feet, :2].norm(dim=-1) / _SLOW).log1p(),
    )
    return torch.cat(parts, -1)


@dataclass(frozen=True)
class EncoderRecipe:
    """frames: of a window, a multiple of 4. size: latent numbers. width: of convolutions. steps, batch, lr: of Adam,
    whose rate falls by a cosine. seed: of weights and windows."""

    frames: int = 60
    size: int = 64
    width: int = 96
    steps: int = 4000
    batch: int = 64
    lr: float = 2e-3
    seed: int = 0
    average: ClassVar[float] = 0.0  # its weights are the last ones


class MotionEncoder(nn.Module):
    """Two convolutions over time, each halving it, and a linear layer; the same backwards. ``encoder(motion)`` is (N,
    size), about unit size on training motion.

    mean (94,), scale (94,): of the signals, one scale per group. centre (size,), spread (size,): of the latent numbers.
    """

    def __init__(self, recipe: EncoderRecipe) -> None:
        super().__init__()
        self.recipe, numbers, width, short = recipe, sum(FEATURE_GROUPS.values()), recipe.width, recipe.frames // 4
        encoder = nn.Sequential(
            nn.Conv1d(numbers, width, 5, 2, 2), nn.GELU(), nn.Conv1d(width, width, 5, 2, 2), nn.GELU(),
            nn.Flatten(), nn.Linear(width * short, recipe.size),
        )  # fmt: skip
        decoder = nn.Sequential(
            nn.Linear(recipe.size, width * short), nn.Unflatten(1, (width, short)), nn.GELU(),
            nn.ConvTranspose1d(width, width, 4, 2, 1), nn.GELU(), nn.ConvTranspose1d(width, numbers, 4, 2, 1),
        )  # fmt: skip
        self.network = nn.ModuleDict({"encoder": encoder, "decoder": decoder})
        for name, size in (("mean", numbers), ("centre", recipe.size)):
            self.register_buffer(name, torch.zeros(size))
        for name, size in (("scale", numbers), ("spread", recipe.size)):
            self.register_buffer(name, torch.ones(size))

    @torch.no_grad()
    def forward(self, motion: Motion, batch: int = 512) -> Tensor:
        """Computes latent numbers (N, size), float64, of windows (N, recipe.frames) at 30 fps, a batch at a time."""
        if motion.frames != self.recipe.frames:
            raise ShapeError(f"expected windows of {self.recipe.frames} frames, got {motion.frames}")
        parts = (motion.clip(slice(at, at + batch)) for at in range(0, len(motion.root), batch))
        latent = torch.cat([self.network["encoder"](((signals(x) - self.mean) / self.scale).mT) for x in parts])
        return ((latent - self.centre) / self.spread).double()


@cache
def motion_encoder(name: str = "features_real") -> MotionEncoder:
    """Loads an encoder that ships with the project, by name, or one at a path; once.

    Raises:
        DataError: no such checkpoint, or damaged.
    """
    path = checkpoint.shipped(name).with_suffix(".safetensors")
    tensors, about = checkpoint.load(path)
    with checkpoint.rebuilding(path, "not a feature autoencoder"):
        return checkpoint.frozen(lambda: MotionEncoder(EncoderRecipe(**about["recipe"])), tensors)
