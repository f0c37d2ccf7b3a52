"""What nobody in the corpus does: motion for fits that must leave what a prior has learnt."""

import math
from dataclasses import replace

import torch
from torch.nn import functional

from data_synth.actions import ACTIONS
from data_synth.curves import ramp
from data_synth.subjects import Subject
from motionlab import rotation
from motionlab.motion import Motion

#: Turn about the joint's left axis, radians, that makes a ball of a body; the spine's is that of each of three joints.
_TUCK = {"hip": -2.1, "knee": 2.3, "spine": 0.35, "neck": 0.6}
FLESH = 0.07  # metres from a joint to the floor below it


def tumble(subject: Subject, generator: torch.Generator, *, frames: int = 60) -> Motion:
    """From a crouch a roll forward, head over heels and on: tucked up, one turn and a quarter in the clip.

    The tuck is a pose, the turn is about the body's left axis, the lowest joint stays FLESH above the floor, and the
    body advances by a radius of 0.3 m times the turn. Not a gymnast: a motion outside the training data whose every
    number is known.
    """
    crouch = ACTIONS["crouch"](subject, generator).motion
    deep = int(crouch.root[:, 2].argmin())
    ready = min(frames // 4, deep)
    start = crouch.cut(deep - ready, deep)
    pose, left = start.rot[-1], start.rot[-1, 0, :, 0]
    tucked = pose.clone()
    for joint, name in enumerate(start.skeleton.names):
        part = "spine" if name.startswith("spine") else name.split("_")[-1]
        if part in _TUCK:
            tucked[joint] = rotation.exp(torch.tensor([_TUCK[part], 0.0, 0.0]))
    count = frames - ready
    s = (torch.arange(1, count + 1) / count).double()
    angle = 2.5 * math.pi * (0.5 * ramp(s) + 0.5 * s**2).float()
    blend = (4 * s).clamp(max=1).float()
    rot = rotation.slerp(pose.expand(count, -1, 3, 3), tucked.expand(count, -1, 3, 3), blend[:, None])
    rot[:, 0] = rotation.exp(angle[:, None] * left) @ pose[0]
    forward = functional.normalize(torch.linalg.cross(left, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    root = start.root[-1] + 0.3 * angle[:, None] * forward
    motion = replace(
        start, root=torch.cat((start.root, root)), rot=torch.cat((start.rot, rot)),
        contacts=torch.cat((start.contacts, torch.zeros(count, start.contacts.shape[1]))), name="tumble",
    )  # fmt: skip
    return replace(motion, root=_grounded(motion, ready))


def _grounded(motion: Motion, ready: int) -> torch.Tensor:
    """Root (T, 3), after frame ``ready`` moved up or down, smoothly, until the lowest joint lies on the floor."""
    lift = FLESH - motion.positions[..., 2].amin(-1)
    lift[:ready] = 0.0
    window = torch.hann_window(9, periodic=False)[1:-1]
    padded = functional.pad(lift[None, None], (3, 3), mode="replicate")
    smooth = functional.conv1d(padded, (window / window.sum())[None, None])[0, 0]
    return motion.root + functional.pad(smooth[:, None], (2, 0))
