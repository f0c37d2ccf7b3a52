"""Noise on motions: put on them, smoothed away, and its size in a model's numbers.

Source: thesis 4.2.1, "Denoising: come up with a better test".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from motionlab import baselines, rotation
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.motion import Motion

_LIVELY, _QUICK = 2.5, 1.0  # strength of acceleration that is motion: rad/s^(3/2) of joints, m/s^(3/2) of the root


@dataclass(frozen=True)
class Noise:
    """turn: radians about each axis of every joint. shift: metres along each axis of the root. Standard deviations.

    lasting: correlation of one frame's noise with the next one's; 0: every frame's is new.
    """

    turn: float
    shift: float
    lasting: float = 0.0

    @classmethod
    def of(cls, degrees: float, centimetres: float, lasting: float = 0.0) -> Self:
        """Returns the noise of so many degrees and centimetres."""
        return cls(degrees * torch.pi / 180, centimetres / 100, lasting)

    def on(self, motion: Motion, generator: torch.Generator) -> Motion:
        """Adds this noise to a motion; contacts are dropped."""
        dim = motion.root.ndim - 2
        turn = self.turn * _steady((*motion.rot.shape[:-2], 3), generator, dim=dim, lasting=self.lasting)
        shift = self.shift * _steady(motion.root.shape, generator, dim=dim, lasting=self.lasting)
        return replace(motion, root=motion.root + shift, rot=motion.rot @ rotation.exp(turn), contacts=None)


def smoothed(motion: Motion, noise: Noise) -> Motion:
    """Computes a motion without most of its noise: a Kalman smoother over joints and root, each with its own."""

    def by(size: float, lively: float):
        return lambda x: baselines.kalman(x, motion.fps, max(size, 1e-6), lively)

    turned = baselines.smooth(motion, by(noise.turn, _LIVELY))
    return replace(turned, root=by(noise.shift, _QUICK)(motion.root))


def noise_size(layout: Layout, normaliser: Normaliser, turn: float, shift: float) -> Tensor:
    """Computes the deviation (D,) of each normalised number from noise of ``turn`` radians about each axis of a joint
    and ``shift`` metres: a turned column of length 1 moves by sqrt(2 / 3) turn in each coordinate."""
    size = torch.zeros(layout.size)
    for name, part in layout.slices.items():
        size[part] = {"root": shift, "orient": (2 / 3) ** 0.5 * turn, "pose": (2 / 3) ** 0.5 * turn}.get(name, 0.0)
    return size / normaliser.scale


def _steady(shape: Sequence[int], generator: torch.Generator, *, dim: int, lasting: float) -> Tensor:
    """Standard normal numbers of which those next to each other along ``dim`` have correlation ``lasting``."""
    fresh = torch.randn(shape, generator=generator).movedim(dim, 0)
    out = [fresh[0]]
    for now in fresh[1:]:
        out.append(lasting * out[-1] + (1 - lasting**2) ** 0.5 * now)
    return torch.stack(out).movedim(0, dim)
