"""Trains the features that generated motion is judged in (``diffusion.encoder``), and writes them with their recipe.

PYTHONPATH=notebooks python -m studies.shared.feature_training FOLDER [--steps 4000] [--seed 0] [--out PATH]
"""

import argparse
import math
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from data_synth import corpus as synthetic
from motionlab import checkpoint, splits
from motionlab.diffusion import encoder
from motionlab.diffusion.windows import Windows, gather, on_standard
from motionlab.errors import ShapeError
from motionlab.motion import Motion
from motionlab.training import recipes
from motionlab.training.training_loop import TrainingRun, seeded


def make_encoder(folder: Path | str | None, out: Path, recipe: encoder.EncoderRecipe) -> None:
    """Trains and writes the features that generated motion is judged in (``diffusion.encoder``).

    folder: of recordings. Trained on the training people, watched on validation people.
    """
    found, made = recipes.sources(folder)
    train, val = ([take.motion for take in found.part(part)] for part in ("train", "val"))
    windows, held = (gather([*map(on_standard, some)], recipe.frames) for some in (train + made, val))
    held, minutes = held.evenly(256), {splits.RECORDED: train, splits.SYNTHETIC: made}
    features, curve = train_encoder(windows, recipe, held, progress=True)
    about = {
        "what": "autoencoder over windows of 60 frames: the features that generated motion is judged in",
        "command": f"python -m studies.shared.feature_training FOLDER --steps {recipe.steps} --seed {recipe.seed}",
        "minutes of motion, before mirroring": {k: sum(m.seconds for m in v) / 60 for k, v in minutes.items()},
        "corpus": asdict(synthetic.Recipe()), "windows": windows.digest, "torch": torch.__version__,
        "share of variance missed, held out": {k: round(v, 4) for k, v in share_missed(features, held).items()},
        "curve": curve,
    }  # fmt: skip
    save_encoder(out, features, about)


def save_encoder(path: Path, features: encoder.MotionEncoder, about: dict) -> None:
    """Writes ``path`` (.safetensors, weights as float16) and its recipe (.json) with ``about``."""
    recipe, exact = asdict(features.recipe), ("mean", "scale", "centre", "spread")
    checkpoint.save(path, features.state_dict(), about | {"recipe": recipe}, exact)


def _missed(features: encoder.MotionEncoder, motion: Motion) -> tuple[Tensor, Tensor]:
    """Normalised signals (N, T, 94) of windows, and squares of what the latent numbers miss of them."""
    x = (encoder.signals(motion) - features.mean) / features.scale
    return x, (features.network["decoder"](features.network["encoder"](x.mT)).mT - x).square()


@torch.no_grad()
def share_missed(features: encoder.MotionEncoder, motion: Motion) -> dict[str, float]:
    """Computes the share of each group's variance that the latent numbers miss, of windows (N, T)."""
    x, wrong = _missed(features, motion)
    groups = (each.split(list(encoder.FEATURE_GROUPS.values()), -1) for each in (wrong, (x - x.mean((0, 1))).square()))
    parts = zip(encoder.FEATURE_GROUPS, *groups, strict=True)
    return {name: float(a.sum() / b.sum().clamp(min=1e-12)) for name, a, b in parts}


class _EncoderRun(TrainingRun):
    """Trains an autoencoder on windows. Every group weighs the same in the loss, or the few numbers that say whether a
    foot slides would drown."""

    clip, warm_up, least = math.inf, 0, 0.0

    def __init__(self, recipe: encoder.EncoderRecipe, windows: Windows) -> None:
        generator, self.windows = torch.Generator().manual_seed(recipe.seed), windows
        network = seeded(recipe.seed, lambda: encoder.MotionEncoder(recipe))
        network.mean, network.scale = _moments(encoder.signals(windows.draw(min(2048, 16 * recipe.batch), generator)))
        sizes = torch.tensor([*encoder.FEATURE_GROUPS.values()])
        self.weight = (1 / (sizes * len(sizes))).repeat_interleave(sizes)
        optimiser = torch.optim.Adam(network.parameters(), recipe.lr)
        super().__init__(recipe, windows.digest, generator, network, optimiser)

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        _, missed = _missed(self.model, self.windows.draw(self.recipe.batch, self.generator))
        return (missed * self.weight).sum(-1).mean(), {}


def train_encoder(
    windows: Windows, recipe: encoder.EncoderRecipe, held: Motion | None = None, *, progress: bool = False
) -> tuple[encoder.MotionEncoder, list[dict]]:
    """Trains on windows; returns the features and the curve: loss, and what is missed of held-out windows."""
    if windows.length != recipe.frames:
        raise ShapeError(f"windows of {windows.length} frames, recipe of {recipe.frames}")
    every, judge = max(1, recipe.steps // 20), None if held is None else lambda x: share_missed(x, held)
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
    parts = (flat - mean).split(list(encoder.FEATURE_GROUPS.values()), 1)
    return mean, torch.cat([part.square().mean().sqrt().clamp(min=1e-3).expand(part.shape[1]) for part in parts])


if __name__ == "__main__":
    asks = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asks.add_argument("folder", help="of recordings")
    asks.add_argument("--steps", type=int, default=encoder.EncoderRecipe.steps)
    asks.add_argument("--seed", type=int, default=0)
    asks.add_argument("--out", type=Path, default=checkpoint.SHIPPED / "features_real")
    asked = asks.parse_args()
    make_encoder(asked.folder, asked.out, replace(encoder.EncoderRecipe(), seed=asked.seed, steps=asked.steps))
