"""From one action of a person to another: what is between is filled in, or the two recordings are cut and spliced.

Source: thesis 4.4.2, "motion switching". The best cut: motion graphs (Kovar et al. 2002), the frame at which two
recordings are most alike, and a cross-fade there. It sees both recordings inside the gap, which the others do not.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from motionlab import bench, rotation
from motionlab.animate.foot_locking import lock_feet
from motionlab.bench import PersonWindows
from motionlab.contact import with_contacts
from motionlab.corpus import Take
from motionlab.diffusion.windows import gather, on_standard
from motionlab.heading import heading_frame, local_to_world, world_to_local
from motionlab.metrics import mean_acceleration, skating_ratio
from motionlab.motion import Motion
from motionlab.skeleton import BALLS, STANDARD
from studies.nb12_filling_in.flaws import step_changes
from studies.shared.fill_contenders import MIXED, Models, P, R, T
from studies.shared.fill_people import FRAMES

GAP = 20  # frames between the end of A and the beginning of B
JUMP, SKATE, CALM = "largest jump, m/s", "skating, % of frames", "acceleration, log of ratio, without sign"
RIVALS = ("best cut", "best cut, planted", "curves")
_PACE, _FADE = 5, 5  # frames over which a velocity is measured; on either side of a cut, over which it fades


def pairs(takes: Sequence[Take], each: int, generator: torch.Generator) -> tuple[PersonWindows, Motion]:
    """Windows A, with whose they are, and B (N, T) of two recordings of one person that are said to show different
    actions; at most ``each`` of a person."""
    people: dict[str, list[Take]] = {}
    for take in takes:
        if take.motion.frames >= FRAMES and any(c.isalpha() for c in take.said):
            people.setdefault(take.person, []).append(take)
    sides, whose, lacks = ([], []), [], []
    for person, mine in enumerate(people.values()):
        mine = [mine[k] for k in torch.randperm(len(mine), generator=generator).tolist()]
        ways = [(a, b) for a, b in zip(mine, mine[1:] + mine[:1], strict=True) if a.said != b.said]
        for two in ways[:each]:
            for side, take in zip(sides, two, strict=True):
                at = int(torch.randint(take.motion.frames - FRAMES + 1, (), generator=generator))
                side.append(on_standard(take.motion.cut(at, at + FRAMES)))
            whose.append(person)
            lacks.append([name in two[0].missing + two[1].missing for name in STANDARD.names] + [False, False])
    a, b = (replace(gather(side, FRAMES, mirrored=False).evenly(len(whose)), skeleton=STANDARD) for side in sides)
    people_of = torch.tensor(whose).unique(return_inverse=True)[1]
    return PersonWindows(a, people_of, torch.tensor(lacks)[:, None]), b


def asked(a: Motion, b: Motion) -> tuple[Motion, Tensor]:
    """The beginning of A and the end of B, put where A would arrive, and what is known (N, T, U): all but the gap."""
    start = (FRAMES - GAP) // 2
    before, after = a.cut(0, start), b.cut(start + GAP)
    there = _placed(after, 0, before, -1)
    travel = (GAP + 1) / a.fps * (_pace(before.cut(-_PACE - 1)) + _pace(there.cut(0, _PACE + 1))) / 2
    there = replace(there, root=there.root + travel[:, None])
    hold = before.cut(-1)
    root = torch.cat((before.root, hold.root.repeat(1, GAP, 1), there.root), 1)
    rot = torch.cat((before.rot, hold.rot.repeat(1, GAP, 1, 1, 1), there.rot), 1)
    return with_contacts(replace(a, root=root, rot=rot, contacts=None)), bench.gap(len(root), FRAMES, GAP)


def cut_and_faded(a: Motion, b: Motion) -> Motion:
    """A up to where it is most like B within the gap, then B, put there, with a cross-fade of a third of a second."""
    start, off, made = (FRAMES - GAP) // 2, [], []
    for at in range(start + _FADE, start + GAP - _FADE + 1):
        there, near = _placed(b, at, a, at), slice(at - 1, at + 2)
        off.append((a.positions[:, near] - there.positions[:, near]).norm(dim=-1).mean((1, 2)))
        share = ((torch.arange(FRAMES) - (at - _FADE)) / (2 * _FADE)).clamp(0, 1)[:, None]
        share = share * share * (3 - 2 * share)
        rot = rotation.slerp(a.rot, there.rot, share)
        made.append(replace(a, root=torch.lerp(a.root, there.root, share), rot=rot, contacts=None))
    best = torch.stack(off).argmin(0), torch.arange(len(a.root))
    root, rot = (torch.stack([getattr(m, part) for m in made])[best] for part in ("root", "rot"))
    return replace(made[0], root=root, rot=rot)


def _placed(motion: Motion, here: int, other: Motion, there: int) -> Motion:
    """A motion that in its frame ``here`` stands and faces as another one does in ``there``; heights stay."""
    here, there = (heading_frame(m.root[:, [at]], m.rot[:, [at], 0]) for m, at in ((motion, here), (other, there)))
    return local_to_world(there, world_to_local(here, motion))


def _pace(motion: Motion) -> Tensor:
    """Mean velocity (N, 3) over the floor in m/s."""
    moved = (motion.root[:, -1] - motion.root[:, 0]) * motion.fps / (motion.frames - 1)
    return moved * moved.new_tensor([1.0, 1.0, 0.0])


def everybody(m: Models, a: PersonWindows, b: Motion) -> dict[str, Motion]:
    """What needs no network, by name, then R, T and P, mixed with what is known; feet planted but of the bare cut."""
    given, known = asked(a.motion, b)
    told, cut = known & ~a.lacks, cut_and_faded(a.motion, b)
    made = {R: m.r.complete(given, told), T: m.drawn(given, told, 0), P: m.plain(given, told, MIXED, 0)}
    made = {name: bench.restore_known(x, given, known | a.lacks) for name, x in made.items()}
    made = {RIVALS[1]: cut, RIVALS[2]: m.curves(given, known)} | made
    how = {"known": known[..., 0], "step": True}  # as the product does
    return {RIVALS[0]: cut} | {name: lock_feet(with_contacts(x), **how) for name, x in made.items()}


def measured(made: Motion, a: Motion, b: Motion) -> dict[str, Tensor]:
    """Of every transition (N, T), in the gap and three frames beside it: the largest change of velocity, the share of
    frames in which a foot skates, and |log| of the mean acceleration over that of A and B in these frames."""
    around = slice((FRAMES - GAP) // 2 - 3, (FRAMES + GAP) // 2 + 3)
    p, usual = made.positions[:, around], sum(mean_acceleration(x.positions[:, around], x.fps) / 2 for x in (a, b))
    return {
        JUMP: step_changes(p, made.fps)[:, 1:-1].amax(-1),
        SKATE: 100 * skating_ratio(p[..., STANDARD.indices(BALLS), :], made.fps),
        CALM: (mean_acceleration(p, made.fps) / usual).log().abs(),
    }
