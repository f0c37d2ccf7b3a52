"""The test cases of thesis 4.2.1: the same number of windows of each person, what of them is hidden, and how well what
was filled in fits.

What is known is said once, for every model and rival: bool (B, T, U) over the units of a frame, which are the joints'
rotations, then the root's place, then the contacts (``features.units``). The root's place goes with the pelvis.

Source: thesis 4.2.1. Differs: numbers instead of looking.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from motionlab.corpus import Take
from motionlab.diffusion.windows import LEGS, gather, on_standard
from motionlab.errors import DataError, ShapeError
from motionlab.metrics import joint_errors, mean_acceleration, slide_where_truth_stands_mm
from motionlab.motion import Motion
from motionlab.skeleton import FEET, STANDARD

JOINTS = len(STANDARD)
HIDDEN = tuple(name for name in STANDARD.names if name.endswith(LEGS))  # rotations that occluded legs lose
LOWER = tuple(name for name in HIDDEN if not name.endswith("hip"))  # joints whose places follow from them
T = TypeVar("T")


class PersonWindows(NamedTuple):
    """motion (N, T) on the standard body, whose it is (N,), and which units (N, 1, U) of a frame its figure lacks."""

    motion: Motion
    whose: Tensor
    lacks: Tensor


def person_windows(takes: Sequence[Take], frames: int, each: int) -> PersonWindows:
    """At most ``each`` windows of every person, evenly over what there is; shorter takes are left out."""
    people: dict[str, list[Take]] = {}
    for take in takes:
        if take.motion.frames >= frames:
            people.setdefault(take.person, []).append(take)
    rows, whose, lacks = [], [], []
    for person, some in enumerate(people.values()):
        data = gather([on_standard(t.motion) for t in some], frames, mirrored=False)
        at = torch.linspace(0, len(data.begins) - 1, min(each, len(data.begins))).round().long()
        rows.append(data.evenly(each))
        whose.append(torch.full((len(at),), person))
        units = [[name in take.missing for name in STANDARD.names] + [False, False] for take in some]
        lacks.append(torch.tensor(units)[data.clip[data.begins[at]]])
    if not rows:
        raise DataError(f"nobody has {frames} frames of motion", remedy="name a folder with more recordings")
    parts = [torch.cat([getattr(m, name) for m in rows]) for name in ("root", "rot", "contacts")]
    return PersonWindows(
        Motion(STANDARD, *parts[:2], rows[0].fps, parts[2]), torch.cat(whose), torch.cat(lacks)[:, None]
    )


def by_person(values: Tensor, whose: Tensor) -> Tensor:
    """The mean (P,) of values (N,) of each person; windows without a value do not count."""
    mine = one_hot(whose).double() * values.isfinite()[:, None]
    return (mine * values.nan_to_num().double()[:, None]).sum(0) / mine.sum(0)


# ---------------------------------------------------------------------------------------------- what is known
def legs(count: int, frames: int) -> Tensor:
    """All but the rotations of hips, knees, ankles and feet, and the contacts, in all frames."""
    known = torch.ones(count, frames, JOINTS + 2, dtype=torch.bool)
    known[..., STANDARD.indices(HIDDEN)] = False
    known[..., -1] = False
    return known


def every_frame(count: int, frames: int, share: float, generator: torch.Generator) -> Tensor:
    """Other joints in every frame, each with the chance ``share``; each is known in one frame at least."""
    known = torch.rand(count, frames, JOINTS, generator=generator) < share
    once = torch.randint(frames, (count, 1, JOINTS), generator=generator)
    return _with_root(known.scatter(1, once, True))


def whole_window(count: int, frames: int, share: float, generator: torch.Generator) -> Tensor:
    """The same joints in all frames of a window: ``share`` of them, and one at least."""
    order = torch.rand(count, 1, JOINTS, generator=generator).argsort(-1).argsort(-1)
    return _with_root((order < max(round(share * JOINTS), 1)).expand(-1, frames, -1))


def gap(count: int, frames: int, length: int) -> Tensor:
    """Whole frames, contacts too, all but ``length`` in the middle.

    Raises:
        ShapeError: not a frame is left at either end.
    """
    start = (frames - length) // 2
    if length < 1 or start < 1 or start + length >= frames:
        raise ShapeError(f"a gap of {length} in {frames} frames: expected 1 to {frames - 2}")
    time = torch.arange(frames)
    known = (time < start) | (time >= start + length)
    return known[None, :, None].repeat(count, 1, JOINTS + 2)


def keys(count: int, frames: int, apart: int) -> Tensor:
    """Whole frames, contacts too, so many apart; as many frames before the first as behind the last, or one fewer."""
    first = (frames - 1) % apart // 2
    return ((torch.arange(frames) - first) % apart == 0)[None, :, None].repeat(count, 1, JOINTS + 2)


def _with_root(joints: Tensor) -> Tensor:
    return torch.cat((joints, joints[..., :1], torch.zeros_like(joints[..., :1])), -1)


# ----------------------------------------------------------------------------------------------- how it went
def hidden_frames(known: Tensor) -> Tensor:
    """(B, T): frames of which a joint or the root is not known."""
    return ~known[..., :-1].all(-1)


def error_cm(made: Motion, truth: Motion, known: Tensor, joints: tuple[str, ...] | None = None) -> Tensor:
    """Mean distance (B,) of joints from the true ones in the world, over the frames of which something is hidden."""
    errors = 100 * joint_errors(made.positions, truth.positions, align="none")
    errors = errors if joints is None else errors[..., STANDARD.indices(joints)]
    where = hidden_frames(known)
    if not where.any(-1).all():
        raise DataError("a window of which all is known", remedy="hide something of every window")
    return (errors.mean(-1) * where).sum(-1) / where.sum(-1)


def chosen(
    options: Sequence[T], make: Callable[[T], Motion], truth: Motion, known: Tensor | None = None,
    joints: tuple[str, ...] | None = None,
) -> T:  # fmt: skip
    """The option that leaves the least error, on windows that settings are chosen on; known None: nothing is known."""
    hidden = torch.zeros(*truth.root.shape[:2], JOINTS + 2, dtype=torch.bool) if known is None else known
    return min(options, key=lambda option: float(error_cm(make(option), truth, hidden, joints).mean()))


def acceleration_ratio(made: Motion, truth: Motion) -> Tensor:
    """Mean size (B,) of the joints' accelerations over the truth's."""
    return mean_acceleration(made.positions, made.fps) / mean_acceleration(truth.positions, truth.fps)


def slide_mm(made: Motion, truth: Motion) -> Tensor:
    """mm per frame (B,) that foot joints move where the true ones stand; NaN where none stands."""
    feet = STANDARD.indices(FEET)
    return slide_where_truth_stands_mm(made.positions[..., feet, :], truth.positions[..., feet, :])


def restore_known(made: Motion, given: Motion, known: Tensor) -> Motion:
    """Returns a motion with its known rotations and places as they were given: without the rounding of a way there and
    back."""
    rot = torch.where(known[..., :JOINTS, None, None], given.rot, made.rot)
    return replace(made, rot=rot, root=torch.where(known[..., JOINTS, None], given.root, made.root))
