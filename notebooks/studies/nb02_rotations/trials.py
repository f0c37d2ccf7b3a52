"""The experiments of notebook 02 over many recordings: gaps, flips and consistency of the root's rotation.

Roots are (T, 3, 3) at 30 frames per second, by person: ``{"person": [root, ...]}`` (synthetic: by clip). The heading of
a recording's axes is an accident, and the branch cut depends on it, so every trial turns each recording by a heading of
its own, drawn at random.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from data_synth import clips, corpus
from motionlab import rotation
from motionlab.bench import by_person
from motionlab.motion import FPS, Motion, resample
from motionlab.skeleton import UPRIGHT
from studies.nb02_rotations import representations as rep
from studies.nb02_rotations.representations import AXIS_ANGLE, SIXD, UNROLLED

People = Mapping[str, Sequence[Tensor]]
#: The arms of the consistency experiment: a representation, and whether the decoded vector is rewritten first.
ARMS = {"axis-angle": (AXIS_ANGLE, False), "axis-angle, nearest vector": (UNROLLED, True), "6D": (SIXD, False)}


# ------------------------------------------------------------------------------------------------------- material
def made(count: int, seconds: float, seed: int, generator: torch.Generator) -> dict[str, list[Tensor]]:
    """Makes synthetic roots by clip: ``count`` takes of turns, dances, floor work and jumps, and the whole corpus."""
    takes = clips.draw(count, generator, actions=("turn", "dance", "floor", "jump"))
    sequences = corpus.build(recipe=corpus.Recipe(seed=seed, seconds=seconds), progress=False).sequences
    return {f"clip {i}": [take.motion.rot[:, 0]] for i, take in enumerate((*takes, *sequences))}


def ordinary(count: int, generator: torch.Generator) -> dict[str, list[Tensor]]:
    """Makes synthetic roots of people who walk, stand, reach and sit, by clip."""
    takes = clips.draw(count, generator, actions=("walk", "idle", "reach", "sit"))
    return {f"clip {i}": [take.motion.rot[:, 0]] for i, take in enumerate(takes)}


def at_random_heading(people: People, generator: torch.Generator) -> dict[str, list[Tensor]]:
    """Turns each root (T, 3, 3) about the vertical by an angle of its own."""
    turned = {}
    for who, roots in people.items():
        angles = math.tau * torch.rand(len(roots), generator=generator)
        turned[who] = [rotation.rotation_about("z", a.to(r)) @ r for r, a in zip(roots, angles, strict=True)]
    return turned


def cut_windows(people: People, length: int, stride: int) -> tuple[Tensor, Tensor]:
    """Cuts all windows (N, length, 3, 3) out of roots that are long enough, and whose each is (N,)."""
    pieces, whose = [torch.zeros(0, length, 3, 3)], [torch.zeros(0, dtype=torch.long)]
    for i, roots in enumerate(people.values()):
        pieces += [r.float().unfold(0, length, stride).movedim(-1, 1) for r in roots if len(r) >= length]
        whose += [torch.full(((len(r) - length) // stride + 1,), i) for r in roots if len(r) >= length]
    return torch.cat(pieces), torch.cat(whose)


def means(values: Tensor, whose: Tensor, among: Tensor | None = None) -> Tensor:
    """Computes the mean (P,) of values (N,) of each person who has any; ``among`` (N,) chooses which values count."""
    if not len(values):
        return torch.zeros(0)
    each = by_person(values.double() if among is None else torch.where(among, values.double(), torch.nan), whose)
    return each[each.isfinite()]


# ----------------------------------------------------------------------------------------------- where the cut is
def degrees_from_cut(people: People) -> Tensor:
    """Computes how far (N,) every frame's rotation vector is from the cut, an angle of 180 degrees, in HuMoR's heading
    frame, where the body faces +y: degrees."""
    path = torch.cat([root.float() for roots in people.values() for root in roots])
    local = rotation.rotation_about("z", -rotation.yaw(path)) @ path
    return 180 - torch.rad2deg(rotation.matrix_to_axis_angle(local).norm(dim=-1))


def leaning_turn(turns: float, frames: int) -> Tensor:
    """Makes a body (frames, 3, 3) that turns about the vertical while it leans 15 degrees to its left and back."""
    angle = torch.linspace(0, math.tau * turns, frames, dtype=torch.float64)
    lean = rotation.rotation_about("z", math.radians(15) * (0.5 * angle).sin())
    return rotation.rotation_about("z", angle) @ UPRIGHT.double() @ lean


def through_the_cut(motion: Motion, frames: int) -> Motion:
    """Cuts out the ``frames`` in which the root turns fastest, with a heading that meets the cut in their middle."""
    root = motion.rot[:, 0]
    turn = rotation.geodesic(root[:-1], root[1:])
    frames = min(frames, motion.frames)
    start = int(turn.unfold(0, frames - 1, 1).sum(-1).argmax())
    piece = motion.cut(start, start + frames)
    return heading_at(piece, -torch.rad2deg(rotation.yaw(piece.rot[piece.frames // 2, 0])).item())


def heading_at(motion: Motion, degrees: float) -> Motion:
    """Turns a motion about the vertical."""
    turn = rotation.rotation_about("z", torch.tensor(math.radians(degrees)).to(motion.root))
    rot = torch.cat(((turn @ motion.rot[:, 0])[:, None], motion.rot[:, 1:]), dim=1)
    return replace(motion, root=motion.root @ turn.mT, rot=rot)


def with_roots(motion: Motion, roots: Mapping[str, Tensor], *, around: int) -> dict[str, Motion]:
    """Gives copies of a motion other root rotations (T, 3, 3): its middle, ``around`` frames on either side of it, at
    75 fps for slow motion."""
    panels = {"truth": motion} | {
        name: replace(motion, rot=torch.cat((root.to(motion.rot)[:, None], motion.rot[:, 1:]), dim=1))
        for name, root in roots.items()
    }
    middle = motion.frames // 2
    first, last = max(middle - around, 0), min(middle + around, motion.frames)
    return {name: resample(panel.cut(first, last), 75.0) for name, panel in panels.items()}


# ----------------------------------------------------------------------------------------------------------- gaps
class Gaps(NamedTuple):
    """Paths (N, T, 3, 3) whose hidden middle is ``gap`` frames, whose each is (N,), and which cross the cut (N,)."""

    path: Tensor
    whose: Tensor
    crossing: Tensor
    gap: int


def lively_gaps(people: People, generator: torch.Generator, *, gap: int, each: int) -> Gaps:
    """Finds gaps across which the true root turns by 20 degrees or more; at most ``each`` of a person. Ten frames are
    seen on either side. Hidden middles do not overlap."""
    path, whose = cut_windows(at_random_heading(people, generator), 20 + gap, gap)
    middle = rep.across_gap(path, gap)
    turn = torch.rad2deg(rotation.geodesic(middle[:, 0], middle[:, -1]))
    order = torch.randperm(len(path), generator=generator)
    order = order[turn[order] >= 20.0]
    mine = [order[whose[order] == i][:each] for i in range(len(people))]
    kept = torch.cat(mine) if mine else order
    vectors = rotation.matrix_to_axis_angle(middle[kept])
    return Gaps(path[kept].double(), whose[kept], (vectors.diff(dim=-2).norm(dim=-1) > math.pi).any(-1), gap)


def turned_round(gaps: Gaps) -> Tensor:
    """Turns the gaps that cross the cut by half a turn about the vertical, the farthest from the cut there is."""
    return rotation.rotation_about("z", torch.tensor(math.pi).to(gaps.path)) @ gaps.path[gaps.crossing]


def shares(
    gaps: Gaps, filled: Mapping[str, Tensor], turned: Tensor
) -> tuple[dict[str, Tensor], dict[str, Tensor], Tensor]:
    """Computes the share of a person's gaps filled the long way (P,), half a turn or more beyond the shortest: by
    description of all gaps and of those across the cut, and of those in axis-angle turned round."""
    long = {name: rep.excess_rotation(path, gaps.gap) >= 180 for name, path in filled.items()}
    each = {name: means(which, gaps.whose) for name, which in long.items()}
    cut = {name: means(which, gaps.whose, gaps.crossing) for name, which in long.items()}
    return each, cut, means(rep.excess_rotation(turned, gaps.gap) >= 180, gaps.whose[gaps.crossing])


# ---------------------------------------------------------------------------------------------------------- flips
@dataclass(frozen=True, eq=False)
class Flips:
    """How often carried and decoded vectors of one root disagree, one number per person (P,).

    per_minute: changes between agreement and disagreement. midpoint_deg (of people with a flip): median over the
    flipped frames of how far the average of the two vectors is from the rotation. sixd_*: the same for 6D. example
    (T, 3, 3): the root with the most flips.
    """

    per_minute: Tensor
    sixd_per_minute: Tensor
    midpoint_deg: Tensor
    sixd_midpoint_deg: Tensor
    example: Tensor


def count_flips(people: People, generator: torch.Generator) -> Flips:
    """Compares carried with decoded vectors over whole recordings. Source: thesis 3.3.2, first issue."""
    rates, middles, most = [], [], (-1, None)
    for roots in at_random_heading(people, generator).values():
        changes, minutes, off = torch.zeros(2), 0.0, []
        for root in roots:
            carried, decoded = rep.carried_and_decoded(root)
            mask = rep.flipped(carried, decoded)
            six = [SIXD.encode(rotation.axis_angle_to_matrix(v)) for v in (carried, decoded)]
            apart = torch.stack((mask, (six[0] - six[1]).norm(dim=-1) > 0.01))
            found = (apart[:, 1:] != apart[:, :-1]).sum(1)
            changes, minutes = changes + found, minutes + len(root) / FPS / 60
            errors = (rep.off_by(h, sum(x) / 2, root) for h, x in ((AXIS_ANGLE, (carried, decoded)), (SIXD, six)))
            off.append(torch.stack([*errors])[:, mask])
            most = max(most, (int(found[0]), root), key=lambda pair: pair[0])
        rates.append(changes / minutes)
        flipped = torch.cat(off, dim=1)
        middles += [flipped.median(1).values] if flipped.shape[1] else []
    rate, sixd_rate = torch.stack(rates, 1).double()
    middle = torch.stack(middles, 1) if middles else torch.zeros(2, 0)
    return Flips(rate, sixd_rate, middle[0], middle[1], most[1])


# ---------------------------------------------------------------------------------------------------- consistency
@dataclass(frozen=True, eq=False)
class Consistency:
    """Outcome of the consistency fit on 2 s clips of people ``whose`` (N,). worst_deg: arm -> (N,) largest error of a
    clip in degrees. flipped (N,): where its two vectors, the decoder's error included, disagree somewhere."""

    worst_deg: dict[str, Tensor]
    flipped: Tensor
    whose: Tensor

    def ruined(self, arm: str, *, flipped: bool = True) -> Tensor:
        """Computes each person's share of clips, with or without a flip, that end more than 30 degrees off."""
        return means(self.worst_deg[arm] > 30, self.whose, self.flipped == flipped)


def compare_consistency(
    people: People, fit: Callable[[Tensor, Tensor], Tensor], generator: torch.Generator, *, each: int, noise_deg: float
) -> Consistency:
    """Runs one consistency fit, carried (N, T, P), decoded (N, T, P) to fitted parameters, on the same clips, at most
    ``each`` of a person, and the same noise, arm by arm. noise_deg: the decoder's error per axis and frame; an arm that
    starts at its optimum proves nothing."""
    length = round(2 * FPS)
    path, whose = cut_windows(at_random_heading(people, generator), length, length)
    order = torch.randperm(len(path), generator=generator)
    kept = torch.cat([order[:0], *(order[whose[order] == i][:each] for i in range(len(people)))])
    path, whose = path[kept], whose[kept]
    noise = math.radians(noise_deg) * torch.randn(*path.shape[:2], 3, generator=generator)
    carried, _ = rep.carried_and_decoded(path)
    _, decoded = rep.carried_and_decoded(path @ rotation.axis_angle_to_matrix(noise))
    worst = {}
    for name, (how, nearest) in ARMS.items():
        start, target = carried, rep.nearest_vector(decoded, carried) if nearest else decoded
        if how is SIXD:
            start, target = (how.encode(rotation.axis_angle_to_matrix(v)) for v in (carried, decoded))
        worst[name] = rep.off_by(how, fit(start, target), path).amax(-1)
    return Consistency(worst, rep.flipped(carried, decoded).any(-1), whose)
