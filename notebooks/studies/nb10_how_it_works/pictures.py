"""The figures of notebook 10: noise on a motion, what the network makes of it, the misprint, what each loss is for."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from motionlab.diffusion.model import MotionDiffusion
from motionlab.diffusion.sampling import NoiseSchedule, noise_like
from motionlab.motion import Motion
from motionlab.skeleton import BALLS, STANDARD
from motionlab.viz.palette import INK, ROLE
from studies.shared import small_models
from studies.shared.plots import canvas, paints

#: What small models are compared in, less being better: of their estimates of x0, name on record and how many in one.
_ESTIMATES = {
    "numbers (4.8)": ("x0 error", 1), "joints, cm": ("joints, mm", 10), "about the pelvis, cm": ("body, mm", 10),
    "velocity, m/s": ("velocity, m/s", 1), "slide, mm": ("slide where feet stand, mm", 1),
}  # fmt: skip
#: What each loss is about.
OWN = {"FK": "joints, cm", "velocity": "velocity, m/s", "contact": "new: slide, mm", "all three": "joints, cm"}
ROLES = {"before noise": "truth", "under noise": "observation", "the network's guess": "ours"}


@torch.no_grad()
def noised(model: MotionDiffusion, motion: Motion, t: int, generator: torch.Generator) -> dict[str, Motion]:
    """One window (1, T) as the network sees it at step t, and its guess of the window from that; in their own frame."""
    x0 = model.encode(motion)
    xt = model.schedule.noised(x0, t, noise_like(x0, generator))
    guess = model.denoiser(xt, torch.full((1,), t))
    return dict(zip(ROLES, map(model.decode, (x0, xt, guess)), strict=True))


def speed(motion: Motion) -> float:
    """Mean speed of the joints, m/s."""
    return motion.fps * float(motion.positions.diff(dim=-3).norm(dim=-1).mean())


def over_floor_cm(made: Motion) -> Tensor:
    """How high the lower ball of the feet is over where it rests, cm: median over the frames of each window (N,)."""
    balls = made.positions[..., STANDARD.indices(BALLS), 2]
    return 100 * (balls.amin(-1) - STANDARD.sole).median(-1).values


def off_cm(made: Motion, truth: Motion) -> float:
    """Mean distance of joints from the true ones, cm."""
    return 100 * float((made.positions - truth.positions).norm(dim=-1).mean())


@torch.no_grad()
def walked(
    model: MotionDiffusion, few: NoiseSchedule, x: Tensor, generator: torch.Generator
) -> tuple[list[int], list[Motion]]:
    """What the network guesses on the way from noise (1, T, D) to a motion, from the first step on: the noising steps
    that are left, and the motions (1, T); the last is what is made."""
    left, guesses = [], []
    for t in range(len(few) - 1, -1, -1):
        guess = model.denoiser(x, few.stamps[t].expand(1))
        left.append(int(few.stamps[t])), guesses.append(model.decode(guess))
        mean, variance = few.posterior(guess, x, t)
        x = mean + variance.sqrt() * noise_like(x, generator) if t else mean
    return left, guesses


def schedules(named: Mapping[str, NoiseSchedule], errors: Mapping[str, Mapping[int, Tensor]]) -> Figure:
    """What is left of the signal over the noising, and what that does: the error of the sampled covariance, by label
    and steps (data sets,), median and range."""
    fig, (left, right) = canvas(1, 2, size=(8.4, 3.0))
    for label, paint in paints(list(named), dict(zip(named, ("ours", "axis-angle"), strict=True))).items():
        a = named[label].alpha_bar.numpy()
        left.plot((np.arange(len(a)) + 1) / len(a), a, color=paint, lw=2, label=label)
        steps = sorted(errors[label])
        low, mid, high = np.array([np.percentile(errors[label][n].numpy(), (0, 50, 100)) for n in steps]).T
        right.fill_between(steps, low, high, color=paint, alpha=0.15, lw=0)
        right.loglog(steps, mid, "o-", ms=4, color=paint, lw=1.8)
    left.set(xlabel="share of the steps", ylabel="signal left, alpha-bar", title="Eq. 4.4")
    right.set(xlabel="steps of the sampler", ylabel="error of the covariance", title="DDPM with an exact denoiser")
    for axis in (right.xaxis, right.yaxis):
        axis.set_minor_formatter("")
    left.legend(loc="lower left")
    return fig


def measured(rows: Sequence[dict], arm: str) -> dict[str, Tensor]:
    """By measure, what an arm of small models leaves, for each seed (S,): four of estimates, two of samples."""
    found = {said: small_models.by_seed(rows, arm, name) / unit for said, (name, unit) in _ESTIMATES.items()}
    found["new: slide, mm"] = small_models.by_seed(rows, arm, "slide, mm a frame")
    found["new: missed, %"] = 100 * (1 - small_models.by_seed(rows, arm, "coverage"))
    return found


def table(small: Mapping, arms: Sequence[str]) -> list[dict]:
    """A row for each arm of small models, means over seeds; below, samples of the thesis's model, and people."""
    found = [{"losses": arm} | {m: x.mean().item() for m, x in measured(small["rows"], arm).items()} for arm in arms]
    for name, who in {"all, the thesis's model at its end": "diffusion_plain", "recorded people": "people"}.items():
        known = small["beside"][who]
        missed = 100 * (1 - known["coverage"]) if "coverage" in known else "-"
        last = {"new: slide, mm": known["slide, mm a frame"], "new: missed, %": missed}
        found.append({"losses": name} | dict.fromkeys(_ESTIMATES, "-") | last)
    return found


def ratios_of(rows: Sequence[dict], arm: str, other: str, shift: int = 0) -> dict[str, Tensor]:
    """By measure, for each seed (S,): one arm of small models over another, so many seeds on."""
    mine, theirs = measured(rows, arm), measured(rows, other)
    return {name: x / theirs[name].roll(shift) for name, x in mine.items()}


def ratios(found: Mapping[str, Mapping[str, tuple[float, float, float]]], bound: float) -> Figure:
    """What leaving a loss out does: a panel per loss, a row per measure: all losses over all but that one, with its
    interval over seeds. Left of 1: the loss helps. Dotted: the bound. Diamonds: what the loss is about."""
    fig, axes = canvas(1, len(found), size=(10.4, 2.6), sharex=True, sharey=True)
    for ax, (loss, rows_) in zip(axes, found.items(), strict=True):
        for k, (name, (value, low, high)) in enumerate(rows_.items()):
            paint = ROLE["ours"] if high < 1 else ROLE["axis-angle"] if low > 1 else INK
            ax.plot((low, high), (k, k), color=paint, lw=2)
            ax.plot(value, k, "D" if name == OWN[loss] else "o", color=paint, ms=8 if name == OWN[loss] else 5)
        ax.axvline(1.0, color=INK, lw=1)
        ax.axvline(bound, color=INK, lw=1, ls=":")
        ax.set(
            title=loss, xlabel="with it / without it", yticks=range(len(rows_)), yticklabels=list(rows_), xscale="log"
        )
        ax.set(xticks=(0.25, 0.5, 1, 2), xticklabels=("1/4", "1/2", "1", "2"))
        ax.xaxis.set_minor_formatter("")
    axes[0].invert_yaxis()
    return fig
