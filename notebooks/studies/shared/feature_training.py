"""Features that generated motion is judged in, the latent numbers of an autoencoder over two seconds.

It sees the root's path and the feet's sliding, and is trained on training motion alone, as features must not depend on
held-out motion.

PYTHONPATH=notebooks python -m studies.shared.feature_training FOLDER [--steps 4000] [--seed 0] [--out PATH]

Source: FID's features are those of a trained network (Heusel et al. 2017; for motion Guo et al. 2020, MDM).
Differs: an autoencoder, as there are no labels; root and feet count as much as all other joints together.
"""

import argparse
import math
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn

from data_synth import corpus as synthetic
from motionlab import checkpoint, splits
from motionlab.contact import resting_heights
from motionlab.diffusion.windows import Windows, gather, on_standard
from motionlab.heading import stuck_root
from motionlab.motion import Motion, velocity
from motionlab.skeleton import FEET, STANDARD
from motionlab.training import recipes
from motionlab.training.training_loop import TrainingRun, seeded

#: Joints whose velocities count; what of the feet is low counts once more, as sliding.
_MOVING = ("pelvis", "head", "left_wrist", "right_wrist", *FEET)
#: Numbers of a frame: the root's place, the joints about it, velocities, and how fast each foot joint slides.
FEATURE_GROUPS = {"place": 3, "joints": 3 * (len(STANDARD) - 1), "moving": 3 * len(_MOVING), "sliding": len(FEET)}
_LOW, _EDGE = 0.03, 0.01  # metres above its resting height: a foot joint is low there, and how soft the edge is
_SLOW = 0.05  # m/s: of a sliding foot's speed the logarithm counts, from about here on, or a swinging one hides it


def signals(motion: Motion) -> Tensor:
    """Computes rows (N, T, 94) of windows (N, T) on the standard joints, in the heading frame of their first frames.

    Metres and metres per second; sliding: log(1 + speed over the floor / SLOW), faded out where the joint is not low.
    """
    points = stuck_root(motion)[0].positions
    speed = velocity(points, motion.fps, dim=-3)
    feet = motion.skeleton.indices(FEET)
    rest = resting_heights(STANDARD)[[STANDARD.contact_names.index(name) for name in FEET]].to(points)
    low = torch.sigmoid((_LOW + rest - points[..., feet, 2]) / _EDGE)
    parts = (
        points[..., 0, :],
        (points[..., 1:, :] - points[..., :1, :]).flatten(-2),
        speed[..., motion.skeleton.indices(_MOVING), :].flatten(-2),
        low * (speed[..., feet, :2].norm(dim=-1) / _SLOW).log1p(),
    )
    return torch.cat(parts, -1)


@dataclass(frozen=True)
class EncoderRecipe:
    """frames: of a window, a multiple of 4. size: latent numbers. width: of convolutions. steps, batch, lr: of Adam,
    whose rate falls by a cosine. seed: of weights and windows."""

    frames: int = 60
    size: int = 64
    width: int = 96
    steps: int = 4000
    batch: int = 64
    lr: float = 2e-3
    seed: int = 0
    average: ClassVar[float] = 0.0  # its weights are the last ones


class MotionEncoder(nn.Module):
    """Two convolutions over time, each halving it, and a linear layer; the same backwards. ``encoder(motion)`` is (N,
    size), about unit size on training motion.

    mean (94,), scale (94,): of the signals, one scale per group. centre (size,), spread (size,): of the latent numbers.
    """

    def __init__(self, recipe: EncoderRecipe) -> None:
        super().__init__()
        self.recipe, numbers, width, short = recipe, sum(FEATURE_GROUPS.values()), recipe.width, recipe.frames // 4
        encoder = nn.Sequential(
            nn.Conv1d(numbers, width, 5, 2, 2), nn.GELU(), nn.Conv1d(width, width, 5, 2, 2), nn.GELU(),
            nn.Flatten(), nn.Linear(width * short, recipe.size),
        )  # fmt: skip
        decoder = nn.Sequential(
            nn.Linear(recipe.size, width * short), nn.Unflatten(1, (width, short)), nn.GELU(),
            nn.ConvTranspose1d(width, width, 4, 2, 1), nn.GELU(), nn.ConvTranspose1d(width, numbers, 4, 2, 1),
        )  # fmt: skip
        self.network = nn.ModuleDict({"encoder": encoder, "decoder": decoder})
        for middle, deviation, size in (("mean", "scale", numbers), ("centre", "spread", recipe.size)):
            self.register_buffer(middle, torch.zeros(size))
            self.register_buffer(deviation, torch.ones(size))

    @torch.no_grad()
    def forward(self, motion: Motion) -> Tensor:
        """Computes latent numbers (N, size), float64, of windows (N, recipe.frames) at 30 fps, 512 at a time."""
        parts = (motion.clip(slice(at, at + 512)) for at in range(0, len(motion.root), 512))
        latent = torch.cat([self.network["encoder"](((signals(x) - self.mean) / self.scale).mT) for x in parts])
        return ((latent - self.centre) / self.spread).double()


@cache
def motion_encoder(name: str = "features_real") -> MotionEncoder:
    """Loads an encoder that ships with the project, by name, or one at a path; once."""
    tensors, about = checkpoint.load(checkpoint.shipped(name))
    return checkpoint.frozen(lambda: MotionEncoder(EncoderRecipe(**about["recipe"])), tensors)


def make_encoder(folder: Path | str | None, out: Path, recipe: EncoderRecipe) -> None:
    """Trains the features on the training people of recordings, watched on validation people, and writes them."""
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


def save_encoder(path: Path, features: MotionEncoder, about: dict) -> None:
    """Writes ``path`` (.safetensors, weights as float16) and its recipe (.json) with ``about``."""
    recipe, exact = asdict(features.recipe), ("mean", "scale", "centre", "spread")
    checkpoint.save(path, features.state_dict(), about | {"recipe": recipe}, exact)


def _missed(features: MotionEncoder, motion: Motion) -> tuple[Tensor, Tensor]:
    """Normalised signals (N, T, 94) of windows, and squares of what the latent numbers miss of them."""
    x = (signals(motion) - features.mean) / features.scale
    return x, (features.network["decoder"](features.network["encoder"](x.mT)).mT - x).square()


@torch.no_grad()
def share_missed(features: MotionEncoder, motion: Motion) -> dict[str, float]:
    """Computes the share of each group's variance that the latent numbers miss, of windows (N, T)."""
    x, wrong = _missed(features, motion)
    groups = (each.split(list(FEATURE_GROUPS.values()), -1) for each in (wrong, (x - x.mean((0, 1))).square()))
    parts = zip(FEATURE_GROUPS, *groups, strict=True)
    return {name: float(a.sum() / b.sum().clamp(min=1e-12)) for name, a, b in parts}


class _EncoderRun(TrainingRun):
    """Trains an autoencoder on windows. Every group weighs the same in the loss, or the few numbers that say whether a
    foot slides would drown."""

    clip, warm_up, least = math.inf, 0, 0.0

    def __init__(self, recipe: EncoderRecipe, windows: Windows) -> None:
        generator, self.windows = torch.Generator().manual_seed(recipe.seed), windows
        network = seeded(recipe.seed, lambda: MotionEncoder(recipe))
        network.mean, network.scale = _moments(signals(windows.draw(min(2048, 16 * recipe.batch), generator)))
        sizes = torch.tensor([*FEATURE_GROUPS.values()])
        self.weight = (1 / (sizes * len(sizes))).repeat_interleave(sizes)
        optimiser = torch.optim.Adam(network.parameters(), recipe.lr)
        super().__init__(recipe, windows.digest, generator, network, optimiser)

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        _, missed = _missed(self.model, self.windows.draw(self.recipe.batch, self.generator))
        return (missed * self.weight).sum(-1).mean(), {}


def train_encoder(
    windows: Windows, recipe: EncoderRecipe, held: Motion | None = None, *, progress: bool = False
) -> tuple[MotionEncoder, list[dict]]:
    """Trains on windows; returns the features and the curve: loss, and what is missed of held-out windows."""
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
    parts = (flat - mean).split(list(FEATURE_GROUPS.values()), 1)
    return mean, torch.cat([part.square().mean().sqrt().clamp(min=1e-3).expand(part.shape[1]) for part in parts])


if __name__ == "__main__":
    asks = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asks.add_argument("folder", help="of recordings")
    asks.add_argument("--steps", type=int, default=EncoderRecipe.steps)
    asks.add_argument("--seed", type=int, default=0)
    asks.add_argument("--out", type=Path, default=checkpoint.SHIPPED / "features_real")
    asked = asks.parse_args()
    make_encoder(asked.folder, asked.out, replace(EncoderRecipe(), seed=asked.seed, steps=asked.steps))
