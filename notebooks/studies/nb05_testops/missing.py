"""Notebook 05d: frames without detections, and what a fit makes of the frames after them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from torch import Tensor

from data_synth import scenes
from data_synth.scenes import Scene
from motionlab.contact import with_contacts
from motionlab.humor.energies import RGB, RGB_LIGHT
from motionlab.humor.feedback_solver import Plan
from motionlab.humor.priors import Priors
from motionlab.humor.testops import Fitted, Schedule, fit
from motionlab.metrics import interval, joint_errors
from motionlab.motion import Motion
from motionlab.viz.palette import INK, LINE, colour
from studies.nb05_testops import trials
from studies.nb05_testops.measures import CM
from studies.nb05_testops.trials import later_error
from studies.shared.clips import everyday, takes
from studies.shared.plots import canvas

ROUGH = replace(RGB, joints3d_smooth=(0.0, 0.0, 0.0))  # the official weights, and nothing that smooths
#: Ways to fit. "lean" masks what was not seen; "official" starts every frame at one place and masks nothing.
WAYS: dict[str, dict[str, object]] = {
    "lean": {"mode": "lean", "solver": "shooting"}, "official": {"mode": "official"},
    "official, not smooth": {"mode": "official", "weights": ROUGH},
}  # fmt: skip
ROLES = {"truth": "truth", "lean": "ours", "official": "baseline", "official, not smooth": "axis-angle"}
SAID = {"first 1": "first frame", "middle 1": "middle frame", "first 10": "first 10 frames"}
HOW = "official unknowns, start and masks at the lean price"
#: Fits, and what missing frames add to their error (B,), by way, source and variant.
Fits, Added = Mapping[tuple[str, str, str], Mapping[int, Motion]], Mapping[tuple[str, str, str], Tensor]


# ------------------------------------------------------------------------------------------------ who is filmed
def filmed(folder: Path | None, count: int, seed: int, frames: int) -> tuple[dict[str, Scene], str]:
    """Films so many synthetic people, and so many of CMU where there are recordings, all from the front; says who."""
    found = {"synthetic": scenes.film("facing the camera", count, seed=seed, frames=frames)}
    said = f"Synthetic: {count} clips of {count} people."
    if folder:
        cast = everyday(takes(folder, "test"), count)
        found["CMU"] = from_the_front([m.cut(0, frames) for _, m in cast], seed)
        who = f"{len(cast)} clips of {len({who for who, _ in cast})} people"
        said += f" CMU, people of the part kept for reports: {who}."
    return found, said


def from_the_front(motions: Sequence[Motion], seed: int) -> Scene:
    """Films recorded motions (T,) by cameras within 45 degrees of where people look."""
    return scenes.film_recorded("plain view", [with_contacts(m) for m in motions], seed=seed, facing=True)


def gap(variant: str, frames: int) -> list[int]:
    """Returns the frames of "first 1", "middle 1", "first 10"."""
    place, length = variant.split()
    return scenes.gap_frames(place, int(length), frames)


# ------------------------------------------------------------------------------------------------ fits
def tiny() -> Schedule:
    """Returns a search of next to no steps, for the smoke profile."""
    return Schedule(steps=(1, 1, 2), inner=3, refine=(1, 1), shooting=Plan(rounds=1, closures=3, trial_rounds=1))


def fitted(
    seen: Mapping[str, Scene], way: str, variants: Sequence[str], priors: Priors, schedule: Schedule | None
) -> dict[tuple[str, str], dict[int, Motion]]:
    """Fits scenes with frames missing in a way of ``WAYS``: (source, variant) -> motions by stage. schedule: None: the
    way's own."""
    cases = {
        (source, variant): scenes.without(scene, gap(variant, scene.truth.frames)) if variant != "whole" else scene
        for source, scene in seen.items()
        for variant in variants
    }
    return trials.fit_together(cases, priors, batch=len(cases[next(iter(cases))]), schedule=schedule, **WAYS[way])


def refits(one: Scene, priors: Priors, schedule: Schedule) -> Callable[..., Fitted]:
    """Returns a function that fits a scene of one clip anew, by form, smoothness and missing frames; it remembers."""

    @cache
    def refit(form: str, smooth: bool, place: str = "first", length: int = 0) -> Fitted:
        usual = RGB if form == "official" else RGB_LIGHT
        weights = usual if smooth else replace(usual, joints3d_smooth=(0.0, 0.0, 0.0))
        seen = scenes.without(one, scenes.gap_frames(place, length, one.truth.frames)) if length else one
        how = {"mode": form, "solver": "rollout" if form == "official" else "shooting", "weights": weights}
        return fit(seen.observation, priors, cameras=one.cameras, floor="camera", schedule=schedule, **how)

    return refit


def added(broken: Motion, whole: Motion, truth: Motion, frames: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Computes what missing frames add to the world error of a fit, cm (B,), after them and before them.

    broken, whole: the fits (B, T) without these frames, and with them. Before is NaN where nothing comes before.
    """
    early, late = later_error(broken, truth, frames)
    early0, late0 = later_error(whole, truth, frames)
    return late - late0, early - early0


def first_speed(motion: Motion) -> Tensor:
    """Computes the mean speed (B,) of the joints from the first frame to the second, m/s."""
    return motion.positions[:, :2].diff(dim=1).norm(dim=-1).mean((1, 2)) * motion.fps


def jumps(fits: Fits, added: Added, truth: Motion) -> list[dict[str, object]]:
    """Returns a row per way and variant of the synthetic clips: speed of the first step, and the error later."""
    heads = ("fit", "missing", "first step after stage 2, m/s", "error added later, m", "worst clip, m")
    rows = [("truth", "-", first_speed(truth).mean().item(), "-", "-")]
    for (way, source, variant), found in fits.items():
        if source == "synthetic" and not variant.startswith("middle"):
            more = added.get((way, source, variant))
            late = ("-", "-") if more is None else (more.mean().item() / CM, more.max().item() / CM)
            speed = first_speed(found[2]).mean().item()
            rows.append((way, SAID.get(variant, "nothing"), speed, *late))
    return [dict(zip(heads, row, strict=True)) for row in rows]


# ------------------------------------------------------------------------------------------------ figures
def pulls_drawn(pulls: Mapping[str, Tensor], gone: Sequence[int]) -> Figure:
    """Draws how hard terms of the energy pull at each of the first frames, on a logarithmic axis; shaded: unseen."""
    fig, (ax,) = canvas(size=(7.4, 3.0))
    paint = {"keypoints": colour("observation"), "smoothness": colour("stage2")}
    for k, (name, pull) in enumerate(pulls.items()):
        at = np.arange(8) + 0.36 * (k - 0.5)
        ax.bar(at, pull[:8].clamp(min=1e-3).numpy(), 0.34, color=paint[name], label=name, bottom=0)
    for t in gone:
        ax.text(t - 0.18, 0.13, f"{pulls['keypoints'][t]:.0f}", ha="center", color=paint["keypoints"])
        ax.axvspan(t - 0.5, t + 0.5, color=LINE, alpha=0.4, lw=0)
    ax.set(yscale="log", xlabel="frame (shaded: without detections)", ylabel="pull at the pelvis\n(energy per metre)")
    ax.set_ylim(bottom=0.1)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


def over_time(
    stages: Mapping[int, Motion], whole: Mapping[int, Motion], truth: Motion, frames: Sequence[int], title: str = ""
) -> Figure:
    """Draws the world error of stages 2 and 3 of one clip over time; dashed: the same fits with all frames."""
    fig, (ax,) = canvas(size=(7.4, 3.0))
    t = np.arange(truth.frames) / truth.fps
    for k in (2, 3):
        for motions, style, name in ((whole, (0, (3, 2)), "all frames"), (stages, "-", "frames missing")):
            error = CM * joint_errors(motions[k].positions, truth.positions, align="none")[0].mean(-1)
            ax.plot(t, error, ls=style, lw=1.8, color=colour(f"stage{k}"), label=f"stage {k}, {name}")
    if frames:
        half = 0.5 / truth.fps
        ax.axvspan(t[min(frames)] - half, t[max(frames)] + half, color=LINE, alpha=0.5, lw=0)
    ax.set(yscale="log", ylim=(1, 1e4), xlabel="time (s); shaded: without detections", title=title)
    ax.set_ylabel("joint error in the world (cm)")
    ax.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


def by_gap(increase: Added, bound: float, generator: torch.Generator) -> Figure:
    """Draws the error that missing frames add by (way, source, variant): a dot a clip (B,), mean, 95 % interval."""
    sources = list(dict.fromkeys(source for _, source, _ in increase))
    variants = list(dict.fromkeys(variant for _, _, variant in increase))
    fig, axes = canvas(1, len(sources), size=(4.6 * len(sources) + 1.6, 3.4), sharey=True)
    for ax, source in zip(axes, sources, strict=True):
        for k, way in enumerate(WAYS):
            mine = {variants.index(v): clips for (w, s, v), clips in increase.items() if (w, s) == (way, source)}
            for x, clips in sorted(mine.items()):
                at = x + 0.25 * (k - 1)
                mean, low, high = interval(clips, "mean", generator)
                spread = np.linspace(-0.05, 0.05, len(clips))
                ax.scatter(at + spread, clips, s=12, color=colour(ROLES[way]), alpha=0.45, lw=0)
                whisker = [[mean - low], [high - mean]]
                ax.errorbar(at + 0.09, mean, whisker, fmt="D", ms=4.5, color=colour(ROLES[way]), lw=1.5)
            if mine:
                ax.plot([], [], "D", color=colour(ROLES[way]), label=f"{way}, n = {max(map(len, mine.values()))}")
        ax.axhline(0, color=INK, lw=0.8)
        ax.axhline(bound, color=INK, lw=1.0, ls=(0, (4, 3)))
        ax.set_yscale("symlog", linthresh=10.0)
        ax.set_xticks(range(len(variants)), [SAID[v] for v in variants])
        ax.set_xlim(-0.5, len(variants) - 0.5)
        ax.set(title=source)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1))
    axes[0].set_ylabel("later frames: error added (cm)")
    axes[0].yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    return fig
