"""How far sources of motion are from each other: windows described by twelve numbers, compared person by person."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Self

import torch
from torch import Tensor
from torch.nn.functional import normalize

from motionlab import metrics, rotation, splits
from motionlab.bench import by_person
from motionlab.contact import with_contacts
from motionlab.corpus import Corpus
from motionlab.motion import Motion, velocity, windows
from motionlab.skeleton import FEET
from studies.nb01_data.real_motion import kind_of
from studies.shared.spectra import power_spectrum

#: What :func:`describe` measures, with its unit.
DESCRIPTION_UNITS = {
    "root speed": "m/s", "turning rate": "deg/s", "joint speed": "m/s", "joint acceleration": "m/s^2",
    "jitter": "m/s^3", "quick motion": "% above 4 Hz", "feet on the floor": "%", "foot height": "m",
    "knee flexion": "deg", "elbow flexion": "deg", "trunk lean": "deg", "hand height": "m",
}  # fmt: skip
#: What a synthetic performer does -> the kind of recordings that it is compared with.
KIND_OF_ACTION = {
    "walk": "walk", "run": "run", "jump": "jump", "dance": "dance", "punch": "fight", "kick": "fight",
    "sit": "sit", "sit down": "sit", "stand up": "sit", "lie": "floor", "lie down": "floor", "get up": "floor",
    "reach": "everyday", "wave": "everyday", "idle": "idle", "turn": "other", "crouch": "other",
}  # fmt: skip
#: Kinds of motion of which there is synthetic motion and are recordings.
KINDS = ("walk", "run", "jump", "sit", "floor", "dance", "fight", "everyday")


class Windows(NamedTuple):
    """Windows described: table (N, 12) in the order of ``DESCRIPTION_UNITS``, whose (N,) each is, and its kind."""

    table: Tensor
    whose: Tensor
    kinds: tuple[str, ...]

    def pick(self, mask: Tensor) -> Self:
        """Returns the windows under a mask (N,), or at indices."""
        at = mask.nonzero()[:, 0] if mask.dtype == torch.bool else mask
        return Windows(self.table[at], self.whose[at], tuple(self.kinds[i] for i in at.tolist()))

    def of(self, *kinds: str) -> Self:
        """Returns the windows of these kinds."""
        return self.pick(torch.tensor([kind in kinds for kind in self.kinds], dtype=torch.bool))

    @property
    def people(self) -> int:
        """How many people there are."""
        return len(self.whose.unique())


def describe(motion: Motion) -> dict[str, Tensor]:
    """Computes a physical summary of each window of motions on the standard joints: ``DESCRIPTION_UNITS`` -> (...).

    Means over the T frames of a window (and over the joints or sides concerned); the root moves on the floor
    plane only; heights are above z = 0; flexion is the angle between the two bones of a limb; quick motion is the
    share of the joints' velocity power above 4 Hz; floor contacts are measured, never taken from labels.
    """
    p, fps, index = motion.positions, motion.fps, motion.skeleton.index
    pelvis, world = p[..., 0, :], motion.world[1]
    moving = velocity(p, fps, dim=-3)
    second = p.diff(n=2, dim=-3) * fps**2
    turn = rotation.geodesic(world[..., :-1, 0, :, :], world[..., 1:, 0, :, :]) * fps
    trunk = normalize(p[..., index("neck"), :] - pelvis, dim=-1)
    feet = [motion.skeleton.contact_names.index(name) for name in FEET]
    hands = p[..., [index("left_wrist"), index("right_wrist")], 2]
    return {
        "root speed": moving[..., 0, :2].norm(dim=-1).mean(-1),
        "turning rate": torch.rad2deg(turn).mean(-1),
        "joint speed": moving.norm(dim=-1).mean((-1, -2)),
        "joint acceleration": second.norm(dim=-1).mean((-1, -2)),
        "jitter": metrics.jitter(p, fps),
        "quick motion": 100 * _power_above(moving - moving.mean(-3, keepdim=True), fps, 4.0),
        "feet on the floor": 100 * with_contacts(motion).contacts[..., feet].mean((-1, -2)),
        "foot height": p[..., motion.skeleton.indices(FEET), 2].mean((-1, -2)),
        "knee flexion": _flexion(motion, "hip", "knee", "ankle"),
        "elbow flexion": _flexion(motion, "shoulder", "elbow", "wrist"),
        "trunk lean": torch.rad2deg(torch.acos(trunk[..., 2].clamp(-1, 1))).mean(-1),
        "hand height": hands.mean((-1, -2)),
    }


def _power_above(moving: Tensor, fps: float, hertz: float) -> Tensor:
    """Share (...) of the power of signals (..., T, J, 3) above a frequency."""
    power = power_spectrum(moving)
    quick = torch.fft.rfftfreq(moving.shape[-3], 1 / fps) > hertz
    return power[..., quick].sum(-1) / power.sum(-1).clamp_min(torch.finfo(power.dtype).tiny)


def _flexion(motion: Motion, *chain: str) -> Tensor:
    angles = []
    for side in ("left", "right"):
        a, b, c = (motion.positions[..., motion.skeleton.index(f"{side}_{part}"), :] for part in chain)
        upper, lower = normalize(b - a, dim=-1), normalize(c - b, dim=-1)
        angles.append(torch.acos((upper * lower).sum(-1).clamp(-1, 1)))
    return torch.rad2deg(torch.stack(angles)).mean((0, -1))


def describe_clips(clips: Iterable[tuple[Motion, str, str | Sequence[str]]], seconds: float) -> Windows:
    """Describes every whole window of clips, one after the other: (motion, person, its kind or one of each frame).

    A clip that is shorter than a window is left out. A window is of the kind of most of its frames.
    """
    tables, whose, kinds, names = [], [], [], {}
    for motion, person, kind in clips:
        length = round(seconds * motion.fps)
        if motion.frames < length:
            continue
        found = torch.stack(list(describe(windows(motion, length, length)).values()), dim=-1)
        tables.append(found.double())
        whose += [names.setdefault(person, len(names))] * len(found)
        frames = [kind] * motion.frames if isinstance(kind, str) else kind
        kinds += [Counter(frames[i * length : (i + 1) * length]).most_common(1)[0][0] for i in range(len(found))]
    table = torch.cat(tables) if tables else torch.zeros(0, len(DESCRIPTION_UNITS)).double()
    return Windows(table, torch.tensor(whose, dtype=torch.long), tuple(kinds))


def describe_one(
    motion: Motion, generator: torch.Generator, *, start: float = 0.0, seconds: float = 2.0, speed: float = 1.0,
    tremble: float = 0.0,
) -> Tensor:  # fmt: skip
    """Describes one window of a motion (12,): from ``start`` seconds on, played faster, its root trembling by mm.

    Where the motion is shorter, the window ends with it.
    """
    length = max(3, min(round(seconds * speed * motion.fps), motion.frames))
    first = min(round(start * motion.fps), motion.frames - length)
    cut = motion.cut(first, first + length)
    shaken = cut.root + tremble / 1000 * torch.randn(cut.root.shape, generator=generator)
    return torch.stack(list(describe(replace(cut, root=shaken, fps=speed * motion.fps)).values()), dim=-1).double()


def describe_sources(
    sequences: Sequence, real: Corpus | None, folder: Path | None, *, each: int | None, seconds: float
) -> dict[str, Windows]:
    """Describes the synthetic corpus and what recordings there are, by source; ``each`` of Bandai-Namco's at most."""
    clips = {"synthetic": [
        (s.motion, s.take.subject.name, [KIND_OF_ACTION.get(label, "other") for label in s.take.labels])
        for s in sequences
    ]}  # fmt: skip
    clips["CMU"] = [
        (t.motion, t.person, kind_of(t)) for t in (real.takes if real else ()) if t.person.startswith("cmu_")
    ]
    styles = [(motion, motion.name.split("_")) for motion in splits.load_source(folder, "bandai_namco", each=each)]
    clips["Bandai-Namco"] = [  # a name holds set, action, acted style, number; "people" are styles
        (motion, name[2], "walk" if name[1].startswith("walk") else "other") for motion, name in styles
    ]
    for name, source in (("DeepMimic", "deepmimic"), ("ReActIdle", "reactidle")):
        clips[name] = [(motion, source, "") for motion in splits.load_source(folder, source)]
    return {name: describe_clips(some, seconds) for name, some in clips.items() if some}


def standardised(some: Windows, by: Windows) -> Windows:
    """Returns windows in deviations from the mean of others."""
    return some._replace(table=(some.table - by.table.mean(0)) / by.table.std(0).clamp_min(1e-12))


def at_most(some: Windows, each: int, generator: torch.Generator) -> Windows:
    """Draws at most ``each`` windows of every person, so that everybody counts alike."""
    order = torch.randperm(len(some.whose), generator=generator)
    mine = some.whose[order]
    kept = [order[mine == person][:each] for person in mine.unique()]
    return some.pick(torch.cat(kept).sort().values) if kept else some


def of_many(some: Windows, least: int) -> Windows:
    """Returns the windows of people of whom there are at least so many."""
    names, counts = some.whose.unique(return_counts=True)
    return some.pick(torch.isin(some.whose, names[counts >= least]))


def same_kind(
    real: Windows | None, made: Windows, generator: torch.Generator, *, each: int, least: int
) -> Iterator[tuple[str, Windows, Windows]]:
    """Lists kind by kind the recorded and the synthetic windows, where enough people have at least two of them.

    Kinds with fewer synthetic windows than ``each`` are left out; without recordings there are none.
    """
    for kind in KINDS if real else ():
        theirs, ours = at_most(of_many(real.of(kind), 2), each, generator), made.of(kind)
        if theirs.people >= least and len(ours.whose) >= each:
            yield kind, theirs, ours


def halves(some: Windows, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Splits the people at random into two halves: the tables of both."""
    names = some.whose.unique()
    mine = torch.isin(some.whose, names[torch.randperm(len(names), generator=generator)[: len(names) // 2]])
    return some.table[mine], some.table[~mine]


def judge(real: Windows, made: Windows, neighbours: int = 5) -> Tensor:
    """Computes how often windows are rightly called recorded or synthetic, a share for each recorded person.

    The share is the mean of that person's own windows and of all synthetic people's; 0.5 is a coin. A window is judged
    by its nearest windows of *other* people: a vote weighs the more, the fewer windows its side has left without them.
    The larger set is thinned evenly.

    Source: the classifier two-sample test (Lopez-Paz and Oquab 2017) with nearest neighbours.
    """
    count = min(len(real.whose), len(made.whose))
    real, made = (s.pick(torch.linspace(0, len(s.whose) - 1, count).round().long()) for s in (real, made))
    x = torch.cat((real.table, made.table))
    x = (x - x.mean(0)) / x.std(0).clamp_min(1e-12)
    whose = torch.cat((real.whose, made.whose + real.whose.max() + 1))
    synthetic = torch.arange(len(x)) >= count
    own = whose[:, None] == whose
    near = torch.cdist(x, x).masked_fill(own, torch.inf).topk(min(neighbours, len(x) - 1), largest=False).indices
    left = torch.stack([(~own & (synthetic == side)).sum(1) for side in (False, True)], dim=1)
    votes = torch.stack([(synthetic[near] == side).sum(1) for side in (False, True)], dim=1) / left.clamp_min(1)
    right = ((votes[:, 1] > votes[:, 0]) == synthetic).double()
    mine = by_person(right[~synthetic], real.whose)
    return (mine[mine.isfinite()] + by_person(right[synthetic], made.whose).nanmean()) / 2


def lacking(real: Windows, made: Windows) -> Tensor:
    """Computes by how much synthetic windows differ from each person's (P, 12), in deviations of recorded windows."""
    spread = real.table.std(0).clamp_min(1e-12)
    theirs = torch.stack([real.table[real.whose == person].mean(0) for person in real.whose.unique()])
    return (made.table.mean(0) - theirs) / spread


def largest_elsewhere(gaps: Tensor) -> Tensor:
    """Computes the largest of the differences (P, 12), (P,): chosen on one half of the people, measured on the other.

    Its sign is chosen with it: where the halves do not agree, the mean is near zero.
    """
    found = torch.empty(len(gaps), dtype=gaps.dtype)
    for mine, other in ((slice(0, None, 2), slice(1, None, 2)), (slice(1, None, 2), slice(0, None, 2))):
        middle = gaps[other].mean(0)
        at = int(middle.abs().argmax())
        found[mine] = gaps[mine, at] * middle[at].sign()
    return found
