"""Trains the autoencoder in whose latent features generated motion is judged (``diffusion.encoder``)."""

import math

import torch
from torch import Tensor

from motionlab.diffusion.encoder import FEATURE_GROUPS, EncoderRecipe, MotionEncoder, signals
from motionlab.diffusion.windows import Windows
from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.training.training_loop import TrainingRun, seeded


class _EncoderRun(TrainingRun):
    """Trains an autoencoder on windows. Every group weighs the same in the loss, or the few numbers that say whether a
    foot slides would drown."""

    clip, warm_up, least = math.inf, 0, 0.0

    def __init__(self, recipe: EncoderRecipe, windows: Windows) -> None:
        generator, self.windows = torch.Generator().manual_seed(recipe.seed), windows
        network = seeded(recipe.seed, lambda: MotionEncoder(recipe))
        moments = _moments(signals(windows.draw(min(2048, 16 * recipe.batch), generator)))
        network.mean, network.scale = moments
        self.weight = torch.cat([torch.full((n,), 1 / (n * len(FEATURE_GROUPS))) for n in FEATURE_GROUPS.values()])
        optimiser = torch.optim.Adam(network.parameters(), recipe.lr)
        super().__init__(recipe, windows.digest, generator, network, optimiser)

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        _, missed = self.model.missed(self.windows.draw(self.recipe.batch, self.generator))
        return (missed * self.weight).sum(-1).mean(), {}


def train_encoder(
    windows: Windows, recipe: EncoderRecipe, held: Motion | None = None, *, progress: bool = False
) -> tuple[MotionEncoder, list[dict]]:
    """Trains on windows; returns the features and the curve: loss, and what is ``missed`` of held-out windows."""
    if windows.length != recipe.frames:
        raise ShapeError(f"windows of {windows.length} frames, recipe of {recipe.frames}")
    every, judge = max(1, recipe.steps // 20), None if held is None else lambda x: x.reconstruction_error(held)
    run = _EncoderRun(recipe, windows).run(every=every, judge=judge, judge_every=every, progress=progress)
    made = run.averaged
    made.network.half().float()  # its weights as they are stored
    latent = made(windows.draw(2048, run.generator)).float()
    made.centre, made.spread = latent.mean(0), latent.std(0).clamp(min=1e-3)
    return made, [{name: round(value, 4) for name, value in row.items()} for row in run.curve]


def _moments(x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of each column and one deviation per group, of rows (N, T, 94)."""
    flat = x.flatten(0, 1)
    mean = flat.mean(0)
    parts = (flat - mean).split(list(FEATURE_GROUPS.values()), 1)
    return mean, torch.cat([part.square().mean().sqrt().clamp(min=1e-3).expand(part.shape[1]) for part in parts])
