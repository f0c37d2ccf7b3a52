"""The bench: judges whoever completes motions, on windows of people nobody trained on: the test cases of thesis 4.2.1,
errors by person, the energy score of draws; and the rivals that must be beaten on the same masks: the nearest
neighbour and ridge regression.

    windows = people("recordings", "val")
    judged(lambda motion, known: mine(motion, known), CASES["legs hidden"], windows)["cm"].mean()

What is known is said once, for every model and rival: bool (B, T, U) over the units of a frame, which are the joints'
rotations, then the root's place, then the contacts (``features.units``). The root's place goes with the pelvis.

Source: thesis 4.2.1 (cases). Gneiting and Raftery 2007, Eq. 22: the energy score, which rewards calibrated draws, as
the error of a single answer cannot. Ridge regression is the conditional mean of a Gaussian (Bishop 2006, 2.3 and 12.2):
with x = m + F z + noise, z ~ N(0, I), F of the training windows' principal parts, one F answers every mask:
z = (F_K^T F_K + w I)^-1 F_K^T (x_K - m_K).
Differs: numbers instead of looking.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Self

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from motionlab import corpus, splits
from motionlab.corpus import Take
from motionlab.diffusion.features import Layout, Normaliser, restore_known, units
from motionlab.diffusion.sampling import offset_decay
from motionlab.diffusion.windows import LEGS, gather, on_standard, spread
from motionlab.errors import DataError, ShapeError
from motionlab.heading import Frame, local_to_world, stuck_root, world_to_local
from motionlab.metrics import joint_errors, mean_acceleration, slide_where_truth_stands_mm
from motionlab.motion import Motion
from motionlab.skeleton import FEET, STANDARD

FRAMES, JOINTS = 60, len(STANDARD)  # of a window, of a figure
HIDDEN = tuple(name for name in STANDARD.names if name.endswith(LEGS))  # rotations that occluded legs lose
LOWER = tuple(name for name in HIDDEN if not name.endswith("hip"))  # joints whose places follow from them
#: Windows (B, T) and what is known of them (B, T, U) -> windows; only what is known may be read, and where a window
#: begins and faces.
Fill = Callable[[Motion, Tensor], Motion]


# -------------------------------------------------------------------------------------------------------- whose windows
class PersonWindows(NamedTuple):
    """motion (N, T) on the standard body, whose it is (N,), and which units (N, 1, U) of a frame its figure lacks."""

    motion: Motion
    whose: Tensor
    lacks: Tensor


def person_windows(takes: Sequence[Take], frames: int, each: int) -> PersonWindows:
    """At most ``each`` windows of every person, evenly over what there is; shorter takes are left out."""
    takes = [take for take in takes if take.motion.frames >= frames]
    if not takes:
        raise DataError(f"nobody has {frames} frames of motion", remedy="name a folder with more recordings")
    names = list(dict.fromkeys(take.person for take in takes))
    clip = torch.arange(len(takes)).repeat_interleave(torch.tensor([t.motion.frames - frames + 1 for t in takes]))
    whose = torch.tensor([names.index(take.person) for take in takes])[clip]
    some = torch.cat([spread((whose == person).nonzero()[:, 0], each) for person in range(len(names))])
    used = clip[some].unique()  # of the others nothing is asked
    data = gather([on_standard(takes[k].motion) for k in used], frames, mirrored=False)
    motion = data.cut(data.begins[torch.isin(clip, used).cumsum(0)[some] - 1])
    missing = torch.tensor([[name in take.missing for name in STANDARD.names] + [False, False] for take in takes])
    return PersonWindows(replace(motion, skeleton=STANDARD), whose[some], missing[clip[some], None])


def by_person(values: Tensor, whose: Tensor) -> Tensor:
    """The mean (P,) of values (N,) of each person; windows without a value do not count."""
    mine = one_hot(whose).double() * values.isfinite()[:, None]
    return (mine * values.nan_to_num().double()[:, None]).sum(0) / mine.sum(0)


def people(folder: Path | str, part: str, each: int = 24) -> PersonWindows:
    """Reads windows of the people of a part ("train", "val", "test"), at most so many of each."""
    return person_windows(corpus.assemble(folder, splits.real_sources(folder)).part(part), FRAMES, each)


# -------------------------------------------------------------------------------------------------------- what is known
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


@dataclass(frozen=True)
class Case:
    """A mask for so many windows, and the joints whose error counts (None: all)."""

    mask: Callable[[int], Tensor]
    joints: tuple[str, ...] | None = None


CASES: Mapping[str, Case] = {
    "legs hidden": Case(lambda n: legs(n, FRAMES), LOWER),
    "gap of 30 frames": Case(lambda n: gap(n, FRAMES, 30)),
    "gap of 45 frames": Case(lambda n: gap(n, FRAMES, 45)),
    "every 15th frame": Case(lambda n: keys(n, FRAMES, 15)),
    "half of the joints": Case(lambda n: whole_window(n, FRAMES, 0.5, torch.Generator().manual_seed(7))),
    "a quarter of the joints": Case(lambda n: whole_window(n, FRAMES, 0.25, torch.Generator().manual_seed(7))),
}


# ---------------------------------------------------------------------------------------------------------- how it went
def judged(
    fill: Fill, case: Case, windows: PersonWindows, *, show_missing: bool = False, draws: int = 1
) -> dict[str, Tensor]:
    """Computes by person (P,) what becomes of the windows: error in cm, sliding in mm a frame, acceleration over the
    truth's; in the mean over so many draws, and of several also their energy score and how far apart they are, in cm.

    Nobody is asked for a joint that a figure lacks: it stays as it came. show_missing: who fills in is told of it.
    """
    motion, whose, lacks = windows
    known = case.mask(len(motion.root))
    told = known if show_missing else known & ~lacks
    made = [restore_known(fill(motion, told), motion, known | lacks) for _ in range(draws)]
    found = {
        "cm": torch.stack([error_cm(m, motion, known, case.joints) for m in made]).mean(0),
        "slide": torch.stack([slide_mm(m, motion) for m in made]).mean(0),
        "acceleration": torch.stack([acceleration_ratio(m, motion) for m in made]).mean(0),
    }
    if draws > 1:
        found["score"] = energy_score(made, motion, known, case.joints)
        found["spread"] = 2 * (found["cm"] - found["score"])
    return {name: by_person(x, whose) for name, x in found.items()}


def energy_score(
    draws: Sequence[Motion], truth: Motion, known: Tensor, joints: tuple[str, ...] | None = None
) -> Tensor:
    """Computes the energy score (B,) in cm of several draws of windows: their mean error less half of their mean
    distance from each other. Of a single answer it is the error; less is better."""
    errors = torch.stack([error_cm(made, truth, known, joints) for made in draws]).mean(0)
    if len(draws) == 1:
        return errors
    pairs = [(a, b) for k, a in enumerate(draws) for b in draws[:k]]
    return errors - torch.stack([error_cm(a, b, known, joints) for a, b in pairs]).mean(0) / 2


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


def acceleration_ratio(made: Motion, truth: Motion) -> Tensor:
    """Mean size (B,) of the joints' accelerations over the truth's."""
    return mean_acceleration(made.positions, made.fps) / mean_acceleration(truth.positions, truth.fps)


def slide_mm(made: Motion, truth: Motion) -> Tensor:
    """mm per frame (B,) that foot joints move where the true ones stand; NaN where none stands."""
    feet = STANDARD.indices(FEET)
    return slide_where_truth_stands_mm(made.positions[..., feet, :], truth.positions[..., feet, :])


# --------------------------------------------------------------------------------------------------------------- rivals
RIDGES = (0.01, 0.1, 1.0, 10.0, 30.0, 100.0, 300.0, 1000.0)  # variances; the known numbers say much alike


@dataclass(frozen=True, eq=False)
class Rivals:
    """Training windows as rows (N, T D) of normalised numbers without contacts, in the stuck frame.

    mean (T D,); factor F (T D, K). ridge: the weight w.
    """

    layout: Layout
    normaliser: Normaliser
    rows: Tensor
    mean_row: Tensor
    factor: Tensor
    ridge: float = 10.0

    @classmethod
    def fit(cls, windows: Motion, generator: torch.Generator, *, parts: int = 384) -> Self:
        """Of windows (N, T) on the standard body. parts: K, at most."""
        layout = Layout("stuck", contacts=False)
        numbers = layout.encode(windows)
        normaliser = Normaliser.measure(numbers, layout)
        rows = normaliser.apply(numbers).flatten(1)
        mean = rows.mean(0)
        return cls(layout, normaliser, rows, mean, _principal(rows - mean, parts, generator))

    # finish: frames beside what is known over which the offset from it fades (``sampling.offset_decay``); 0: it jumps
    def nearest(
        self, motion: Motion, known: Tensor, finish: int = 0, *, rank: int = 0, clips: Tensor | None = None
    ) -> Motion:
        """The training window whose numbers are nearest where they are known; or, of the nearest of each of ``clips``
        (N,), the one behind ``rank`` nearer ones."""

        def find(x: Tensor, mask: Tensor) -> Tensor:
            weight = mask.to(x)
            apart = weight @ self.rows.square().mT - 2 * (weight * x) @ self.rows.mT
            for _ in range(rank):
                best = apart.argmin(-1)
                mine = clips == clips[best][:, None]
                apart = apart.masked_fill(mine, torch.inf)
            return self.rows[apart.argmin(-1)]

        return self._filled(motion, known, find, finish)

    def regression(
        self, motion: Motion, known: Tensor, finish: int = 0, generator: torch.Generator | None = None
    ) -> Motion:
        """Ridge regression of the hidden numbers on the known ones: one regression for each mask. generator: a draw of
        the Gaussian whose mean that is, without the noise about its principal parts."""

        def find(x: Tensor, mask: Tensor) -> Tensor:
            found = torch.empty_like(x)
            which, place = torch.unique(mask, dim=0, return_inverse=True)
            for row, seen in enumerate(which):
                mine = place == row
                z = self.explained(x[mine] - self.mean_row, seen.to(x) / self.ridge, generator)
                found[mine] = self.mean_row + z @ self.factor.mT
            return found

        return self._filled(motion, known, find, finish)

    def encode_in(self, frame: Frame, motion: Motion) -> Tensor:
        """Rows (B, T D) in a frame of reference that is given."""
        plain = replace(self.layout, frame="world")
        return self.normaliser.apply(plain.encode(world_to_local(frame, motion))).flatten(1)

    def explained(self, gap: Tensor, weight: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """z (B, K) of what lies off the mean (B, T D), by the weight (T D,) of each number: its mean, or a draw."""
        seen = self.factor * weight[:, None]
        half = torch.linalg.cholesky(self.factor.mT @ seen + torch.eye(self.factor.shape[1]))
        z = torch.cholesky_solve((gap @ seen).mT, half)
        if generator is not None:
            noise = torch.randn(z.shape, generator=generator).to(z)
            z = z + torch.linalg.solve_triangular(half.mT, noise, upper=True)
        return z.mT

    def _filled(
        self, motion: Motion, known: Tensor, find: Callable[[Tensor, Tensor], Tensor], finish: int = 0
    ) -> Motion:
        _, frame = stuck_root(motion)
        mask = known[..., units(self.layout)].flatten(1)
        x = torch.where(mask, self.encode_in(frame, motion), 0.0)
        rows = find(x, mask)
        if finish:
            windows = [rows_.unflatten(1, (motion.frames, -1)) for rows_ in (rows, x, mask.to(x))]
            rows = offset_decay(*windows, finish).flatten(1)
        return restore_known(self.decode_in(frame, torch.where(mask, x, rows), motion), motion, known)

    def decode_in(self, frame: Frame, x: Tensor, motion: Motion) -> Motion:
        """The motion of rows (B, T D) in a frame of reference, as long as another and at its rate."""
        numbers = self.normaliser.undo(x.unflatten(1, (motion.frames, -1)))
        return local_to_world(frame, self.layout.decode(numbers, motion.fps, STANDARD))


def _principal(rows: Tensor, parts: int, generator: torch.Generator) -> Tensor:
    """Computes a factor F (D, K), F F^T about the covariance of centred rows (N, D): K largest axes, times deviation.

    Source: Halko et al. 2011, randomised range finder with two power iterations.
    """
    parts = min(parts, len(rows) - 1, rows.shape[1])
    basis = rows.mT @ torch.randn(len(rows), min(parts + 16, *rows.shape), generator=generator)
    for _ in range(2):
        basis = rows.mT @ (rows @ torch.linalg.qr(basis).Q)
    basis = torch.linalg.qr(basis).Q
    values, axes = torch.linalg.eigh((rows @ basis).mT.cov(correction=0))
    return basis @ axes[:, -parts:] * values[-parts:].clamp(min=0).sqrt()
