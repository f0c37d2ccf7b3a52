"""The sampler in several numbers of steps at once, all along the same noise, and what it predicts on the way.

With y = x / sqrt(a) and s = a / (1 - a), signal over noise, a step of DDPM (thesis Eq. 4.6) reads

    s_{t-1} (y_{t-1} - x_0) = s_t (y_t - x_0) + W(s_{t-1}) - W(s_t)

with W a Brownian motion in s, so a coarse step adds the sum of what the fine ones within it add. Chains of 10 and of
1000 steps along one W differ by their steps alone, not by luck.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from tqdm.auto import tqdm

from motionlab.baselines import cosine_transform
from motionlab.diffusion import sampling
from motionlab.diffusion.model import MotionDiffusion
from motionlab.diffusion.sampling import NoiseSchedule
from motionlab.motion import FPS, Motion
from motionlab.training.training_loop import fast_halves
from studies.shared.fill_contenders import Halved

#: Bands of frequency in Hz, from (including) to; cosine k of T frames has k fps / (2 T).
BANDS = {"below 1 Hz": (0.1, 1.0), "1 to 4 Hz": (1.0, 4.0), "above 4 Hz": (4.0, 1e9)}
EXACT = 30  # last steps of 1000, which ``halved`` takes in single precision
LEFT = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05, 0.02, 0.0)  # shares of the steps


def halved(model: MotionDiffusion) -> MotionDiffusion:
    """The model with its network in bfloat16, where that is faster (twice), but for the last steps: there it shakes."""
    return replace(model, denoiser=Halved(model.denoiser, EXACT, lot=64)) if fast_halves() else model  # fits the cache


@dataclass(eq=False)
class _Chain:
    """One number of steps: where it is, and what noise has come since its last step."""

    schedule: NoiseSchedule
    x: Tensor
    at: int  # index of the step that is to come
    noise: Tensor
    mean: Tensor | None = None
    size: float = 0.0


@torch.no_grad()
def ddpm(
    model: MotionDiffusion, counts: Sequence[int], count: int, generator: torch.Generator
) -> tuple[dict[int, Tensor], dict[float, Tensor]]:
    """Draws ``count`` samples (N, T, D), normalised numbers, in each of several numbers of steps, along one noise:
    steps -> samples; and share of the steps left -> the longest chain's estimate of x_0 (N, T, D), of ``LEFT``."""
    full, start = model.schedule, model.noise(count, generator)
    strength = full.alpha_bar / (1 - full.alpha_bar)
    chains = {n: _Chain(full.respaced(n), start.clone(), n - 1, torch.zeros_like(start)) for n in counts}
    longest = max(counts)
    made, seen = {}, {}
    quiet = bool(os.environ.get("MOTIONLAB_BATCH"))
    for t in tqdm(range(len(full) - 1, -1, -1), "samples", leave=False, disable=quiet):
        for n, chain in chains.items():
            if int(chain.schedule.stamps[chain.at]) != t:
                continue
            x0 = model.denoiser(chain.x, chain.schedule.stamps[chain.at].expand(count))
            if n == longest:
                seen |= {left: x0 for left in LEFT if left not in seen and chain.at <= left * (n - 1) + 1e-9}
            if chain.at == 0:
                made[n] = x0
                continue
            chain.mean, variance = chain.schedule.posterior(x0, chain.x, chain.at)
            apart = strength[int(chain.schedule.stamps[chain.at - 1])] - strength[t]
            chain.size, chain.noise = float((variance / apart).sqrt()), torch.zeros_like(x0)
        if t:
            noise = float((strength[t - 1] - strength[t]).sqrt()) * sampling.noise_like(start, generator)
        for chain in chains.values() if t else ():
            chain.noise += noise
            if int(chain.schedule.stamps[chain.at - 1]) == t - 1:
                chain.x, chain.at = chain.mean + chain.size * chain.noise, chain.at - 1
    return made, seen


@torch.no_grad()
def ddim(model: MotionDiffusion, steps: int, count: int, generator: torch.Generator) -> Motion:
    """Draws ``count`` samples by steps that draw no noise. The cosine schedule's even steps turn by equal angles."""
    x = sampling.ddim(model.denoiser, model.schedule.respaced(steps), model.noise(count, generator))
    return model.decode(x)


def apart(a: Motion, b: Motion) -> Tensor:
    """Mean distance (N,) of the joints of two sets of windows, over that between two windows of the second."""
    theirs = b.positions
    between = (theirs - theirs.roll(1, 0)).norm(dim=-1).mean()
    return (a.positions - theirs).norm(dim=-1).mean((-1, -2)) / between


def by_band(a: Motion, b: Motion) -> dict[str, float]:
    """The same by frequency: root mean square over the windows."""
    c = cosine_transform(b.frames).to(b.root)
    x, y = (torch.einsum("kt,ntjc->nkjc", c, m.positions) for m in (a, b))
    hertz = torch.arange(b.frames) * FPS / (2 * b.frames)
    found = {}
    for band, (low, high) in BANDS.items():
        rows = (hertz >= low) & (hertz < high)
        change, between = ((p - q)[:, rows].square().mean() for p, q in ((x, y), (y, y.roll(1, 0))))
        found[band] = float((change / between).sqrt())
    return found
