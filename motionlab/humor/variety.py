"""The same motion on other bodies, held another way: what a small collection of recordings has too little of.

Source: none; HuMoR trains on AMASS, whose hundreds of people bring this variety themselves.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from motionlab import rotation
from motionlab.humor import shape
from motionlab.motion import Motion

PEOPLE = 0.7  # standard deviation, in betas, of the bodies that the motions are put on
#: Joints that may be held another way without moving what stands on the floor.
LOOSE = ("spine", "neck", "head", "collar", "shoulder", "elbow", "wrist", "foot")
HELD, SWAYS = 0.10, 0.04  # standard deviations, radians: of a whole clip, and of each of three slow waves
FASTEST = 1.5  # Hz


def other_body(motion: Motion, generator: torch.Generator) -> Motion:
    """The same angles on a body drawn at random; the path grows with the legs, so that feet hardly slide."""
    betas = PEOPLE * torch.randn(shape.BETAS, generator=generator)
    scale = shape.scales(betas)[:, None]
    offsets = motion.skeleton.offsets * scale
    legs = motion.skeleton.indices(["left_knee", "left_ankle"])
    grown = offsets[legs].norm(dim=-1).sum() / motion.skeleton.offsets[legs].norm(dim=-1).sum()
    return replace(motion, skeleton=replace(motion.skeleton, offsets=offsets), root=motion.root * grown)


def held_otherwise(motion: Motion, generator: torch.Generator) -> Motion:
    """Every joint of ``LOOSE`` turned by a small smooth rotation of its own: a constant and three slow waves.

    Positions of pelvis, legs and feet stay, and with them their contacts; the turns fade out around a hand's.
    """
    names = motion.skeleton.names
    joints = [j for j, name in enumerate(names) if name.removeprefix("left_").removeprefix("right_").startswith(LOOSE)]
    size = (len(joints), 3)
    much = 2 * torch.rand(1, generator=generator)  # some clips hardly, some a lot
    time = torch.arange(motion.frames)[:, None, None] / motion.fps
    turn = HELD * torch.randn(size, generator=generator).expand(motion.frames, *size)
    for _ in range(3):
        rate, phase = FASTEST * torch.rand(size, generator=generator), math.tau * torch.rand(size, generator=generator)
        turn = turn + SWAYS * torch.randn(size, generator=generator) * torch.sin(math.tau * rate * time + phase)
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


def varied(motion: Motion, generator: torch.Generator) -> Motion:
    """Another body, held another way."""
    return held_otherwise(other_body(motion, generator), generator)
