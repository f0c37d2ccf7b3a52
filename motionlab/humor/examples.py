"""Computes what the prior learns from: windows of states and contacts, from motions on the 22 joints.

A small collection of recordings holds few bodies and habits. :func:`varied_motion` puts the same motion on other
bodies, held another way.

Source: none for the variety; HuMoR trains on AMASS, whose hundreds of people bring it themselves.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.diffusion.windows import Windows, gather
from motionlab.errors import DataError, ShapeError
from motionlab.humor import body_shape
from motionlab.humor.state import from_motion
from motionlab.motion import Motion, mirror
from motionlab.skeleton import STANDARD

_PEOPLE = 0.7  # standard deviation, in betas, of the bodies that the motions are put on
#: Joints that may be held another way without moving what stands on the floor.
_LOOSE = ("spine", "neck", "head", "collar", "shoulder", "elbow", "wrist", "foot")
_HELD, _SWAYS = 0.10, 0.04  # standard deviations, radians: of a whole clip, and of each of three slow waves
FASTEST = 1.5  # Hz


@dataclass(frozen=True, eq=False)
class Examples:
    """All frames of many motions in one row.

    states (N, 339), world; contacts (N, 9); offsets (N, 22, 3): metres, the bones of each frame's body. begins: the
    frames from which a whole window of ``length`` frames lies inside one motion.
    """

    states: Tensor
    contacts: Tensor
    offsets: Tensor
    begins: Tensor
    length: int

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Draws windows evenly over all begins: states (B, L, 339), contacts (B, L, 9), offsets (B, 22, 3)."""
        begin = self.begins[torch.randint(len(self.begins), (count,), generator=generator)]
        at = begin[:, None] + torch.arange(self.length)
        return self.states[at], self.contacts[at], self.offsets[begin]

    @property
    def digest(self) -> str:
        """Computes a hash of all numbers, for the recipe."""
        whole = hashlib.sha256()
        for x in (self.states, self.contacts, self.offsets):
            whole.update(x.numpy().tobytes())
        return whole.hexdigest()[:16]


def examples(motions: Sequence[Motion], length: int, *, mirrored: bool = True) -> Examples:
    """Computes windows of ``length`` frames from motions with contacts, 30 fps, floor at z = 0; and from their mirrors.

    Raises:
        DataError: no motion is that long, or one has no contacts or numbers that are not finite.
        ShapeError: a motion is not on the 22 joints.
    """
    states, contacts, offsets, begins, at = [], [], [], [], 0
    for motion in motions:
        if motion.frames < length:
            continue
        if motion.contacts is None:
            raise DataError("a motion without contacts", place=motion.name, remedy="contact.with_contacts labels it")
        for each in (motion, mirror(motion)) if mirrored else (motion,):
            x = from_motion(each).float()
            if not x.isfinite().all():
                raise DataError("numbers that are not finite", place=motion.name, remedy="leave this motion out")
            states.append(x)
            contacts.append(each.contacts.float())
            offsets.append(each.skeleton.offsets.float().expand(len(x), -1, -1))
            begins.append(at + torch.arange(len(x) - length + 1))
            at += len(x)
    if not states:
        raise DataError(f"no motion has {length} frames", remedy="give longer motions")
    if states[0].shape[-1] != 339:
        raise ShapeError("motions must be on the 22 joints: retarget first")
    return Examples(torch.cat(states), torch.cat(contacts), torch.cat(offsets), torch.cat(begins), length)


@dataclass(frozen=True, eq=False)
class LiveExamples:
    """Windows of states that are computed when they are drawn: half of them mirrored, each on another body.

    For hours of motion, whose states would not fit into memory. Velocities are backward differences.

    motions: windows of ``length`` + 1 frames. bodies: standard deviation of the bodies' betas; one recording in three
    keeps its own.
    """

    motions: Windows
    length: int
    bodies: float = _PEOPLE

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Draws windows evenly over all frames: states (B, L, 339), contacts (B, L, 9), offsets (B, 22, 3)."""
        return self.drawn(count, generator)[:3]

    def drawn(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draws as :meth:`draw`, and says which joints' rotations were recorded (B, 22), bool."""
        motion, clip = self.motions.drawn(count, generator)
        betas = self.bodies * torch.randn(count, body_shape.BETAS, generator=generator)
        betas = betas * (torch.rand(count, 1, generator=generator) < 2 / 3)
        offsets = motion.skeleton.offsets * body_shape.scales(betas)[:, None, :, None]
        legs = STANDARD.indices(["left_knee", "left_ankle"])
        grown = offsets[..., legs, :].norm(dim=-1).sum(-1) / motion.skeleton.offsets[..., legs, :].norm(dim=-1).sum(-1)
        body = replace(motion.skeleton, offsets=offsets)
        states = from_motion(replace(motion, skeleton=body, root=motion.root * grown[..., None]), causal=True)
        seen = self.motions.seen
        recorded = torch.ones(count, len(STANDARD), dtype=torch.bool) if seen is None else seen[clip]
        return states[:, 1:], motion.contacts[:, 1:], offsets[:, 0], recorded

    @property
    def digest(self) -> str:
        """Computes a hash of all numbers, for the recipe."""
        return self.motions.digest

    @property
    def frames(self) -> int:
        """Counts the frames, without mirror images."""
        return len(self.motions.root)


def live_examples(motions: Sequence[Motion], length: int, missing: Sequence[Sequence[str]]) -> LiveExamples:
    """Computes live examples from motions with contacts, 30 fps, floor at z = 0: windows of ``length`` states.

    missing: for every motion the joints whose rotations were not recorded; of a pair, that one is missing leaves none
    to learn from, since windows are mirrored.

    Raises:
        DataError: as :func:`motionlab.diffusion.windows.gather`.
    """
    return LiveExamples(gather(motions, length + 1, missing=missing), length)


def other_body(motion: Motion, generator: torch.Generator) -> Motion:
    """Puts the same angles on a body drawn at random; the path grows with the legs, so that feet hardly slide."""
    betas = _PEOPLE * torch.randn(body_shape.BETAS, generator=generator)
    scale = body_shape.scales(betas)[:, None]
    offsets = motion.skeleton.offsets * scale
    legs = motion.skeleton.indices(["left_knee", "left_ankle"])
    grown = offsets[legs].norm(dim=-1).sum() / motion.skeleton.offsets[legs].norm(dim=-1).sum()
    return replace(motion, skeleton=replace(motion.skeleton, offsets=offsets), root=motion.root * grown)


def held_otherwise(motion: Motion, generator: torch.Generator) -> Motion:
    """Turns every joint of ``_LOOSE`` by a small smooth rotation of its own: a constant and three slow waves.

    Positions of pelvis, legs and feet stay, and with them their contacts; the turns fade out around a hand's.
    """
    names = motion.skeleton.names
    joints = [j for j, name in enumerate(names) if name.removeprefix("left_").removeprefix("right_").startswith(_LOOSE)]
    size = (len(joints), 3)
    much = 2 * torch.rand(1, generator=generator)  # some clips hardly, some a lot
    time = torch.arange(motion.frames)[:, None, None] / motion.fps
    turn = _HELD * torch.randn(size, generator=generator).expand(motion.frames, *size)
    for _ in range(3):
        rate, phase = FASTEST * torch.rand(size, generator=generator), math.tau * torch.rand(size, generator=generator)
        turn = turn + _SWAYS * torch.randn(size, generator=generator) * torch.sin(math.tau * rate * time + phase)
    rot = motion.rot.clone()
    rot[:, joints] = rot[:, joints] @ rotation.exp((much * _free(motion)[:, None, None] * turn).to(rot))
    return replace(motion, rot=rot)


def _free(motion: Motion) -> Tensor:
    """(T,): 0 where a hand rests on the floor, 1 from half a second away, smooth between."""
    if motion.contacts is None:
        return torch.ones(motion.frames)
    hands = [i for i, name in enumerate(motion.skeleton.contact_names) if name.endswith("wrist")]
    quarter = round(motion.fps / 4)
    rests = motion.contacts[:, hands].amax(-1).float()[None]
    near = F.max_pool1d(F.pad(rests, (quarter, quarter)), 2 * quarter + 1, 1)
    ends = F.pad(near, (quarter, quarter), mode="replicate")
    return 1 - F.avg_pool1d(ends, 2 * quarter + 1, 1)[0]


def varied_motion(motion: Motion, generator: torch.Generator) -> Motion:
    """Puts a motion on another body, held another way."""
    return held_otherwise(other_body(motion, generator), generator)
