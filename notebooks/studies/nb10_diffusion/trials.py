"""What notebook 10 measures: how well x_0 is guessed, how samples compare with motion, and inpainting by Eq. 4.10.

Models are compared on the same windows with the same noise: give every one a fresh generator of the same seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from motionlab import rotation
from motionlab.diffusion import masks
from motionlab.diffusion.embedding import kid_judge
from motionlab.diffusion.gaussian_guess import Spectral
from motionlab.diffusion.inpainting import Way, fill
from motionlab.diffusion.model import LEVELS, DenoiserRecipe, Trained
from motionlab.diffusion.planting import planted
from motionlab.diffusion.sampling import noise_like
from motionlab.diffusion.training import DenoiserTraining, held_errors
from motionlab.diffusion.windows import Windows
from motionlab.heading import stuck_root
from motionlab.metrics import generation
from motionlab.metrics.gait import skating_ratio, slide_in_contact_mm
from motionlab.metrics.pose import mean_acceleration
from motionlab.motion import Motion, joined, mirror
from motionlab.skeleton import BALLS, FEET

KINDS = ("legs", "joints", "gap", "frames", "entries")  # of masks, those of ``masks`` without "nothing"


# ------------------------------------------------------------------------------------------------ the guess of x_0
@torch.no_grad()
def guesses(
    model: Trained, motion: Motion, generator: torch.Generator, levels: Sequence[float] = LEVELS
) -> dict[str, Tensor]:
    """Errors (B, L) of the estimate of x_0 of windows (B, T) at so many levels of noise (shares of the steps).

    x0: mean square of normalised numbers; 1 is a guess of the training mean. joints: mean distance, mm, in the first
    frame's frame. velocity: mean size of the error of the joints' velocity, m/s.
    """
    x0, last = model.encode(motion), len(model.schedule) - 1
    truth = model.decode(x0).positions
    rows: dict[str, list[Tensor]] = {"x0": [], "joints": [], "velocity": []}
    for share in levels:
        t = torch.full((len(x0),), round(share * last))
        xt = model.schedule.noised(x0, t, noise_like(x0, generator))
        said = model.denoiser(xt, model.schedule.stamps[t])
        off = model.decode(said).positions - truth
        rows["x0"].append((said - x0).square().mean((1, 2)))
        rows["joints"].append(1000 * off.norm(dim=-1).mean((1, 2)))
        rows["velocity"].append((off.diff(dim=1) * motion.fps).norm(dim=-1).mean((1, 2)))
    return {name: torch.stack(columns, -1) for name, columns in rows.items()}


# --------------------------------------------------------------------------------------------- motion and no motion
def pooled(found: Mapping[str, Motion], minutes: Mapping[str, float], count: int) -> Motion:
    """About ``count`` windows of all sources, each by its share of the minutes, every second one in the mirror."""
    whole = sum(minutes[name] for name in found)
    parts = [_spread(motion, max(2, round(count * minutes[name] / whole))) for name, motion in found.items()]
    return joined([joined([part.clip(slice(0, None, 2)), mirror(part.clip(slice(1, None, 2)))]) for part in parts])


def _spread(motion: Motion, count: int) -> Motion:
    count = min(count, len(motion.root))
    return motion.clip(torch.linspace(0, len(motion.root) - 1, count).round().long())


def trivial(model: Trained, motion: Motion, count: int, generator: torch.Generator) -> dict[str, Motion]:
    """Generators that know little, ``count`` windows each, from training windows (N, T).

    a pose held: any frame, for the whole window. two averaged: half-way between two windows. Gaussian: independent
    numbers with the spectrum of the training data; without a network that is what the preconditioned model knows.
    """
    local, _ = stuck_root(motion)
    first, second = (torch.randint(len(motion.root), (count,), generator=generator) for _ in range(2))
    at = torch.randint(motion.frames, (count,), generator=generator)
    a, b = local.clip(first), local.clip(second)

    def held(x: Tensor) -> Tensor:
        return x[torch.arange(count), at][:, None].expand_as(x)

    half = torch.tensor(0.5, dtype=a.rot.dtype)
    found = {
        "a pose held": replace(a, root=held(a.root), rot=held(a.rot), contacts=None),
        "two averaged": replace(a, root=(a.root + b.root) / 2, rot=rotation.slerp(a.rot, b.rot, half), contacts=None),
    }
    if isinstance(model.denoiser, Spectral):
        x = model.denoiser.spectrum.sqrt() * model.noise(count, generator)
        found["Gaussian"] = model.decode(model.denoiser.cosines.T @ x)
    return found


def physics(motion: Motion) -> dict[str, Tensor]:
    """How windows (N, T) move, (N,) each: skating ratio (%), slide per frame of the feet whose contact is labelled (mm;
    NaN where none is), mean acceleration of the joints (m/s^2) and their speed (m/s)."""
    p, skeleton = motion.positions, motion.skeleton
    found = {"skating, %": 100 * skating_ratio(p[..., skeleton.indices(BALLS), :], motion.fps)}
    if motion.contacts is not None:
        label = motion.contacts[..., [skeleton.contact_names.index(name) for name in FEET]]
        found["slide in contact, mm/frame"] = slide_in_contact_mm(p[..., skeleton.indices(FEET), :], label)
    found["acceleration, m/s^2"] = mean_acceleration(p, motion.fps)
    found["speed, m/s"] = (p.diff(dim=1) * motion.fps).norm(dim=-1).mean((1, 2))
    return found


def rests(
    model: Trained, real: Motion, shares: Sequence[float], count: int, generator: torch.Generator, *, steps: int
) -> list[dict[str, float]]:
    """How samples move when a last share of ``steps`` is not walked (``Trained.sample``), from the same noise each.

    Skating ratio and acceleration of ``count`` samples with planted feet over those of real windows (N, T).
    """

    def move(motion: Motion) -> tuple[Tensor, Tensor]:
        row = physics(motion)
        return row["skating, %"].nanmean(), row["acceleration, m/s^2"].nanmean()

    (skate, quick), begin, rows = move(real), generator.get_state(), []
    for share in shares:
        generator.set_state(begin)
        made = move(planted(model.sample(count, generator, steps=steps, rest=share), slow=False))
        rows.append(
            {"not walked": share, "skating": (made[0] / skate).item(), "acceleration": (made[1] / quick).item()}
        )
    return rows


def distances(made: Tensor, real: Tensor, generator: torch.Generator) -> dict[str, float]:
    """Features of samples (N, D) against those of real windows (M, D): as many of each, drawn from the larger set."""
    n = min(len(made), len(real))
    made, real = (x[torch.randperm(len(x), generator=generator)[:n]] for x in (made, real))
    near, crowd = generation.precision_recall(made, real), generation.density_coverage(made, real)
    return {
        "KID": generation.kid(made, real, generator).value,
        "Frechet": generation.frechet(made, real).value,
        "precision": near.precision,
        "recall": near.recall,
        "density": crowd.density,
        "coverage": crowd.coverage,
        "diversity": generation.diversity(made).value,
    }


def to_others(x: Tensor) -> Tensor:
    """Mean distance (N,) of each row of features (N, D) to all others."""
    return torch.cdist(x, x).sum(1) / (len(x) - 1)


# ------------------------------------------------------------------------------------------------------- inpainting
def inpainted(
    model: Trained, motion: Motion, kind: str, generator: torch.Generator, *, samples: int = 4, steps: int = 50
) -> dict[str, Tensor]:
    """Windows (B, T) whose unknown part is made by Eq. 4.10, with masks of one kind (``masks.draw``); (B,) each.

    known: largest difference of a known number from what was given. Mean square errors of the unknown numbers,
    normalised: "one sample" and "mean of samples", "unconditional sample", which was never told, and "training mean".
    """
    x0 = model.encode(motion)
    known = masks.draw(model.layout, motion.frames, len(x0), generator, {kind: 1.0})
    known = known & ~known.all((1, 2), keepdim=True)  # where nothing is asked everything is
    way = Way(put="overwrite", steps=steps)  # Eq. 4.10
    made = torch.stack([fill(model, x0, known, generator, way) for _ in range(samples)])
    free = fill(model, x0, torch.zeros_like(known), generator, replace(way, put="nothing"))
    asked = (~known).sum((1, 2))

    def error(x: Tensor) -> Tensor:
        return ((x - x0).square() * ~known).sum((1, 2)) / asked

    return {
        "known": ((made - x0).abs() * known).amax((0, 2, 3)),
        "known, unconditional": ((free - x0).abs() * known).amax((1, 2)),
        "one sample": error(made[0]),
        "mean of samples": error(made.mean(0)),
        "unconditional sample": error(free),
        "training mean": error(torch.zeros_like(x0)),
    }


# --------------------------------------------------------------------------------------------------- when to stop
def stopped(
    recipe: DenoiserRecipe, windows: Windows, held: Motion, *, every: int, judged: int = 128, steps: int = 25
) -> tuple[dict[str, Trained], list[dict]]:
    """Train to the end; the weights of the least KID on held-out windows (thesis 4.4.1) and the last, and the curve."""
    run = DenoiserTraining(recipe, windows)
    judge = kid_judge(held, count=judged, steps=steps)
    run.run(validate=held_errors(held), judge=judge, every=every, judge_every=every)
    return {"least KID": run.shipped, "last": run.averaged}, run.curve
