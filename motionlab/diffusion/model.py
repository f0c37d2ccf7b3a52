"""A trained denoiser with its schedule, layout and normaliser, and its files on disk.

Two files (see ``checkpoint``): tensors with the normaliser's, and the recipe, which says what is built around
them. Nothing in them is executed.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from motionlab import checkpoint
from motionlab.diffusion import denoiser, sampling
from motionlab.diffusion.denoiser import Denoiser
from motionlab.diffusion.features import Layout, Normaliser
from motionlab.diffusion.gaussian_guess import Linear, Spectral
from motionlab.diffusion.losses import LossWeights
from motionlab.diffusion.sampling import NoiseSchedule, ddpm, noise_like
from motionlab.errors import DataError, ShapeError, check_shape
from motionlab.motion import FPS, Motion
from motionlab.skeleton import Skeleton
from motionlab.training_loop import warmed_cosine

#: Fields that came after models had been made: recipes without them had none.
_LATER = {"before", "blind", "guessed", "handles", "linear", "masks", "recalls", "root_unit"}
GAIN = "gain over the filter"  # 0 where the network has fallen silent
LEVELS = (0.05, 0.2, 0.4, 0.6, 0.8)  # of all noising steps: where the error of x_0 is measured


@dataclass(frozen=True)
class DenoiserRecipe:
    """What a training run depends on, with its windows.

    size: of the network (``denoiser.SIZES``). frames: of a window; 1: single poses. frame, velocities, contacts,
    travels: see ``Layout``. root_unit: metres that are one unit of the root's place; 0: its deviation. told: with the
    known area as input; arrival: and with the time to the next known frame. patch: frames in a token. handles: numbers
    that the places of handles are embedded in; 0: they are not heard of. before: see ``Denoiser``. spectral: the
    network corrects a Wiener filter (``spectral``); guessed: a told one corrects a guess of what is not known, too
    (``start.InitialGuess``), or smooth curves; linear: it corrects what a Gaussian would say, of single poses, handles
    and all (``linear``). version: of the synthetic corpus. source: of what it trains on ("synthetic", "recordings",
    "all" of both, or "real": a corpus of people); share: of those motions. copies: of every motion, held otherwise
    (``humor.examples``). noising: steps of the schedule. masks: of ``masks.KINDS``, what a told model is told. blind:
    share of training windows that are asked from pure noise. recalls: training windows that a told model starts from
    (``start.InitialGuess``), poses that a linear one does. steps, batch, lr: of AdamW; the rate rises over ``warm_up``
    steps and falls by a cosine to a fiftieth. clip: of the gradient's norm. average: of the weights, per step. bf16:
    the network in bfloat16.
    """

    size: str = "compact"
    frames: int = 60
    frame: str = "stuck"
    velocities: bool = False
    contacts: bool = True
    travels: bool = True
    root_unit: float = 0.0
    told: bool = False
    arrival: bool = False
    patch: int = 1
    handles: int = 0
    before: bool = False
    spectral: bool = False
    guessed: bool = True
    linear: bool = False
    version: str = "B"
    source: str = "all"
    share: float = 1.0
    mirrored: bool = True
    copies: int = 0
    noising: int = 1000
    masks: str = "all"
    blind: float = 0.0
    recalls: int = 0
    steps: int = 30_000
    batch: int = 32
    lr: float = 4e-4
    warm_up: int = 500
    clip: float = 1.0
    average: float = 0.999
    dropout: float = 0.1
    bf16: bool = False
    weights: LossWeights = field(default_factory=LossWeights)
    seed: int = 0

    @classmethod
    def read(cls, content: dict) -> DenoiserRecipe:
        """Reads a recipe from ``asdict``, as JSON gives it back.

        Raises:
            TypeError: names that are no part of a recipe. ValueError: values that are none.
        """
        if missing := {f.name for f in fields(cls)} - set(content) - _LATER:
            raise ValueError(f"no {', '.join(sorted(missing))}")
        return cls(**content | {"weights": LossWeights(**content["weights"])})

    @property
    def layout(self) -> Layout:
        """The numbers of a frame."""
        return Layout(self.frame, self.velocities, self.contacts, self.travels)

    @property
    def schedule(self) -> NoiseSchedule:
        """The noising process."""
        return sampling.cosine(self.noising)

    def rate(self, step: int) -> float:
        """Computes the learning rate at a step."""
        return warmed_cosine(self.lr, step, self.steps, self.warm_up)

    def denoiser(self) -> Denoiser | Spectral | Linear:
        """Builds a new network; its weights come from torch's global generator.

        Raises:
            ValueError: no such size, or parts that do not go together.
        """
        if self.size not in denoiser.SIZES:
            raise ValueError(f"size: expected one of {', '.join(denoiser.SIZES)}, got {self.size!r}")
        network = Denoiser(
            self.layout.size, dropout=self.dropout, told=self.told, arrival=self.arrival, patch=self.patch,
            handles=self.handles, before=self.before, **denoiser.SIZES[self.size],
        )  # fmt: skip
        if self.spectral or self.linear:  # begins as what it corrects: with random words it soon falls silent for good
            torch.nn.init.zeros_(network.output_process.poseFinal.weight)
            torch.nn.init.zeros_(network.output_process.poseFinal.bias)
        if self.weights.relative and not self.spectral:
            raise ValueError("relative: only a spectral model has a guess to be compared with")
        if self.linear:
            if self.frames != 1 or self.told:
                raise ValueError("linear: only for single poses that are told of nothing but handles")
            return Linear(network, self.schedule.alpha_bar, self.layout, self.recalls)
        if not self.spectral:
            return network
        size = (self.frames, self.layout.size, self.recalls)
        return Spectral(network, self.schedule.alpha_bar, *size, guessed=self.guessed)


@dataclass(frozen=True, eq=False)
class Trained:
    """denoiser: frozen. schedule: it was trained on. layout, normaliser: motions <-> its numbers (B, T, D)."""

    denoiser: Denoiser | Spectral | Linear
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

    def sample(self, count: int, generator: torch.Generator, *, steps: int = 50, rest: float = 0.0) -> Motion:
        """Draws new motions (count, T) by DDPM, on the standard body. rest: share of last steps left out (``ddpm``)."""
        x, respaced = self.noise(count, generator), self.schedule.respaced(min(steps, len(self.schedule)))
        return self.decode(ddpm(self.denoiser, respaced, x, generator, rest=round(rest * len(respaced))).cpu())

    def encode_local(self, local: Motion) -> Tensor:
        """Computes normalised numbers (B, T, D) of motions that are in the layout's frame already."""
        return self.normaliser.apply(replace(self.layout, frame="world").encode(local))

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


class _Silent(nn.Module):
    """A network that adds nothing."""

    def __init__(self, told: bool) -> None:
        super().__init__()
        self.told, self.none = told, nn.Parameter(torch.zeros(()), requires_grad=False)

    def forward(self, x: Tensor, stamps: Tensor, *told: Tensor | None, **more: Tensor | None) -> Tensor:
        return torch.zeros_like(x)


def silenced(model: Trained) -> Trained:
    """Returns a copy of a model whose network returns zero, leaving its analytic estimate: the Wiener filter with the
    training data's spectrum and, of a model that takes known numbers or handles, the guess from these.

    Raises:
        ShapeError: there is nothing but a network.
    """
    if not isinstance(model.denoiser, Spectral | Linear):
        raise ShapeError("silenced: expected a model with spectral = True or linear = True")
    made = deepcopy(model.denoiser)
    made.network = _Silent(model.recipe.told)
    return replace(model, denoiser=made)


def gain(model: Trained, motion: Motion, errors: dict[str, float]) -> dict[str, float]:
    """Computes {``GAIN``: the share by which the network lowers the analytic estimate's error on windows (B, T)};
    errors: those of ``model``."""
    alone = silenced(model).errors(motion, torch.Generator().manual_seed(0))
    return {GAIN: 1 - sum(errors[name] for name in alone) / sum(alone.values())}


def save_denoiser(path: Path | str, model: Trained, about: dict, *, half: bool = False) -> None:
    """Writes ``path`` (.safetensors) and its recipe (.json), with ``about`` beside it. half: weights as float16."""
    weights = {f"denoiser.{name}": value for name, value in model.denoiser.state_dict().items()}
    data = {f"denoiser.{name}" for name, _ in model.denoiser.named_buffers()}
    weights = {k: v.half() if half and k not in data else v for k, v in weights.items()}
    tensors = weights | {"mean": model.normaliser.mean, "scale": model.normaliser.scale}
    checkpoint.save(path, tensors, about | {"recipe": asdict(model.recipe)})


def load_denoiser(path: Path | str) -> Trained:
    """Reads a model as ``save_denoiser`` wrote it, frozen, on the CPU.

    Raises:
        DataError: a file is missing, damaged or half written, does not belong to the other, or is of another model.
    """
    path = Path(path).with_suffix(".safetensors")
    tensors, about = checkpoint.load(path)
    try:
        recipe = DenoiserRecipe.read(about["recipe"])
        with torch.random.fork_rng(devices=[]):
            model = recipe.denoiser()
        weights = {k.removeprefix("denoiser."): v.float() for k, v in tensors.items() if k.startswith("denoiser.")}
        model.load_state_dict(weights)
        normaliser = Normaliser(tensors["mean"].float(), tensors["scale"].float())
        for x in (normaliser.mean, normaliser.scale):
            check_shape(x, f"{recipe.layout.size}", "normaliser")
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        message = f"not a motion diffusion model ({type(error).__name__}: {error})"[:300]
        raise DataError(message, path=path, remedy=checkpoint.REMEDY) from error
    if not all(value.isfinite().all() for value in tensors.values()):
        raise DataError("numbers that are not finite", path=path, remedy=checkpoint.REMEDY)
    return Trained(model.eval().requires_grad_(False), recipe.schedule, recipe.layout, normaliser, recipe)


@cache
def motion_model(name: str) -> Trained:
    """Loads a model that ships with the project, as "diffusion_free", or the one at a path; once.

    Raises:
        DataError: no such checkpoint, or damaged.
    """
    return load_denoiser(checkpoint.SHIPPED / name if Path(name).name == name else Path(name))
