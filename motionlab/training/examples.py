"""Computes what the prior learns from: windows of states and contacts, drawn from hours of motion on other bodies.

A collection of recordings holds few bodies. Source: none for the variety; HuMoR trains on AMASS, whose hundreds of
people bring it themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab.diffusion.windows import Windows
from motionlab.humor import body_shape
from motionlab.humor.state import from_motion
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

_PEOPLE = 0.7  # standard deviation, in betas, of the bodies that the motions are put on


@dataclass(frozen=True, eq=False)
class LiveExamples:
    """Windows of states that are computed when they are drawn: half of them mirrored, each on another body.

    For hours of motion, whose states would not fit into memory. Velocities are backward differences.

    motions: windows of ``length`` + 1 frames with contacts, 30 fps, floor at z = 0. bodies: standard deviation of the
    bodies' betas; one recording in three keeps its own.
    """

    motions: Windows
    length: int
    bodies: float = _PEOPLE

    def drawn(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draws windows evenly over all frames: states (B, L, 339), contacts (B, L, 9), offsets (B, 22, 3), and which
        joints' rotations were recorded (B, 22), bool."""
        motion, clip = self.motions.drawn(count, generator)
        betas = self.bodies * torch.randn(count, body_shape.BETAS, generator=generator)
        betas = betas * (torch.rand(count, 1, generator=generator) < 2 / 3)
        motion = _grown(motion, body_shape.scales(betas)[:, None, :, None])
        states = from_motion(motion, causal=True)
        seen = self.motions.seen
        recorded = torch.ones(count, len(STANDARD), dtype=torch.bool) if seen is None else seen[clip]
        return states[:, 1:], motion.contacts[:, 1:], motion.skeleton.offsets[:, 0], recorded

    @property
    def digest(self) -> str:
        """Computes a hash of all numbers, for the recipe."""
        return self.motions.digest


def random_body(motion: Motion, generator: torch.Generator) -> Motion:
    """Puts the same angles on a body drawn at random; the path grows with the legs, so that feet hardly slide."""
    betas = _PEOPLE * torch.randn(body_shape.BETAS, generator=generator)
    return _grown(motion, body_shape.scales(betas)[:, None])


def _grown(motion: Motion, scale: Tensor) -> Motion:
    """A motion whose bones are so many times as long, (..., 22, 1)."""
    offsets, legs = motion.skeleton.offsets * scale, STANDARD.indices(["left_knee", "left_ankle"])
    longer, before = (x[..., legs, :].norm(dim=-1).sum(-1) for x in (offsets, motion.skeleton.offsets))
    root = motion.root * (longer / before)[..., None]
    return replace(motion, skeleton=replace(motion.skeleton, offsets=offsets), root=root)
