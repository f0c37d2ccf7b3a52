"""Judges whoever completes motions, on windows of people: cases, errors by person, the energy score of draws; and the
rivals that must be beaten on the same masks: the nearest neighbour, ridge regression, filters.

    windows = people("recordings", "val")
    judged(lambda motion, known: mine(motion, known), CASES["legs hidden"], windows)["cm"].mean()

Source: thesis 4.2.1 (cases). Gneiting and Raftery 2007, Eq. 22: the energy score, which rewards calibrated draws, as
the error of a single answer cannot. Ridge regression is the conditional mean of a Gaussian (Bishop 2006, 2.3 and 12.2):
with x = m + F z + noise, z ~ N(0, I), F of the training windows' principal parts, one F answers every mask:
z = (F_K^T F_K + w I)^-1 F_K^T (x_K - m_K).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from motionlab import baselines, corpus, splits
from motionlab.bench import cases
from motionlab.bench.cases import PersonWindows, by_person, chosen, person_windows, restore_known
from motionlab.diffusion.features import UNITS, Layout, Normaliser, units
from motionlab.diffusion.inpainting import offset_decay
from motionlab.errors import ShapeError
from motionlab.heading import Frame, local_to_world, stuck_root, world_to_local
from motionlab.motion import Motion
from motionlab.skeleton import STANDARD

RIDGES = (0.01, 0.1, 1.0, 10.0, 30.0, 100.0, 300.0, 1000.0)  # variances; the known numbers say much alike
FILTERS: Mapping[str, tuple[Callable, Mapping[str, Sequence]]] = {
    "Savitzky-Golay": (
        lambda x, fps, **settings: baselines.savitzky_golay(x, **settings),
        {"window": (5, 7, 9, 13, 17, 21), "degree": (2, 3)},
    ),
    "one euro": (baselines.one_euro, {"min_cutoff": (0.5, 1.0, 2.0, 4.0, 8.0), "beta": (0.0, 1.0, 4.0)}),
    "Kalman smoother": (  # only their ratio matters
        baselines.kalman, {"noise": (1.0,), "acceleration": (3.0, 10.0, 30.0, 100.0, 300.0)}
    ),
}  # fmt: skip
FRAMES = 60  # of a window
#: Windows (B, T) and what is known of them (B, T, U) -> windows; only what is known may be read, and where a window
#: begins and faces.
Fill = Callable[[Motion, Tensor], Motion]


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

    # ----------------------------------------------------------------------------------------- fill what is hidden
    # finish: frames beside what is known over which the offset from it fades (``inpainting.offset_decay``); 0: it jumps
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
                z = self._explained(x[mine] - self.mean_row, seen.to(x) / self.ridge, generator)
                found[mine] = self.mean_row + z @ self.factor.mT
            return found

        return self._filled(motion, known, find, finish)

    def tuned(self, truth: Motion, known: Tensor, joints: tuple[str, ...] | None = None) -> Self:
        """With the ridge that leaves ``regression`` the least joint error on windows that settings are chosen on."""
        best = chosen(RIDGES, lambda w: replace(self, ridge=w).regression(truth, known), truth, known, joints)
        return replace(self, ridge=best)

    # ------------------------------------------------------------------------------------------------- take noise away
    def wiener(self, motion: Motion, rough: Motion, turn: float, shift: float) -> Motion:
        """The Gaussian's best guess of a motion (B, T) whose joints were turned at random and whose root was shifted.

        rough: about the same motion, less noisy at its first frame, which the frame of reference is taken from.
        turn: radians about each axis; shift: metres along each axis; both as standard deviations.
        """
        frame = stuck_root(rough)[1]
        x = self.encode_in(frame, motion)
        weight = self.ridge + noise_size(self.layout, self.normaliser, turn, shift).square()
        z = self._explained(x - self.mean_row, (1 / weight).repeat(motion.frames))
        return self._decoded(self.mean_row + z @ self.factor.mT, motion, frame)

    def encode_in(self, frame: Frame, motion: Motion) -> Tensor:
        """Rows (B, T D) in a frame of reference that is given."""
        plain = replace(self.layout, frame="world")
        return self.normaliser.apply(plain.encode(world_to_local(frame, motion))).flatten(1)

    def _explained(self, gap: Tensor, weight: Tensor, generator: torch.Generator | None = None) -> Tensor:
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
        if known.shape != (*motion.root.shape[:2], UNITS):
            raise ShapeError(f"known: expected {(*motion.root.shape[:2], UNITS)}, got {tuple(known.shape)}")
        _, frame = stuck_root(motion)
        mask = known[..., units(self.layout)].flatten(1)
        x = torch.where(mask, self.encode_in(frame, motion), 0.0)
        rows = find(x, mask)
        if finish:
            windows = [rows_.unflatten(1, (motion.frames, -1)) for rows_ in (rows, x, mask.to(x))]
            rows = offset_decay(*windows, finish).flatten(1)
        return restore_known(self._decoded(torch.where(mask, x, rows), motion, frame), motion, known)

    def _decoded(self, x: Tensor, motion: Motion, frame: Frame) -> Motion:
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


# ------------------------------------------------------------------------------------------------------- filters
def filtered(motion: Motion, name: str, **settings: float) -> Motion:
    """A motion through one of ``FILTERS``: rotations in radians about their mean, the root in metres.

    The Kalman smoother's strength of acceleration is per unit of noise.
    """
    apply, _ = FILTERS[name]
    return baselines.smooth(motion, lambda x: apply(x, motion.fps, **settings))


def tune(name: str, noisy: Motion, truth: Motion) -> dict[str, float]:
    """The settings of a filter that leave the least joint error on windows that settings are chosen on."""
    _, grid = FILTERS[name]
    options = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
    return chosen(options, lambda settings: filtered(noisy, name, **settings), truth)


def noise_size(layout: Layout, normaliser: Normaliser, turn: float, shift: float) -> Tensor:
    """Computes the deviation (D,) of each normalised number from noise of ``turn`` radians about each axis of a joint
    and ``shift`` metres: a turned column of length 1 moves by sqrt(2 / 3) turn in each coordinate."""
    size = torch.zeros(layout.size)
    for name, part in layout.slices.items():
        size[part] = {"root": shift, "orient": (2 / 3) ** 0.5 * turn, "pose": (2 / 3) ** 0.5 * turn}.get(name, 0.0)
    return size / normaliser.scale


@dataclass(frozen=True)
class Case:
    """A mask for so many windows, the joints whose error counts (None: all), and whether it has edges in time."""

    mask: Callable[[int], Tensor]
    joints: tuple[str, ...] | None = None
    edges: bool = False


def _joints(count: int, share: float) -> Tensor:
    return cases.whole_window(count, FRAMES, share, torch.Generator().manual_seed(7))


CASES: Mapping[str, Case] = {
    "legs hidden": Case(lambda n: cases.legs(n, FRAMES), cases.LOWER),
    "gap of 30 frames": Case(lambda n: cases.gap(n, FRAMES, 30), edges=True),
    "gap of 45 frames": Case(lambda n: cases.gap(n, FRAMES, 45), edges=True),
    "every 15th frame": Case(lambda n: cases.keys(n, FRAMES, 15), edges=True),
    "half of the joints": Case(partial(_joints, share=0.5)),
    "a quarter of the joints": Case(partial(_joints, share=0.25)),
}


def people(folder: Path | str, part: str, each: int = 24) -> PersonWindows:
    """Reads windows of the people of a part ("train", "val", "test"), at most so many of each."""
    return person_windows(corpus.assemble(folder, splits.real_sources(folder)).part(part), FRAMES, each)


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
    made = [cases.restore_known(fill(motion, told), motion, known | lacks) for _ in range(draws)]
    rows = {
        "cm": [cases.error_cm(m, motion, known, case.joints) for m in made],
        "slide": [cases.slide_mm(m, motion) for m in made],
        "acceleration": [cases.acceleration_ratio(m, motion) for m in made],
    }
    found = {name: torch.stack(each).mean(0) for name, each in rows.items()}
    if draws > 1:
        found["score"] = energy_score(made, motion, known, case.joints)
        found["spread"] = 2 * (found["cm"] - found["score"])
    return {name: by_person(x, whose) for name, x in found.items()}


def energy_score(
    draws: Sequence[Motion], truth: Motion, known: Tensor, joints: tuple[str, ...] | None = None
) -> Tensor:
    """Computes the energy score (B,) in cm of several draws of windows: their mean error less half of their mean
    distance from each other. Of a single answer it is the error; less is better."""
    errors = torch.stack([cases.error_cm(made, truth, known, joints) for made in draws]).mean(0)
    if len(draws) == 1:
        return errors
    pairs = [(a, b) for k, a in enumerate(draws) for b in draws[:k]]
    apart = torch.stack([cases.error_cm(a, b, known, joints) for a, b in pairs]).mean(0)
    return errors - apart / 2
