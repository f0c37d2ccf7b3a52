"""What is known about a performance because it was planned: contacts, labels, phase."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from data_synth.score import Score
from motionlab.motion import Motion

#: A pelvis lower than this is that of someone who sits or lies on the floor, metres.
DOWN = 0.35
#: A joint of such a body touches the floor within this of its height at rest, metres, and below this speed, m/s.
LYING, STILL = 0.005, 0.028


def planned_contacts(score: Score, t: Tensor) -> Tensor:
    """Contacts (T, C) of the joints that the score plants."""
    names = score.subject.skeleton.contact_names
    contacts = torch.zeros(len(t), len(names), dtype=torch.float64)
    open_ended = [(joint, start, math.inf) for joint, start in score.planted.items()]
    for joint, start, stop in [*score.contacts, *open_ended]:
        contacts[(t >= start - 1e-9) & (t <= stop + 1e-9), names.index(joint)] = 1
    return contacts


def resting(motion: Motion, settle: Tensor, thickness: float, rest: Tensor) -> Motion:
    """Add the contacts of a body on the floor: joints at the floor that keep still.

    rest (C,): heights at rest, metres. Pelvis: within 4 cm of its thickness. The others, while it is lower
    than DOWN: within LYING of their height. Still: slower than STILL before and after.
    """
    step = motion.positions[:, motion.skeleton.contact_indices].diff(dim=0).norm(dim=-1) * motion.fps
    still = (torch.cat((step, step[-1:])) < STILL) & (torch.cat((step[:1], step)) < STILL)
    height = motion.positions[:, motion.skeleton.contact_indices, 2]
    lying = ((motion.root[:, 2] - thickness).abs() < 0.04) & (settle > 0.999)
    touching = (motion.root[:, 2:] < DOWN) & ((height - rest).abs() < LYING)
    touching[:, motion.skeleton.contact_names.index("pelvis")] = lying
    touching &= still
    return replace(motion, contacts=torch.maximum(motion.contacts, touching.to(motion.contacts)))


def course(score: Score, t: Tensor) -> tuple[tuple[str, ...], Tensor]:
    """Label and phase of every frame; the innermost action that covers a frame names it."""
    labels, phase = ["idle"] * len(t), torch.zeros(len(t))
    for start, stop, label in sorted(score.labels, key=lambda mark: mark[0] - mark[1]):
        inside = ((t >= start - 1e-9) & (t < stop - 1e-9)).nonzero()[:, 0].tolist()
        for i in inside:
            labels[i] = label
        if inside:
            phase[inside] = ((t[inside] - start) / (stop - start)).clamp(0, 0.9999).float()
    if score.gait:
        at, cycle = (torch.tensor(x, dtype=torch.float64) for x in zip(*sorted(score.gait), strict=True))
        for i in range(len(at) - 1):
            if cycle[i + 1] > cycle[i]:
                inside = (t >= at[i]) & (t < at[i + 1])
                way = cycle[i] + (cycle[i + 1] - cycle[i]) * (t[inside] - at[i]) / (at[i + 1] - at[i])
                phase[inside] = (way % 1).float()
    return tuple(labels), phase
