"""Trains a denoiser to estimate x_0 from x_t at a random step; resumable to the bit, on one device or several.

Source: thesis 4.1.2; MDM (Tevet et al. 2022): AdamW without decay of the weights, steps drawn evenly.
Differs: warm-up, cosine decay, clipped gradients; what ships is a moving average, chosen by a judge where there is one
(MDM: by FID, by hand; thesis: by eye); dropout follows the run's generator; gradients not finite are skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy

import torch
from torch import Tensor

from motionlab.diffusion import masks
from motionlab.diffusion.denoiser import Denoiser, widened
from motionlab.diffusion.features import Normaliser
from motionlab.diffusion.gaussian_guess import Linear, Spectral, power
from motionlab.diffusion.losses import denoising_losses
from motionlab.diffusion.model import DenoiserRecipe, Trained, gain
from motionlab.diffusion.sampling import noise_like
from motionlab.diffusion.windows import Windows
from motionlab.errors import DataError
from motionlab.motion import FPS, Motion
from motionlab.training_loop import TrainingRun

_BEGIN = "choose the preset and size that it was made with"
_MEASURED = 2000  # windows that the normaliser is measured on

Judge = Callable[[Trained], dict[str, float]]


class DenoiserTraining(TrainingRun):
    """A training run of a denoiser.

    device: where it runs. accelerator: of ``accelerate.Accelerator``, for several processes with a device each: all
    draw the same batch, each takes its share, and gradients are averaged; None: one process, on ``device``. start: the
    model to begin from, with its normaliser, as for motions of one's own; None: new weights.
    """

    data_name = "windows"
    give_up = 20

    def __init__(
        self,
        recipe: DenoiserRecipe,
        windows: Windows,
        device: torch.device | str = "cpu",
        accelerator: object | None = None,
        start: Trained | None = None,
    ) -> None:
        if windows.length != recipe.frames or windows.fps != FPS:
            message = f"windows of {windows.length} frames at {windows.fps:g} fps; expected {recipe.frames} at {FPS:g}"
            raise DataError(message, remedy="gather windows of the recipe's length from motions at 30 fps")
        self.windows, self.device, self.accelerator, self.share = windows, device, accelerator, 1
        if accelerator is not None:
            self.device = accelerator.device
            self.rank, self.share = accelerator.process_index, accelerator.num_processes
        if recipe.batch % self.share:
            message = f"a batch of {recipe.batch} does not divide among {self.share} processes"
            raise DataError(message, remedy="choose a multiple")
        self.layout, self.schedule, self.clip = recipe.layout, recipe.schedule, recipe.clip
        self._counts = recipe.weights.counts(self.schedule)
        drawn, clips = windows.drawn(_MEASURED, torch.Generator().manual_seed(0))
        some = self.layout.encode(drawn)
        if start is not None and start.layout != self.layout:
            raise DataError("the model to begin from has other features", remedy=_BEGIN)
        self.normaliser = (
            start.normaliser if start else Normaliser.measure(some, self.layout, root_unit=recipe.root_unit)
        )
        if windows.seen is not None and (recipe.linear or (recipe.told and recipe.spectral and recipe.guessed)):
            remedy = "choose a preset that recalls no motion, or leave these recordings out"
            raise DataError("motions that lack joints, for a model that recalls whole motions", remedy=remedy)
        model = self._new_model(recipe, some, self._seen(clips))
        if start is not None:
            _take_weights(model, start, recipe)
        model.to(self.device)
        super().__init__(recipe, windows.digest, torch.Generator().manual_seed(recipe.seed), model)
        self.network = self.model if accelerator is None else accelerator.prepare_model(self.model)

    def _seen(self, clips: Tensor) -> Tensor | None:
        """Which numbers (B, D) of windows of these motions (B,) were recorded; None: all."""
        if self.windows.seen is None:
            return None
        whole = torch.ones(len(clips), 2, dtype=torch.bool)  # the root's place, contacts
        return torch.cat((self.windows.seen[clips], whole), 1)[:, masks.units(self.layout)]

    def _new_model(self, recipe: DenoiserRecipe, some: Tensor, seen: Tensor | None) -> Denoiser | Spectral | Linear:
        """New weights, and what is measured of windows ``some`` (N, T, D) and recalled of others."""
        with self._torch_seeded(recipe.seed):
            model = recipe.denoiser()
        if recipe.linear:
            model.measure(self.normaliser.apply(some), self.normaliser)
        elif recipe.spectral:
            model.spectrum.copy_(power(self.normaliser.apply(some), seen))
        if (recipe.linear and recipe.recalls) or (recipe.spectral and recipe.told and recipe.guessed):
            many, clips = self.windows.drawn(max(_MEASURED, recipe.recalls), torch.Generator().manual_seed(1))
            model.recall(self.normaliser.apply(self.layout.encode(many)), clips)
        return model

    @classmethod
    def _recipe(cls, content: dict) -> DenoiserRecipe:
        return DenoiserRecipe.read(content)

    def _optimiser(self) -> torch.optim.Optimizer:
        return torch.optim.AdamW(self.model.parameters(), lr=self.recipe.lr, weight_decay=0.0)

    def _rate(self) -> float:
        return self.recipe.rate(self.step)

    def _made(self, weights: dict[str, Tensor]) -> Trained:
        model = deepcopy(self.model).eval().requires_grad_(False)
        model.load_state_dict(weights)
        return Trained(model, self.schedule, self.layout, self.normaliser, self.recipe)

    def _extra(self) -> dict:
        return {"normaliser": (self.normaliser.mean, self.normaliser.scale)}

    def _restore(self, found: dict) -> None:
        self.normaliser = Normaliser(*found["normaliser"])

    def _backward(self, loss: Tensor) -> None:
        loss.backward() if self.accelerator is None else self.accelerator.backward(loss)

    def _loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        recipe = self.recipe
        motion, clips = self.windows.drawn(recipe.batch, self.generator)
        x0 = self.normaliser.apply(self.layout.encode(motion))
        t = torch.randint(len(self.schedule), (recipe.batch,), generator=self.generator)
        if recipe.blind:
            blind = torch.rand(recipe.batch, generator=self.generator) < recipe.blind
            t = torch.where(blind, len(self.schedule) - 1, t)
        xt = self.schedule.noised(x0, t, noise_like(x0, self.generator))
        signal, count = self.schedule.alpha_bar[t].to(x0), self._counts[t].to(x0)
        kinds = masks.KINDS[recipe.masks]
        known = masks.draw(self.layout, recipe.frames, recipe.batch, self.generator, kinds) if recipe.told else None
        seen = self._seen(clips)
        known = known if known is None or seen is None else known & seen[:, None]
        held = masks.draw_handles(motion, self.generator) if recipe.handles or recipe.weights.handles else None
        seed = int(torch.randint(2**31, (), generator=self.generator)) + self.rank
        offsets = motion.skeleton.offsets[:, 0]
        batch = (x0, xt, self.schedule.stamps[t], offsets, signal, count, known, held, clips, seen)
        x0, xt, stamps, offsets, signal, count, known, held, clips, seen = (
            None if each is None else each[self.rank :: self.share].to(self.device) for each in batch
        )
        told = {"known": x0, "mask": known} if recipe.told else {}
        told |= {"own": clips} if recipe.recalls else {}
        told |= ({"handles": held} if recipe.handles else {}) | ({"both": True} if recipe.weights.relative else {})
        with self._torch_seeded(seed), torch.autocast(torch.device(self.device).type, torch.bfloat16, recipe.bf16):
            found = self.network(xt, stamps, **told)
        estimate, guess = (x.float() for x in found) if recipe.weights.relative else (found.float(), None)
        weights = recipe.weights.at(self.step / recipe.steps, self.layout, recipe.told)
        trust = signal if known is None else torch.maximum(signal, known.float().mean((1, 2)))
        parts = denoising_losses(
            estimate, x0, self.layout, self.normaliser, offsets, parts=weights, gate=recipe.weights.gate,
            even=recipe.weights.even, known=known, handles=held, trust=trust if recipe.weights.by_signal else None,
            count=count, seen=seen, guess=guess,
        )  # fmt: skip
        return sum(weight * parts[name] for name, weight in weights.items()), parts

    @contextmanager
    def _torch_seeded(self, seed: int) -> Iterator[None]:
        """torch's global generators, which dropout and new layers draw from, seeded here and as before behind."""
        device = torch.device(self.device)
        with torch.random.fork_rng(devices=[device.index or 0] if device.type == "cuda" else []):
            torch.manual_seed(seed)
            yield


def _take_weights(model: Denoiser | Spectral | Linear, start: Trained, recipe: DenoiserRecipe) -> None:
    """Begins with the weights of a model of the same kind, or of one told nothing if this one is told what is known."""
    weights = start.denoiser.state_dict()
    if recipe.told and not start.recipe.told:
        own = {name: x for name, x in model.state_dict().items() if name.startswith("start.")}
        weights = own | widened(weights, recipe.layout.size)
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        raise DataError(f"the model to begin from is another one: {error}"[:300], remedy=_BEGIN) from error


def held_errors(held: Motion) -> Judge:
    """Builds a judge that measures a model on held-out windows (B, T): errors of x_0, and the network's gain."""

    def measure(model: Trained) -> dict[str, float]:
        errors = model.errors(held, torch.Generator().manual_seed(0))
        return errors | (gain(model, held, errors) if model.recipe.spectral else {})

    return measure
