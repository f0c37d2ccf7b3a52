"""Makes whole poses from handles, joints whose places are given: a plain network, then inverse kinematics.

    made = load().complete(targets, which)    # targets (B, 22, 3) metres; which (B, 22): True where a joint is a handle

Poses and targets are in the pose's own stuck frame: above the origin, facing +y. So where a character stands and which
way it faces is given, as a rig's root is to an animator; how high its pelvis is and how it leans is not.

The numbers of a pose, x, of about unit size, are shown as cos(a) x + sin(a) e with noise e, from the angle a = pi / 2,
where that says nothing, down to 0. At pi / 2 the network has one answer, the closest on average. Steps of equal angle
draw a pose (notebook 14).

Source: thesis 4.2.4 (single poses by diffusion; handles through a linear layer, concatenated to the input), Eq. 4.3.
Salimans and Ho 2022 (angles); Song et al. 2021 (DDIM); He et al. 2016 (residual blocks).
Differs: of a handle the network is told the place, where the thesis keeps what its state holds of it, a rotation.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from motionlab import checkpoint, rotation
from motionlab.errors import DataError, check_shape
from motionlab.ik import reach_targets
from motionlab.motion import FPS, Motion
from motionlab.skeleton import STANDARD

_J = len(STANDARD)
NUMBERS = 1 + 6 * _J  # of a pose: the pelvis's height, 6-D rotations
_EMBEDDED, _WAVES = 128, 8  # numbers that handles are embedded in; frequencies that an angle is told in


@dataclass(frozen=True)
class PoseRecipe:
    """size, layers: of the network. conditioned: on handles. diffusion: draws; else one answer. handle_weight: of
    their distance in the loss. steps, batch, lr, seed: of its training."""

    size: int = 256
    layers: int = 4
    conditioned: bool = True
    diffusion: bool = True
    handle_weight: float = 2.0
    steps: int = 5000
    batch: int = 256
    lr: float = 2e-3
    seed: int = 0


class Poser(nn.Module):
    """Handles and a noisy pose -> the pose, in unit sizes."""

    def __init__(self, recipe: PoseRecipe) -> None:
        super().__init__()
        self.recipe, size = recipe, recipe.size
        self.handles = nn.Linear(4 * _J, _EMBEDDED)
        self.taken = nn.Linear(_EMBEDDED + NUMBERS + 2 * _WAVES, size)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(size), nn.Linear(size, 2 * size), nn.GELU(), nn.Linear(2 * size, size))
            for _ in range(recipe.layers)
        )
        self.said = nn.Sequential(nn.LayerNorm(size), nn.Linear(size, NUMBERS))
        self.register_buffer("mean", torch.zeros(NUMBERS))
        self.register_buffer("scale", torch.ones(NUMBERS))

    def forward(self, targets: Tensor, which: Tensor, noisy: Tensor, angle: Tensor) -> Tensor:
        """Computes an estimate of x (B, ``NUMBERS``) from handles, what noise left of x, and the angle (B,).

        Pure noise is not read.
        """
        which = which[..., None] & self.recipe.conditioned
        held = torch.cat((torch.where(which, targets, 0.0), which.to(targets)), -1).flatten(1)
        noisy = torch.where(angle[:, None] < math.pi / 2, noisy, 0.0)
        waves = angle[:, None] * 2.0 ** torch.arange(_WAVES).to(angle)
        x = self.taken(torch.cat((self.handles(held), noisy, waves.sin(), waves.cos()), -1))
        for block in self.blocks:
            x = x + block(x)
        return self.said(x)

    def encode(self, pose: Motion) -> Tensor:
        """Computes the numbers (B, ``NUMBERS``) of poses (B, 1) in their stuck frame."""
        x = torch.cat((pose.root[:, 0, 2:], rotation.matrix_to_sixd(pose.rot[:, 0]).flatten(1)), -1)
        return (x - self.mean) / self.scale

    def decode(self, x: Tensor) -> Motion:
        """Computes the poses (B, 1) of numbers, on the standard body."""
        x = (x * self.scale + self.mean)[:, None]
        rot = rotation.sixd_to_matrix(x[..., 1:].unflatten(-1, (_J, 6)))
        return Motion(STANDARD, nn.functional.pad(x[..., :1], (2, 0)), rot, FPS)

    @torch.no_grad()
    def complete(self, targets: Tensor, which: Tensor) -> Motion:
        """Computes the one answer (B, 1), with its handles near the targets (``finished`` brings them there); targets
        of free joints are not read.

        Raises:
            DataError: a target that is not finite. ShapeError: targets of another shape.
        """
        count = check_shape(targets, f"B {_J} 3", "targets")["B"]
        if not targets[which].isfinite().all():
            raise DataError("a target is not finite", place="targets", remedy="let that joint be free")
        return self.decode(self(targets, which, torch.zeros(count, NUMBERS), torch.full((count,), math.pi / 2)))


def finished(pose: Motion, targets: Tensor, which: Tensor, steps: int = 20) -> Motion:
    """Computes poses (B, 1) with their handles brought to the targets (B, 22, 3) by inverse kinematics."""
    return reach_targets(pose, STANDARD.names, torch.where(which[..., None], targets, torch.nan)[:, None], steps=steps)


def load(name: str = "poser") -> Poser:
    """Reads the model that ships, frozen.

    Raises:
        DataError: a file is missing or damaged.
    """
    path = checkpoint.SHIPPED / name
    tensors, about = checkpoint.load(path)
    with checkpoint.rebuilding(path, "makes no poses"):
        return checkpoint.frozen(lambda: Poser(PoseRecipe(**about["recipe"])), tensors)
