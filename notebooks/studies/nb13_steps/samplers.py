"""Quality against steps: in how few evaluations of the network a sampler gives what a thousand give.

Source: thesis 4.2.5 (striding the 1000 steps); Nichol and Dhariwal 2021; DDIM (Song et al. 2021); DPM-Solver++ (Lu et
al. 2022) and UniPC (Zhao et al. 2023), both of diffusers; ``solvers.flow``, ours.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from motionlab.diffusion import sampling
from motionlab.diffusion.model import Trained
from motionlab.diffusion.sampling import NoiseSchedule
from motionlab.errors import ShapeError
from motionlab.metrics.gait import skating_ratio
from motionlab.metrics.generation import diversity, frechet, kid, precision_recall
from motionlab.motion import Motion
from motionlab.skeleton import BALLS
from studies.nb13_steps import solvers

See = Callable[[Motion], Tensor]  # windows (N, T) -> features (N, D)
#: Below this log of signal over noise (amplitudes) nothing is left of the signal: solvers in that logarithm begin here.
QUIETEST = -5.1
_MULTISTEP = "DPMSolverMultistepScheduler"
#: Samplers of diffusers: class and options.
SOLVERS: dict[str, tuple[str, dict[str, object]]] = {
    "DPM-Solver++": (_MULTISTEP, {"lambda_min_clipped": QUIETEST}),
    "DPM-Solver++ SDE": (_MULTISTEP, {"lambda_min_clipped": QUIETEST, "algorithm_type": "sde-dpmsolver++"}),
    "UniPC": ("UniPCMultistepScheduler", {}),
}
#: Ours, for models that know their data's spectrum (``diffusion.gaussian_guess``): steps of equal angles, and the flow.
SPECTRAL = ("SDE, equal angles", "whitened flow")
SAMPLERS = ("DDPM", "DDIM", *SOLVERS, *SPECTRAL)


def draw(
    model: Trained, sampler: str, steps: int, count: int, generator: torch.Generator, *, batch: int = 128
) -> Motion:
    """New motions (count, T) on the standard body in ``steps`` evaluations of the network per batch.

    Every sampler tells the network stamps of the process that it was trained on.

    Raises:
        ValueError: no such sampler, or more steps than the process has.
    """
    if sampler not in SAMPLERS:
        raise ValueError(f"sampler: expected one of {', '.join(SAMPLERS)}, got {sampler!r}")
    if not 1 <= steps <= len(model.schedule):
        raise ValueError(f"steps: expected 1 to {len(model.schedule)}, got {steps}")
    sizes = [min(batch, count - at) for at in range(0, count, batch)]
    how = model.denoiser, model.schedule
    spectrum = getattr(model.denoiser, "spectrum", None)
    rows = [walk(sampler, *how, model.noise(size, generator), steps, generator, spectrum) for size in sizes]
    return model.decode(torch.cat(rows).cpu())


def walk(
    sampler: str,
    denoise: sampling.DenoiseFunction,
    schedule: NoiseSchedule,
    x: Tensor,
    steps: int,
    generator: torch.Generator,
    spectrum: Tensor | None = None,
) -> Tensor:
    """From noise x (B, ...) to samples of x_0 by one of ``SAMPLERS``; ``schedule``: all that the denoiser knows.

    spectrum: power (T, D) of the data, for those of ``SPECTRAL``. Raises: ValueError: it is missing.
    """
    if sampler == "DDPM":
        return sampling.ddpm(denoise, schedule.respaced(steps), x, generator)
    if sampler == "DDIM":
        return sampling.ddim(denoise, schedule.respaced(steps), x)
    if sampler in SOLVERS:
        name, options = SOLVERS[sampler]
        return solvers.through(solvers.scheduler(name, schedule, **options), denoise, x, steps, generator)
    if spectrum is None:
        raise ValueError(f"{sampler}: only for a model that knows its data's spectrum")
    few = solvers.spaced(schedule, spectrum, steps)
    if "SDE" not in sampler:
        return solvers.flow(denoise, few, spectrum, x)
    solver = solvers.scheduler(_MULTISTEP, schedule, algorithm_type="sde-dpmsolver++")
    return solvers.through(solver, denoise, x, few.stamps.flip(0).tolist(), generator)


# ---------------------------------------------------------------------------------------------- how good they are
@dataclass(frozen=True, eq=False)
class Point:
    """Samples of one sampler in one number of steps, described.

    features (N, D): of a network or not, as ``embedding``. acceleration (N,): of the joints, m/s^2. skate (N,): share
    of frames in which a foot slides. seconds: that sampling took.
    """

    sampler: str
    steps: int
    features: Tensor
    acceleration: Tensor
    skate: Tensor
    seconds: float = float("nan")


def describe(motion: Motion, see: See, sampler: str = "data", steps: int = 0, seconds: float = float("nan")) -> Point:
    """What is measured of motions (N, T), made or real."""
    p, fps = motion.positions, motion.fps
    bend = (p.diff(n=2, dim=-3) * fps**2).norm(dim=-1).mean((-1, -2))
    slide = skating_ratio(p[..., motion.skeleton.indices(BALLS), :], fps)
    return Point(sampler, steps, see(motion), bend, slide, seconds)


def point(
    model: Trained, see: See, sampler: str, steps: int, count: int, generator: torch.Generator, *, batch: int = 128
) -> Point:
    """:func:`draw`, then :func:`describe`."""
    if sampler not in ("DDPM", "DDIM"):
        solvers.scheduler(_MULTISTEP, model.schedule)  # diffusers is slow to import: that is not the sampler's time
    start = time.perf_counter()
    motion = draw(model, sampler, steps, count, generator, batch=batch)
    return describe(motion, see, sampler, steps, time.perf_counter() - start)


def row(at: Point, data: Point, generator: torch.Generator) -> dict[str, object]:
    """The measures of a point against those of real windows, for a table; the name of a measure holds its unit."""
    distance = kid(at.features, data.features, generator)
    drawn = torch.randperm(len(data.features), generator=generator)[: len(at.features)]  # equal n; data lie by source
    found = precision_recall(at.features, data.features[drawn])
    return {
        "sampler": at.sampler,
        "steps": at.steps,
        "KID": distance.value,
        "Frechet": frechet(at.features, data.features).value,
        "precision": found.precision,
        "recall": found.recall,
        "diversity / data's": diversity(at.features).value / diversity(data.features).value,
        "acceleration / data's": (at.acceleration.mean() / data.acceleration.mean()).item(),
        "skating frames, %": 100 * at.skate.mean().item(),
    }


def contributions(x: Tensor, y: Tensor) -> Tensor:
    """What each sample (N, D) adds to the kernel distance to real windows (M, D): (N,), whose mean is that distance.

    Jackknife pseudo-values, so that their spread is the estimate's: n KID - (n - 1) KID without the sample. The real
    windows are taken as given.

    Source: Efron and Stein 1981; ``metrics.generation.kid`` for the distance.
    Raises:
        ShapeError: fewer than three samples.
    """
    x, y = x.double(), y.double()
    n, m = len(x), len(y)
    if n < 3 or m < 2:
        raise ShapeError(f"contributions: expected three samples and two real ones or more, got {n} and {m}")
    mine, theirs, between = (((a @ b.mT) / a.shape[1] + 1) ** 3 for a, b in ((x, x), (y, y), (x, y)))
    others = (mine.sum(1) - mine.diagonal()) / (n - 1)
    within = (2 * (n - 1) * others - n * others.mean()) / (n - 2)
    real = (theirs.sum() - theirs.trace()) / (m * (m - 1))
    return within - 2 * between.mean(1) + real


def told_apart(x: Tensor, y: Tensor, neighbours: int = 5) -> Tensor:
    """Whether the nearest others of each of two sets (N, D) together tell which it is of: (2 N,), 1 where they do.

    The sets have no common noise; a coin is right in half of them. Sets of one size, so that neither is nearer by
    being larger.

    Source: the classifier two-sample test (Lopez-Paz and Oquab 2017) with nearest neighbours.
    Raises:
        ShapeError: sets of two sizes, or no more samples than neighbours.
    """
    if x.shape != y.shape or 2 * len(x) <= neighbours:
        raise ShapeError(f"told_apart: expected two sets of one size, got {tuple(x.shape)} and {tuple(y.shape)}")
    z, label = torch.cat((x, y)).double(), torch.arange(2 * len(x)) >= len(x)
    distance = torch.cdist(z, z).fill_diagonal_(torch.inf)
    votes = label[distance.topk(neighbours, largest=False).indices].double().mean(1) > 0.5
    return (votes == label).double()


def best(points: Sequence[Point], data: Point, most: int) -> Point:
    """The point of at most so many steps whose kernel distance to real windows is least.

    Raises:
        ValueError: no point has so few steps.
    """
    few = [p for p in points if p.steps <= most]
    if not few:
        raise ValueError(f"points: none has {most} steps or fewer")
    return min(few, key=lambda p: contributions(p.features, data.features).mean().item())


# --------------------------------------------------------------------------------------------------- how long
def seconds(
    model: Trained, sampler: str, steps: int, generator: torch.Generator, *, batch: int = 1, repeats: int = 5
) -> Tensor:
    """Wall time (repeats,) of ``batch`` motions together, decoded; one short run goes before."""
    draw(model, sampler, min(steps, 3), batch, generator, batch=batch)
    found = []
    for _ in range(repeats):
        start = time.perf_counter()
        draw(model, sampler, steps, batch, generator, batch=batch)
        found.append(time.perf_counter() - start)
    return torch.tensor(found, dtype=torch.float64)
