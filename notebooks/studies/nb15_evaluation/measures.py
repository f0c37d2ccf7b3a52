"""How good generated windows are beside real ones, in one call: every number with its sizes, its floor, its spread.

Source: the open point of thesis 4.4.3. Measures: ``metrics.generation``, ``metrics.gait``; features:
``embedding``. Whether they are copies: ``copies``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.diffusion.embedding import Features
from motionlab.diffusion.model import Trained
from motionlab.diffusion.planting import planted
from motionlab.diffusion.windows import Windows
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.metrics import generation
from motionlab.metrics.gait import skating_ratio
from motionlab.motion import Motion, mirror
from motionlab.skeleton import BALLS, STANDARD
from studies.nb15_evaluation.trivial import Generate

#: What :func:`score` measures and when it is good; frechet and kid in squared units of the features.
MEASURES = {
    "frechet": "low", "kid": "0", "precision": "high", "recall": "high", "density": "1", "coverage": "high",
    "diversity ratio": "1", "skate ratio": "1", "acceleration ratio": "1",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Judged:
    """What is measured of windows, once: latent (N, D) features; skate (N,): share of frames in which a foot slides;
    acceleration (N,): mean of the joints' m/s^2."""

    latent: Tensor
    skate: Tensor
    acceleration: Tensor

    def some(self, rows: Tensor) -> Judged:
        """Those rows."""
        return Judged(self.latent[rows], self.skate[rows], self.acceleration[rows])

    def __len__(self) -> int:
        return len(self.latent)


def judged(motion: Motion, features: Features) -> Judged:
    """Measure windows (N, T) on the standard joints, feet on a floor at z = 0.

    Raises:
        DataError: a window is not finite. ShapeError: not windows as the features take them.
    """
    if not (motion.root.isfinite().all() and motion.rot.isfinite().all()):
        raise DataError("a window is not finite", place=motion.name, remedy="leave it out and count it as a failure")
    points, fps = motion.positions, motion.fps
    bent = points.diff(n=2, dim=-3).norm(dim=-1).mean((-1, -2)) * fps**2
    return Judged(features(motion), skating_ratio(points[..., motion.skeleton.indices(BALLS), :], fps), bent)


def score(
    made: Motion | Judged, real: Motion | Judged, features: Features, generator: torch.Generator
) -> dict[str, float]:
    """Every measure of ``MEASURES`` of generated windows against real ones, and the numbers that ratios are made of.

    n, m: windows on either side. Precision, recall, density and coverage change with them: they are taken from the
    first min(n, m) rows of both in an order that ``generator`` draws. skate: share of frames. acceleration: m/s^2.
    """
    x, y = (z if isinstance(z, Judged) else judged(z, features) for z in (made, real))
    least = min(len(x), len(y))
    a, b = (z.latent[torch.randperm(len(z), generator=generator)[:least]] for z in (x, y))
    on, around = generation.precision_recall(a, b), generation.density_coverage(a, b)
    variety, natural = (generation.diversity(z).value for z in (a, b))
    row = {
        "frechet": generation.frechet(x.latent, y.latent).value,
        "kid": generation.kid(x.latent, y.latent, generator).value,
        "precision": on.precision,
        "recall": on.recall,
        "density": around.density,
        "coverage": around.coverage,
        "diversity ratio": variety / natural,
        "skate ratio": _over(x.skate, y.skate),
        "acceleration ratio": _over(x.acceleration, y.acceleration),
    }
    means = {"skate": x.skate, "skate, real": y.skate, "acceleration": x.acceleration}
    means |= {"acceleration, real": y.acceleration}
    return row | {k: v.mean().item() for k, v in means.items()} | {"n": len(x), "m": len(y)}


def _over(x: Tensor, y: Tensor) -> float:
    """Mean over mean; 1 where both are nothing, infinite where only the second is."""
    top, below = x.mean().item(), y.mean().item()
    return top / below if below > 0 else (1.0 if top == 0 else float("inf"))


def spread(
    made: Judged, real: Judged, features: Features, generator: torch.Generator, draws: int = 20
) -> dict[str, float]:
    """Standard error of each measure of :func:`score`, from random halves of both sets without replacement.

    The variance between halves of a set is about that of the whole set's estimate (Shao and Wu 1989, the delete-d
    jackknife with d = n / 2). A bootstrap would draw windows twice, which these measures take for a lack of variety.
    """
    if min(len(made), len(real)) < 16 or draws < 2:
        raise ShapeError(f"needs 16 windows a side and 2 draws, got {len(made)}, {len(real)} and {draws}")
    rows = []
    for _ in range(draws):
        halves = [z.some(torch.randperm(len(z), generator=generator)[: len(z) // 2]) for z in (made, real)]
        rows.append(score(*halves, features, generator))
    return {name: torch.tensor([row[name] for row in rows]).std().item() for name in MEASURES}


def together(rows: Sequence[Mapping[str, float]], errors: Sequence[Mapping[str, float]] = ()) -> dict[str, str]:
    """One table row of several seeds' scores: mean, and deviation over the seeds (and the mean error of sampling)."""
    found = {}
    for name in MEASURES:
        values = torch.tensor([row[name] for row in rows], dtype=torch.float64)
        text = f"{values.mean():.3g}"
        if len(rows) > 1:
            text += f" ± {rough(values.std().item())}"
        if errors:
            text += f" ({rough(sum(e[name] for e in errors) / len(errors))})"
        found[name] = text
    sizes = sorted({(int(row["n"]), int(row["m"])) for row in rows})
    return found | {"n / m": ", ".join(f"{n} / {m}" for n, m in sizes), "seeds": len(rows)}


@dataclass(frozen=True, eq=False)
class Trial:
    """One generator, drawn from with several seeds, n windows each.

    rows: real set -> one :func:`score` per seed. errors: real set -> :func:`spread` of the first seed. first: Motion of
    the first seed's windows. sets: what was measured of them all.
    """

    rows: dict[str, list[dict[str, float]]]
    errors: dict[str, dict[str, float]]
    first: Motion
    sets: list[Judged]


def trial(
    generate: Generate,
    count: int,
    generators: Sequence[torch.Generator],
    real: Mapping[str, Judged],
    features: Features,
    *,
    draws: int = 20,
) -> Trial:
    """Draw ``count`` windows with each generator and score them against every real set."""
    drawn, first = [], None
    for generator in generators:
        motion = replace(generate(count, generator), contacts=None)
        drawn.append(judged(motion, features))
        first = first or replace(motion)  # a copy, without the joint positions that the other keeps
    rows = {k: [score(x, y, features, g) for x, g in zip(drawn, generators, strict=True)] for k, y in real.items()}
    errors = {k: spread(drawn[0], y, features, generators[0], draws) for k, y in real.items()}
    return Trial(rows, errors, first, drawn)


def sampler(model: Trained, steps: int, *, rest: float = 0.0) -> Generate:
    """A trained model as a generator: DDPM in so many steps. rest: see ``Trained.sample``."""
    return lambda count, generator: model.sample(count, generator, steps=steps, rest=rest)


def on_its_feet(generate: Generate) -> Generate:
    """A generator of motions with contacts, its feet ``planted`` where they say so."""
    return lambda count, generator: planted(generate(count, generator), slow=False)


def rough(x: float) -> str:
    """One digit of a number, as errors are read: 0.04, 30; 0 for what rounding left, a dash for what is not finite."""
    if not math.isfinite(x):
        return "-"
    return f"{float(f'{x:.1g}'):g}" if abs(x) > 1e-9 else "0"


# ------------------------------------------------------------------------------------------ real motion, and spoilt
def grouped(windows: Windows, count: int) -> tuple[Motion, Tensor]:
    """Windows (count, T) evenly over all, on the standard body, and the motion (count,) that each was cut from."""
    count = min(count, len(windows.begins))
    at = torch.linspace(0, len(windows.begins) - 1, count).round().long()
    return replace(windows.evenly(count), skeleton=STANDARD), windows.clip[windows.begins[at]]


def spoilt(motion: Motion, generator: torch.Generator) -> dict[str, Motion]:
    """Real windows with one fault each, which features must see, and mirrored ones, which are as real as before.

    slid: the whole body drifts 20 cm/s over the floor in a random direction. trembling: every joint turns by 2 degrees
    at random in every frame. frozen: the first frame throughout. backwards: in time. swapped: the legs of the next
    window.
    """
    count, frames, joints = motion.rot.shape[:3]
    way = torch.rand(count, generator=generator) * 2 * torch.pi
    drift = 0.2 * torch.arange(frames) / motion.fps
    path = torch.stack((drift * way.cos()[:, None], drift * way.sin()[:, None], 0 * drift * way[:, None]), -1)
    tremble = rotation.exp(torch.randn(count, frames, joints, 3, generator=generator) * torch.pi / 90)
    legs = [j for j, name in enumerate(STANDARD.names) if name.endswith(("hip", "knee", "ankle", "foot"))]
    swapped = motion.rot.clone()
    swapped[:, :, legs] = motion.rot.roll(1, 0)[:, :, legs]
    bare = replace(motion, contacts=None)
    return {
        "slid 20 cm/s": replace(bare, root=motion.root + path.to(motion.root)),
        "trembling 2 degrees": replace(bare, rot=motion.rot @ tremble.to(motion.rot)),
        "frozen": replace(
            bare, root=motion.root[:, :1].expand_as(motion.root), rot=motion.rot[:, :1].expand_as(motion.rot)
        ),
        "backwards": replace(bare, root=motion.root.flip(1), rot=motion.rot.flip(1)),
        "legs of another": replace(bare, rot=swapped),
        "mirrored": replace(mirror(motion), contacts=None),
    }


def seen(motion: Motion, features: Features, generator: torch.Generator, draws: int = 5) -> dict[str, Tensor]:
    """How far off the features find each fault of :func:`spoilt`: fault -> (draws,).

    Frechet distance of one half of the windows, spoilt, to the other half as it is, over that of the same halves both
    as they are; "as they are": that floor itself, in squared units of the features.
    """
    plain, faults = judged(motion, features), spoilt(motion, generator)
    wrong = {name: judged(m, features).latent for name, m in faults.items()}
    found: dict[str, list[float]] = {name: [] for name in ("as they are", *wrong)}
    for _ in range(draws):
        order = torch.randperm(len(plain), generator=generator)
        one, other = order[: len(order) // 2], order[len(order) // 2 :]
        floor = generation.frechet(plain.latent[one], plain.latent[other]).value
        found["as they are"].append(floor)
        for name, latent in wrong.items():
            found[name].append(generation.frechet(latent[one], plain.latent[other]).value / floor)
    return {name: torch.tensor(values, dtype=torch.float64) for name, values in found.items()}


# --------------------------------------------------------------------------------------- what sampling alone gives
def frechet_by_n(
    generated: Tensor, real: Tensor, sizes: Sequence[int], generator: torch.Generator, draws: int = 10
) -> list[generation.Score]:
    """Frechet distances of random subsets of each size, both sets alike: mean and spread; how much of it is small N.

    Raises:
        ShapeError: a size is below 2 or above a set, or as for :func:`frechet`.
    """
    if not all(2 <= size <= min(len(generated), len(real)) for size in sizes) or draws < 1:
        raise ShapeError(f"sizes {list(sizes)}: expected 2 to {min(len(generated), len(real))}, and draws above zero")
    scores = []
    for size in sizes:
        found = []
        for _ in range(draws):
            some = [z[torch.randperm(len(z), generator=generator)[:size]] for z in (generated, real)]
            found.append(generation.frechet(*some).value)
        values = torch.tensor(found, dtype=torch.float64)
        scores.append(generation.Score(values.mean().item(), size, size, values.std(correction=0).item()))
    return scores


class Floor(NamedTuple):
    """A measure between halves of one real set."""

    values: Tensor  #: (draws,)
    n: Tensor  #: (draws,) samples in the half that stood for the generated set
    m: Tensor  #: (draws,) samples in the other


def score_floor(
    x: Tensor,
    groups: Tensor,
    measure: Callable[[Tensor, Tensor], float],
    generator: torch.Generator,
    draws: int = 20,
) -> Floor:
    """Computes ``measure`` between random halves of one real set (N, D), split by group: the least to be expected.

    groups (N,): the recording, or better the person, of each sample; one group never stands on both sides, as
    windows of one recording are alike. Halves are smaller than the whole: a measure that depends on N (FID) must be
    compared at the floor's n and m.

    Raises:
        ShapeError: fewer than two groups, groups that do not fit, or no draw.
    """
    x = x.double()
    check_shape(groups, f"{len(x)}", "groups")
    names = groups.unique()
    if len(names) < 2 or draws < 1:
        raise ShapeError(f"floor: needs at least two groups and one draw, got {len(names)} and {draws}")
    values, sizes = [], []
    for _ in range(draws):
        mine = torch.isin(groups, names[torch.randperm(len(names), generator=generator)[: len(names) // 2]])
        values.append(float(measure(x[mine], x[~mine])))
        sizes.append(int(mine.sum()))
    n = torch.tensor(sizes)
    return Floor(torch.tensor(values, dtype=torch.float64), n, len(x) - n)
