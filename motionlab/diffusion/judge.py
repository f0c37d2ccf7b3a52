"""What chooses a checkpoint: the kernel distance of samples to held-out motion, in features that need no training.

Source: thesis 4.4.1 (stop by a measure, not by eye); KID, Binkowski et al. 2018.
Differs: features are physical descriptions and joint statistics, not a network's, so that every model of every run is
judged alike. The shipped table uses a trained autoencoder: what chooses is not what reports.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from motionlab.diffusion import masks
from motionlab.diffusion.sampling import noise_like
from motionlab.diffusion.trained import Trained
from motionlab.frames import stuck_root
from motionlab.metrics.distribution import describe
from motionlab.metrics.generation import kid
from motionlab.motion import Motion

FARTHEST = 4.0  # deviations; what lies further counts as that, or a few odd windows decide a cubic kernel


def features(motion: Motion) -> list[Tensor]:
    """Blocks (N, D_i) of windows (N, T): mean and deviation over time of the joints in the first frame's heading frame,
    metres; and, of more than two frames, ``metrics.distribution.describe``."""
    joints = stuck_root(motion)[0].positions.flatten(-2)
    blocks = [joints.mean(-2)]
    if motion.frames > 2:
        blocks += [joints.std(-2), torch.stack(list(describe(motion).values()), -1)]
    return blocks


class Scaled:
    """Features of real windows (N, T) and of others on their scale: unit deviation, blocks of one weight."""

    def __init__(self, real: Motion) -> None:
        blocks = features(real)
        self.mean = [x.mean(0) for x in blocks]
        self.scale = [x.std(0).clamp(min=1e-3) for x in blocks]
        self.real = self(real)

    def __call__(self, motion: Motion) -> Tensor:
        """(N, D): the kernel's x . y / D is then the mean over blocks of the mean product of standardised numbers."""
        rows = zip(features(motion), self.mean, self.scale, strict=True)
        blocks = [((x - mean) / scale).clamp(-FARTHEST, FARTHEST) for x, mean, scale in rows]
        joined = torch.cat([x / (len(blocks) * x.shape[1]) ** 0.5 for x in blocks], -1)
        return joined * joined.shape[1] ** 0.5


def filling(real: Motion, *, seed: int = 0) -> Callable[[Trained], dict[str, float]]:
    """A judge of models that are told what is known: {"filling error": mean square error of what is not known}.

    x_0 is guessed in one step from pure noise, the same noise and the same masks (``masks.draw``) for every model, on
    real windows (N, T); normalised numbers. A told model may fill in well and generate badly, or the other way round.
    """

    @torch.no_grad()
    def measure(model: Trained) -> dict[str, float]:
        generator = torch.Generator().manual_seed(seed)
        x0, where = model.encode(real), next(model.denoiser.parameters()).device
        known = masks.draw(model.layout, real.frames, len(x0), generator)
        stamps = model.schedule.stamps[-1].expand(len(x0))
        given = (noise_like(x0, generator), stamps, torch.where(known, x0, 0.0), known)
        error = (model.denoiser(*(x.to(where) for x in given)).cpu() - x0).square()
        return {"filling error": float(error[~known].mean())}

    return measure


def judge(real: Motion, *, count: int = 512, steps: int = 50, seed: int = 0) -> Callable[[Trained], dict[str, float]]:
    """A judge of what is made anew: {"kid": ...} of ``count`` samples in ``steps`` DDPM steps against real windows.

    real: (N, T), held out, from what trains no weights and reports no result. The same noise for every model.
    """
    scaled = Scaled(real)

    def measure(model: Trained) -> dict[str, float]:
        generator = torch.Generator().manual_seed(seed)
        made = scaled(model.sample(count, generator, steps=steps))
        return {"kid": kid(made, scaled.real, generator).value}

    return measure
