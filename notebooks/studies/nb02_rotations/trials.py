"""The experiments of notebook 02 over many recordings: gaps, flips and consistency of the root's rotation.

Roots are (T, 3, 3) at 30 frames per second. The heading of a recording's axes is an accident, and the branch
cut depends on it, so every trial turns each recording by a heading of its own, drawn at random.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.motion import Motion
from studies.nb02_rotations import representations as rep
from studies.nb02_rotations.representations import AXIS_ANGLE, SIXD, Representation

FPS = 30.0


def at_random_heading(roots: Sequence[Tensor], generator: torch.Generator) -> list[Tensor]:
    """Each root (T, 3, 3) turned about the vertical by an angle of its own."""
    angles = 2 * math.pi * torch.rand(len(roots), generator=generator)
    return [rotation.rotation_about("z", angle.to(root)) @ root for root, angle in zip(roots, angles, strict=True)]


def cut_windows(roots: Sequence[Tensor], length: int, stride: int) -> Tensor:
    """All windows (N, length, 3, 3) of all roots that are long enough."""
    pieces = [root.unfold(0, length, stride).movedim(-1, 1) for root in roots if len(root) >= length]
    return torch.cat(pieces) if pieces else torch.zeros(0, length, 3, 3)


def canonical_angle(roots: Sequence[Tensor]) -> Tensor:
    """Angle (N,) in degrees of the root's rotation vector in HuMoR's heading frame, every frame of every root.

    Source: HuMoR's canonical frame, where the body faces +y; the cut lies at 180.
    """
    path = torch.cat(list(roots))
    local = rotation.rotation_about("z", -rotation.yaw(path)) @ path
    return torch.rad2deg(rotation.matrix_to_axis_angle(local).norm(dim=-1))


def lively_gaps(
    roots: Sequence[Tensor],
    generator: torch.Generator,
    *,
    most: int,
    context: int = 10,
    length: int = 10,
    least_deg: float = 20.0,
) -> Tensor:
    """Windows (N, context + length + context, 3, 3) whose middle turns by ``least_deg`` or more; at most ``most``.

    Hidden middles do not overlap.
    """
    path = cut_windows(at_random_heading(roots, generator), 2 * context + length, length)
    turn = torch.rad2deg(rotation.geodesic(path[:, context - 1], path[:, -context]))
    path = path[turn >= least_deg]
    return path[torch.randperm(len(path), generator=generator)[:most]]


@dataclass(frozen=True, eq=False)
class Flips:
    """How often carried and decoded vectors of one root disagree, over recordings.

    per_minute (clips,): changes between agreement and disagreement per minute, weighted by length so that their
    mean is all changes over all minutes. minutes: in all. share: of frames flipped. midpoint_deg (clips with a
    flip,): median over the clip's flipped frames of how far the average of the two vectors is from the rotation.
    sixd_*: the same for 6D. example (T, 3, 3): the root with the most flips per minute.
    """

    per_minute: Tensor
    sixd_per_minute: Tensor
    minutes: float
    share: float
    midpoint_deg: Tensor
    sixd_midpoint_deg: Tensor
    example: Tensor


def count_flips(roots: Sequence[Tensor], generator: torch.Generator) -> Flips:
    """Compare carried with decoded vectors over whole recordings. Source: thesis 3.3.2, first issue."""
    rate, sixd_rate, masks, middle, sixd_middle = [], [], [], [], []
    roots = at_random_heading(roots, generator)
    for root in roots:
        carried, decoded = rep.carried_and_decoded(root)
        mask = rep.flipped(carried, decoded)
        six = [SIXD.encode(rotation.axis_angle_to_matrix(v)) for v in (carried, decoded)]
        rate.append(rep.flips_per_minute(mask, FPS))
        sixd_rate.append(rep.flips_per_minute((six[0] - six[1]).norm(dim=-1) > 0.01, FPS))
        masks.append(mask)
        if mask.any():
            middle.append(rep.midpoint_error(AXIS_ANGLE, carried, decoded, root)[mask].median())
            sixd_middle.append(rep.midpoint_error(SIXD, *six, root)[mask].median())
    frames = torch.tensor([float(len(root)) for root in roots])
    weight = frames / frames.mean()
    return Flips(
        per_minute=weight * torch.stack(rate),
        sixd_per_minute=weight * torch.stack(sixd_rate),
        minutes=frames.sum().item() / FPS / 60,
        share=torch.cat(masks).double().mean().item(),
        midpoint_deg=torch.tensor(middle),
        sixd_midpoint_deg=torch.tensor(sixd_middle),
        example=roots[int(torch.stack(rate).argmax())],
    )


@dataclass(frozen=True, eq=False)
class Consistency:
    """Outcome of the consistency fit on 2 s clips.

    worst_deg: representation -> (clips,) largest error of a clip in degrees. flipped (clips,): where its two
    vectors disagree somewhere.
    """

    worst_deg: dict[str, Tensor]
    flipped: Tensor


def compare_consistency(
    roots: Sequence[Tensor],
    generator: torch.Generator,
    *,
    steps: int,
    seconds: float = 2.0,
    choices: Sequence[Representation] = (AXIS_ANGLE, SIXD),
) -> Consistency:
    """The same energy, decoder noise, optimiser, step length and number of steps in each representation."""
    length = round(seconds * FPS)
    path = cut_windows(at_random_heading(roots, generator), length, length)
    carried, decoded = rep.carried_and_decoded(path)
    seed = int(torch.randint(2**62, (), generator=generator))
    same_noise = [torch.Generator().manual_seed(seed) for _ in choices]
    worst = {
        r.name: rep.consistency(path, r, own, steps=steps)[0].amax(-1)
        for r, own in zip(choices, same_noise, strict=True)
    }
    return Consistency(worst, rep.flipped(carried, decoded).any(-1))


def through_the_cut(motion: Motion, *, frames: int) -> Motion:
    """The ``frames`` of a clip in which the root turns fastest, with a heading that meets the cut in their middle."""
    root = motion.rot[:, 0]
    turn = rotation.geodesic(root[:-1], root[1:])
    start = int(turn.unfold(0, frames - 1, 1).sum(-1).argmax())
    piece = motion.cut(start, start + frames)
    turn_back = rotation.rotation_about("z", -rotation.yaw(piece.rot[frames // 2, 0]))
    rot = torch.cat(((turn_back @ piece.rot[:, 0])[:, None], piece.rot[:, 1:]), dim=1)
    return replace(piece, root=piece.root @ turn_back.mT, rot=rot)


def filled_motions(
    motion: Motion, choices: Sequence[Representation], *, context: int, closures: int
) -> dict[str, Motion]:
    """A motion and its copies whose root rotation is hidden between the contexts and filled by smoothness."""
    root = motion.rot[:, 0]
    panels = {"truth": motion}
    for r in choices:
        filled = rep.fill(root[None], r, context=context, closures=closures)[0][0].to(root)
        panels[r.name] = replace(motion, rot=torch.cat((filled[:, None], motion.rot[:, 1:]), dim=1))
    return panels


def path_ratio(panels: Mapping[str, Motion], *, context: int) -> dict[str, float]:
    """Rotation across the gap over the shortest way across, for each panel."""
    ratio = {}
    for name, motion in panels.items():
        root = motion.rot[context - 1 : motion.frames - context + 1, 0].double()
        length = rotation.geodesic(root[:-1], root[1:]).sum()
        ratio[name] = (length / rotation.geodesic(root[0], root[-1])).item()
    return ratio
