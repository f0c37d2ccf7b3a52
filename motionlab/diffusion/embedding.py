"""Features that generated motion is judged in: the latent numbers of an autoencoder over windows of two seconds.

It sees the root's path and the feet's sliding. It has learnt from training motion alone, as it must: what judges may
not know what is held out.

Source: FID's features are those of a trained network (Heusel et al. 2017; for motion Guo et al. 2020, MDM).
Differs: an autoencoder, as there are no labels; root and feet count as much as all other joints together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from motionlab.contact import resting_heights
from motionlab.diffusion.windows import Windows
from motionlab.errors import DataError, ShapeError
from motionlab.frames import stuck_root
from motionlab.humor import checkpoint
from motionlab.motion import Motion, velocity
from motionlab.skeleton import FEET, STANDARD

#: Joints whose velocities count; what of the feet is low counts once more, as sliding.
MOVING = ("pelvis", "head", "left_wrist", "right_wrist", *FEET)
#: Numbers of a frame: the root's place, the joints about it, velocities, and how fast each foot joint slides.
GROUPS = {"place": 3, "joints": 3 * (len(STANDARD) - 1), "moving": 3 * len(MOVING), "sliding": len(FEET)}
LOW, EDGE = 0.03, 0.01  # metres above its resting height: a foot joint is low there, and how soft the edge is
SLOW = 0.05  # m/s: of a sliding foot's speed the logarithm counts, from about here on, or a swinging one hides it


def signals(motion: Motion) -> Tensor:
    """Rows (N, T, 94) of windows (N, T) on the standard joints, in the heading frame of their first frames.

    Metres and metres per second; sliding: log(1 + speed over the floor / SLOW), faded out where the joint is not low.

    Raises:
        ShapeError: not windows of two or more frames on the 22 joints.
    """
    if motion.root.ndim != 3 or motion.frames < 2 or motion.skeleton.names != STANDARD.names:
        raise ShapeError(f"expected windows (N, T > 1) on the 22 joints, got root {tuple(motion.root.shape)}")
    points = stuck_root(motion)[0].positions
    speed = velocity(points, motion.fps, dim=-3)
    feet = motion.skeleton.indices(FEET)
    rest = resting_heights(STANDARD)[[STANDARD.contact_names.index(name) for name in FEET]].to(points)
    low = torch.sigmoid((LOW + rest - points[..., feet, 2]) / EDGE)
    parts = (
        points[..., 0, :],
        (points[..., 1:, :] - points[..., :1, :]).flatten(-2),
        speed[..., motion.skeleton.indices(MOVING), :].flatten(-2),
        low * (speed[..., feet, :2].norm(dim=-1) / SLOW).log1p(),
    )
    return torch.cat(parts, -1)


@dataclass(frozen=True)
class Recipe:
    """frames: of a window, a multiple of 4. size: latent numbers. width: of convolutions. steps, batch, lr: of Adam,
    whose rate falls by a cosine. seed: of weights and windows."""

    frames: int = 60
    size: int = 64
    width: int = 96
    steps: int = 1600
    batch: int = 64
    lr: float = 2e-3
    seed: int = 0


class Autoencoder(nn.Module):
    """Two convolutions over time, each halving it, and a linear layer; the same backwards. (N, T, 94) <-> (N, size)."""

    def __init__(self, recipe: Recipe) -> None:
        super().__init__()
        if recipe.frames % 4:
            raise ShapeError(f"frames: expected a multiple of 4, got {recipe.frames}")
        signals, width, short = sum(GROUPS.values()), recipe.width, recipe.frames // 4
        self.encoder = nn.Sequential(
            nn.Conv1d(signals, width, 5, 2, 2), nn.GELU(), nn.Conv1d(width, width, 5, 2, 2), nn.GELU(),
            nn.Flatten(), nn.Linear(width * short, recipe.size),
        )  # fmt: skip
        self.decoder = nn.Sequential(
            nn.Linear(recipe.size, width * short), nn.Unflatten(1, (width, short)), nn.GELU(),
            nn.ConvTranspose1d(width, width, 4, 2, 1), nn.GELU(), nn.ConvTranspose1d(width, signals, 4, 2, 1),
        )  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        """Reconstruction (N, T, 94) of normalised signals."""
        return self.decoder(self.encoder(x.mT)).mT


@dataclass(frozen=True, eq=False)
class Features:
    """The trained encoder, frozen: ``features(motion)`` is (N, size), about unit size on training motion.

    mean (94,), scale (94,): of the signals, one scale per group. centre (size,), spread (size,): of the latent numbers.
    digest: of the checkpoint; it stands beside every table, as numbers in other features do not compare.
    """

    network: Autoencoder
    mean: Tensor
    scale: Tensor
    centre: Tensor
    spread: Tensor
    recipe: Recipe
    digest: str = ""

    @torch.no_grad()
    def __call__(self, motion: Motion, batch: int = 512) -> Tensor:
        """Latent numbers (N, size), float64, of windows (N, recipe.frames) at 30 fps, a batch at a time."""
        if motion.frames != self.recipe.frames:
            raise ShapeError(f"expected windows of {self.recipe.frames} frames, got {motion.frames}")
        rows = [
            (signals(_some(motion, at, batch)) - self.mean) / self.scale for at in range(0, len(motion.root), batch)
        ]
        latent = torch.cat([self.network.encoder(x.mT) for x in rows])
        return ((latent - self.centre) / self.spread).double()

    @torch.no_grad()
    def missed(self, motion: Motion) -> dict[str, float]:
        """Share of the variance of each group's signals that the latent numbers do not hold, of windows (N, T)."""
        x = (signals(motion) - self.mean) / self.scale
        wrong, total = (self.network(x) - x).square(), (x - x.mean((0, 1))).square()
        parts = zip(GROUPS, wrong.split(list(GROUPS.values()), -1), total.split(list(GROUPS.values()), -1), strict=True)
        return {name: float(a.sum() / b.sum().clamp(min=1e-12)) for name, a, b in parts}


def train(
    windows: Windows, recipe: Recipe, held: Motion | None = None, *, say: Callable[[str], None] | None = None
) -> tuple[Features, list[dict]]:
    """Train on windows; the features and the curve: loss, and what is ``missed`` of held-out windows.

    Every group weighs the same in the loss, or the few numbers that say whether a foot slides would drown.
    """
    if windows.length != recipe.frames:
        raise ShapeError(f"windows of {windows.length} frames, recipe of {recipe.frames}")
    generator = torch.Generator().manual_seed(recipe.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        network = Autoencoder(recipe)
    mean, scale = _moments(signals(windows.draw(min(2048, 16 * recipe.batch), generator)))
    weight = torch.cat([torch.full((n,), 1 / (n * len(GROUPS))) for n in GROUPS.values()])
    adam = torch.optim.Adam(network.parameters(), recipe.lr)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(adam, recipe.steps)
    made = Features(network, mean, scale, torch.zeros(recipe.size), torch.ones(recipe.size), recipe)
    curve, every = [], max(1, recipe.steps // 20)
    for step in range(1, recipe.steps + 1):
        x = (signals(windows.draw(recipe.batch, generator)) - mean) / scale
        loss = ((network(x) - x).square() * weight).sum(-1).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        rate.step()
        if step % every == 0:
            missed = made.missed(held) if held is not None else {}
            curve.append({"step": step, "loss": round(loss.item(), 4)} | {k: round(v, 4) for k, v in missed.items()})
            if say:
                say(f"{curve[-1]}")
    network = _rounded(network).eval().requires_grad_(False)
    latent = Features(network, mean, scale, made.centre, made.spread, recipe)(windows.draw(2048, generator)).float()
    return Features(network, mean, scale, latent.mean(0), latent.std(0).clamp(min=1e-3), recipe), curve


def _moments(x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of each column and one deviation per group, of rows (N, T, 94)."""
    flat = x.flatten(0, 1)
    mean = flat.mean(0)
    sizes = list(GROUPS.values())
    spread = [
        part.square().mean().sqrt().clamp(min=1e-3).expand(part.shape[1]) for part in (flat - mean).split(sizes, 1)
    ]
    return mean, torch.cat(spread)


def _rounded(network: nn.Module) -> nn.Module:
    """Its weights as float16 would keep them: as they are stored."""
    network.load_state_dict({name: value.half().float() for name, value in network.state_dict().items()})
    return network


def _some(motion: Motion, at: int, count: int) -> Motion:
    return motion.clip(slice(at, at + count)) if len(motion.root) > count else motion


# ------------------------------------------------------------------------------------------------------- on disk
def save(path: Path | str, features: Features, about: dict) -> None:
    """Write ``path`` (.safetensors, weights as float16) and its recipe (.json) with ``about``."""
    weights = {f"network.{name}": value.half() for name, value in features.network.state_dict().items()}
    others = {name: getattr(features, name) for name in ("mean", "scale", "centre", "spread")}
    checkpoint.save(path, weights | others, about | {"recipe": asdict(features.recipe)})


def load(path: Path | str) -> Features:
    """Features as ``save`` wrote them.

    Raises:
        DataError: a file is missing, damaged, does not belong to the other, or holds something else.
    """
    path = Path(path).with_suffix(".safetensors")
    tensors, about = checkpoint.load(path)
    try:
        recipe = Recipe(**about["recipe"])
        with torch.random.fork_rng(devices=[]):
            network = Autoencoder(recipe)
        network.load_state_dict({k[8:]: v.float() for k, v in tensors.items() if k.startswith("network.")})
        others = [tensors[name].float() for name in ("mean", "scale", "centre", "spread")]
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        message = f"not a feature autoencoder ({type(error).__name__}: {error})"[:300]
        raise DataError(message, path=path, remedy=checkpoint.REMEDY) from error
    return Features(network.eval().requires_grad_(False), *others, recipe, about["sha256"][:12])


@cache
def features(name: str = "diffusion_features") -> Features:
    """Features that ship with the project, or lie at a path; loaded once.

    Raises:
        DataError: no such checkpoint, or damaged.
    """
    return load(checkpoint.SHIPPED / name if Path(name).name == name else Path(name))
