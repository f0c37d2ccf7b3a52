"""The denoiser, a network that estimates x_0 from x_t; trained, with its schedule, layout and normaliser; its files.

Two files (see ``checkpoint``): tensors with the normaliser's, and the recipe, which says what is built around
them. Nothing in them is executed.

Source: thesis 4.1.2, Fig. 4.2; MDM (Tevet et al. 2022), official code, unconstrained model: the same weights, by name
and shape.
Differs, where asked: several frames in one token, which halves the work.
"""

import math
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from motionlab import checkpoint
from motionlab.contact import with_contacts
from motionlab.diffusion import sampling
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.sampling import Inpainting, NoiseSchedule, ddpm, noise_like
from motionlab.errors import check_shape
from motionlab.heading import local_to_world, stuck_root
from motionlab.motion import FPS, Motion
from motionlab.skeleton import Skeleton

_LONGEST = 5000  # frames and steps that the table of sines holds
#: "thesis": MDM's size, which the thesis follows closely. "compact": trains on two cores. "small": for ablations.
SIZES = {
    "thesis": {"size": 512, "layers": 8, "heads": 4, "hidden": 1024},
    "compact": {"size": 256, "layers": 4, "heads": 4, "hidden": 512},
    "small": {"size": 128, "layers": 3, "heads": 4, "hidden": 256},
}
#: How much each part of the training loss counts. fk, contact: per m^2, the latter a frame.
LOSS_WEIGHTS = {"simple": 1.0, "fk": 0.05, "velocity": 1.0, "contact": 5.0}
LEVELS = (0.05, 0.2, 0.4, 0.6, 0.8)  # of all noising steps: where the error of x_0 is measured


def _sines(count: int, size: int) -> Tensor:
    """(count, size): sin and cos of position times 10000^(-2i / size), interleaved (Vaswani et al. 2017)."""
    position = torch.arange(count, dtype=torch.float32)[:, None]
    rate = torch.exp(torch.arange(0, size, 2, dtype=torch.float32) * (-math.log(10000.0) / size))
    return torch.stack(((position * rate).sin(), (position * rate).cos()), -1).flatten(1)


class Denoiser(nn.Module):
    """A transformer encoder over frames, with the noising step as an extra token.

    features: numbers per frame. size: of a token. patch: frames in a token. ``SIZES``: "small", "compact", "thesis".
    """

    def __init__(
        self, features: int, *, size: int = 512, layers: int = 8, heads: int = 4, hidden: int = 1024,
        dropout: float = 0.1, patch: int = 1,
    ) -> None:  # fmt: skip
        super().__init__()
        self.features, self.patch = features, patch
        self.input_process = nn.ModuleDict({"poseEmbedding": nn.Linear(features * patch, size)})
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("sines", _sines(_LONGEST, size)[:, None], persistent=False)
        layer = nn.TransformerEncoderLayer(size, heads, hidden, dropout, "gelu")
        self.seqTransEncoder = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        embed = nn.Sequential(nn.Linear(size, size), nn.SiLU(), nn.Linear(size, size))
        self.embed_timestep = nn.ModuleDict({"time_embed": embed})
        self.output_process = nn.ModuleDict({"poseFinal": nn.Linear(size, features * patch)})

    def forward(self, x: Tensor, stamps: Tensor) -> Tensor:
        """Computes an estimate (B, T, D) of x_0 from x_t (B, T, D) and steps (B,).

        Raises:
            ShapeError: another number of features.
        """
        check_shape(x, f"B T {self.features}", "x")
        tokens = self.input_process["poseEmbedding"](x.unflatten(1, (-1, self.patch)).flatten(2))
        step = self.embed_timestep["time_embed"](self.sines[stamps])  # a token of its own, the first
        tokens = torch.cat((step.transpose(0, 1), tokens.transpose(0, 1)))
        seen = self.seqTransEncoder(self.dropout(tokens + self.sines[: len(tokens)]))
        said = self.output_process["poseFinal"](seen[1:])
        return said.transpose(0, 1).unflatten(2, (self.patch, -1)).flatten(1, 2)


@dataclass(frozen=True)
class DenoiserRecipe:
    """What a training run depends on, with its windows.

    size: of the network (``SIZES``). frames: of a window. frame: of the root, "stuck" or "world" (``Layout``).
    root_unit: metres that are one unit of the root's place; 0: its deviation. patch: frames in a token. noising: steps
    of the schedule. steps, batch, lr: of AdamW; the rate rises over ``warm_up`` steps and falls by a cosine to a
    fiftieth. clip: of the gradient's norm. average: of the weights, per step. bf16: the network in bfloat16.
    """

    size: str = "compact"
    frames: int = 60
    frame: str = "stuck"
    root_unit: float = 0.0
    patch: int = 1
    noising: int = 1000
    steps: int = 30_000
    batch: int = 64
    lr: float = 4e-4
    warm_up: int = 500
    clip: float = 1.0
    average: float = 0.999
    dropout: float = 0.1
    bf16: bool = False
    weights: dict[str, float] = field(default_factory=LOSS_WEIGHTS.copy)
    seed: int = 0

    @property
    def layout(self) -> Layout:
        """The numbers of a frame."""
        return Layout(self.frame)

    @property
    def schedule(self) -> NoiseSchedule:
        """The noising process."""
        return sampling.cosine(self.noising)

    def denoiser(self) -> Denoiser:
        """Builds a new network; its weights come from torch's global generator."""
        return Denoiser(self.layout.size, dropout=self.dropout, patch=self.patch, **SIZES[self.size])


@dataclass(frozen=True, eq=False)
class MotionDiffusion:
    """A trained diffusion model of motion.

    denoiser: frozen. schedule: it was trained on. layout, normaliser: motions <-> its numbers (B, T, D).
    """

    denoiser: Denoiser
    schedule: NoiseSchedule
    layout: Layout
    normaliser: Normaliser
    recipe: DenoiserRecipe

    def encode(self, motion: Motion) -> Tensor:
        """Computes normalised numbers (..., T, D) of a motion on the 22 joints."""
        return self.normaliser.apply(self.layout.encode(motion))

    def decode(self, x: Tensor, skeleton: Skeleton | None = None) -> Motion:
        """Computes the motion (..., T) of normalised numbers, on the standard body or another."""
        return self.layout.decode(self.normaliser.undo(x), FPS, skeleton)

    def noise(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws pure noise (count, T, D), from which a sampler starts, on the denoiser's device."""
        where = next(self.denoiser.parameters()).device
        return noise_like(torch.zeros(count, self.recipe.frames, self.layout.size, device=where), generator)

    def sample(self, count: int, generator: torch.Generator, *, steps: int = 50) -> Motion:
        """Draws new motions (count, T) by DDPM, on the standard body."""
        x, respaced = self.noise(count, generator), self.schedule.respaced(min(steps, len(self.schedule)))
        return self.decode(ddpm(self.denoiser, respaced, x, generator).cpu())

    def inpaint(
        self, motion: Motion, known: Tensor, generator: torch.Generator, how: Inpainting | None = None
    ) -> Motion:
        """Inpaints motions (B, T) with gaps: unknown numbers are sampled, the place in the world stays.

        known: bool (B, T, D) or (T, D), True where known. A stuck layout takes the place and heading of the first frame
        as given, known or not. Contacts that a motion lacks are labelled.
        """
        if self.layout.contacts and motion.contacts is None:
            motion = with_contacts(motion)
        x0, how = self.encode(motion), how or Inpainting()
        pairs = zip(x0.split(64), known.expand(len(x0), *known.shape[-2:]).split(64), strict=True)
        x = [sampling.inpaint(self.denoiser, self.schedule, *pair, generator, how) for pair in pairs]
        made = replace(self.decode(torch.cat(x), motion.skeleton), name=motion.name)
        return local_to_world(stuck_root(motion)[1], made) if self.layout.frame == "stuck" else made

    @torch.no_grad()
    def errors(self, motion: Motion, generator: torch.Generator) -> dict[str, float]:
        """Computes the mean square error of normalised x_0 of windows (B, T) at ``LEVELS`` of steps, unconditioned."""
        x0, last, where = self.encode(motion), len(self.schedule) - 1, next(self.denoiser.parameters()).device
        found = {}
        for share in LEVELS:
            t = torch.full((len(x0),), round(share * last))
            xt = self.schedule.noised(x0, t, noise_like(x0, generator))
            x = self.denoiser(xt.to(where), self.schedule.stamps[t].to(where)).cpu()
            found[f"x0 error at t = {int(t[0])}"] = float((x - x0).square().mean())
        return found


def save_denoiser(path: Path | str, model: MotionDiffusion, about: dict) -> None:
    """Writes ``path`` (.safetensors, weights as float16) and its recipe (.json), with ``about`` beside it."""
    tensors = {"mean": model.normaliser.mean, "scale": model.normaliser.scale}
    tensors |= {f"denoiser.{name}": x for name, x in model.denoiser.state_dict().items()}
    checkpoint.save(path, tensors, about | {"recipe": asdict(model.recipe)}, exact=("mean", "scale"))


def load_denoiser(path: Path | str) -> MotionDiffusion:
    """Reads a model as ``save_denoiser`` wrote it, frozen, on the CPU.

    Raises:
        DataError: a file is missing, damaged or half written, does not belong to the other, or is of another model.
    """
    tensors, about = checkpoint.load(path)
    with checkpoint.rebuilding(path, "not a motion diffusion model"):
        recipe = DenoiserRecipe(**about["recipe"])
        model = checkpoint.frozen(recipe.denoiser, tensors, "denoiser.")
        normaliser = Normaliser(tensors["mean"].float(), tensors["scale"].float())
    return MotionDiffusion(model, recipe.schedule, recipe.layout, normaliser, recipe)


@cache
def motion_model(name: str) -> MotionDiffusion:
    """Loads a model that ships with the project, as "diffusion_plain", or the one at a path; once.

    Raises:
        DataError: no such checkpoint, or damaged.
    """
    return load_denoiser(checkpoint.shipped(name))
